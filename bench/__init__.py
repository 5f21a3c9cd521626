"""The harness of simgap: compares tuners, and explains what tuning cannot fix."""

__version__ = "0.1.0"
