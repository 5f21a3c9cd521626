"""Built-in diagnosers, one per module; see `bench.core.diagnoser`."""
