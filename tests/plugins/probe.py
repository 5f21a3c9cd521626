"""Tuners that execute in their process what a test needs, and report the result when they stop."""

import time

import numpy as np

from methods.tuner import Proposal, Tuner

SEEN = []
"""Tasks of earlier runs in this process."""


class Probe(Tuner):
    """Run a piece of code whose last line is an expression.

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
    """Report the number of earlier runs in this process."""

    def tune(self, task, rng):
        before = len(SEEN)
        SEEN.append(task)
        yield task.start
        return f"saw {before}"


class Late(Tuner):
    """Sleep before, between and after the simulations, with stopped clocks."""

    def tune(self, task, rng):
        time.perf_counter = time.monotonic = time.time = lambda: 0.0
        time.sleep(0.02)
        for i in range(task.budget):
            yield rng.uniform(size=(1, task.dim))
            time.sleep(0.05 if i == task.budget - 1 else 0.01)
        yield Proposal(task.start, task.start)


class Drawing(Tuner):
    """Draw from the system's entropy, so that no two runs are equal."""

    def tune(self, task, rng):
        other = np.random.default_rng()
        while True:
            time.sleep(0.05)
            yield other.uniform(size=(1, task.dim))


class Logging(Tuner):
    """Write a log in the first run, and another file in every further run."""

    def tune(self, task, rng):
        yield task.start
        name = "second.txt" if SEEN else "log.txt"
        SEEN.append(task)
        with open(name, "a") as file:
            file.write("a line\n")


class Boasting(Tuner):
    """Send `message` in place of the list of written files."""

    def __init__(self, message="{}"):
        self.message = message

    def tune(self, task, rng):
        from bench.benchmark.isolation import tuner_server

        message = self.message
        tuner_server._report_written_files = lambda channel, *_: channel.send(
            b"N", message.encode()
        )
        yield task.start
