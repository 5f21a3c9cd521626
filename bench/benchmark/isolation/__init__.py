"""Isolated tuner processes: access restrictions, message protocol and termination.

A tuner has a `methods.tuner.Task` and a pipe. The code that simulates, counts, measures time and
records is on the other side of the pipe (`bench.benchmark.isolation.tuner_processes`).
"""
