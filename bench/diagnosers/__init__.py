"""Diagnosers that come with simgap, one a module; see `bench.diagnoser`."""
