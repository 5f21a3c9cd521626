"""Isolated tuner processes: access restrictions, message protocol and termination.

A tuner has a `methods.base.Task` and a pipe. The code that simulates, counts, measures time and
records is on the other side of the pipe (`bench.sealing.outside`).
"""
