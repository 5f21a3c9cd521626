"""The process in which a tuner lives: what it may reach, how it is spoken to, and how it ends.

A tuner holds a `methods.base.Task` and a pipe. What simulates, counts, times and records is on the
pipe's other side (`bench.sealing.outside`).
"""
