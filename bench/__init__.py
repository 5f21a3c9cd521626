"""Benchmark of tuners and diagnosis of simulators."""

__version__ = "0.1.0"
