"""Tuners that do in their process what a test asks for, and say as they stop what came of it."""

import time

import numpy as np

from methods.tuner import Proposal, Tuner

SEEN = []
"""Of earlier runs in this process."""


class Probe(Tuner):
    """Runs a piece of code whose last line is an expression.

    Args:
        code: Python.
    """

    def __init__(self, code=""):
        self.code = code

    def tune(self, task, rng):
        yield task.start
        *before, last = self.code.strip().splitlines()
        names = {"task": task}
        try:
            exec("\n".join(before), names)
            return repr(eval(last, names))
        except Exception as error:
            return f"{type(error).__name__}: {error}"


class Remembering(Tuner):
    """Says how many runs this process has seen before."""

    def tune(self, task, rng):
        before = len(SEEN)
        SEEN.append(task)
        yield task.start
        return f"saw {before}"


class Late(Tuner):
    """Takes its time before, between and behind its simulations, and has stopped its clock."""

    def tune(self, task, rng):
        time.perf_counter = time.monotonic = time.time = lambda: 0.0
        time.sleep(0.02)
        for i in range(task.budget):
            yield rng.uniform(size=(1, task.dim))
            time.sleep(0.05 if i == task.budget - 1 else 0.01)
        yield Proposal(task.start, task.start)


class Drawing(Tuner):
    """Draws from the system's chance, so that no two runs are alike."""

    def tune(self, task, rng):
        other = np.random.default_rng()
        while True:
            time.sleep(0.05)
            yield other.uniform(size=(1, task.dim))


class Logging(Tuner):
    """Writes a log in its first run, and another file beside it in every further one."""

    def tune(self, task, rng):
        yield task.start
        name = "second.txt" if SEEN else "log.txt"
        SEEN.append(task)
        with open(name, "a") as file:
            file.write("a line\n")


class Boasting(Tuner):
    """Answers for itself when it is asked for its files."""

    def __init__(self, says="{}"):
        self.says = says

    def tune(self, task, rng):
        from bench.benchmark.isolation import tuner_server

        says = self.says
        tuner_server._tell_written = lambda channel, *_: channel.send(b"N", says.encode())
        yield task.start
