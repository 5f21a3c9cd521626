"""Candidate experiments: runs that could be recorded, their limits and their value."""
