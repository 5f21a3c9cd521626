"""Tuners for tests, each with a different misbehaviour."""

import gc
import hashlib
import os
import sys
import time

import numpy as np

from methods.tuner import Tuner


class Crashing(Tuner):
    def tune(self, task, rng):
        yield task.start
        raise RuntimeError("boom")


class NanProposing(Tuner):
    def tune(self, task, rng):
        yield task.start
        yield np.full(task.dim, np.nan)


class OverAsking(Tuner):
    def tune(self, task, rng):
        while True:
            yield rng.uniform(size=(7, task.dim))


class Dying(Tuner):
    def tune(self, task, rng):
        yield task.start
        os._exit(3)


class Hanging(Tuner):
    def tune(self, task, rng):
        yield task.start
        time.sleep(3600)


class Stopping(Tuner):
    def tune(self, task, rng):
        yield task.start
        return "found nothing better"


class Snooping(Tuner):
    """Inspect all accessible numbers: in the task, the calling frames and all live objects.

    The tuner reports how many numbers there are, and which of the wanted hashes it found.
    """

    def __init__(self, wanted=()):
        self.wanted = {text: place for place, text in enumerate(wanted)}

    def tune(self, task, rng):
        seen = yield task.start
        numbers, frame = set(), sys._getframe()
        walk(task, numbers, set(), 6)
        walk(seen, numbers, set(), 6)
        while frame is not None:
            walk(dict(frame.f_locals), numbers, set(), 6)
            frame = frame.f_back
        for thing in gc.get_objects():
            if type(thing) in (list, tuple, dict, np.ndarray) or hasattr(
                thing, "__dataclass_fields__"
            ):
                walk(thing, numbers, set(), 2)
        found = {self.wanted[h] for h in map(hashed, numbers) if h in self.wanted}
        return " ".join(map(str, [len(numbers), *sorted(found)]))


def hashed(number):
    """Hash a number to nine digits, so that the hash does not reveal the number to the search."""
    return hashlib.sha256(f"{number:.8e}".encode()).hexdigest()[:16]


def walk(thing, numbers, visited, depth):
    if id(thing) in visited or depth < 0:
        return
    visited.add(id(thing))
    if isinstance(thing, float):
        numbers.add(float(thing))
    elif isinstance(thing, np.ndarray) and thing.dtype == np.float64:
        numbers.update(thing.ravel()[:100_000].tolist())
    elif isinstance(thing, dict):
        for value in list(thing.values()):
            walk(value, numbers, visited, depth - 1)
    elif isinstance(thing, list | tuple):
        for value in thing[:1000]:
            walk(value, numbers, visited, depth - 1)
    elif hasattr(thing, "__dict__"):
        walk(dict(vars(thing)), numbers, visited, depth - 1)


class Spawning(Tuner):
    """Start another program for the computation."""

    def tune(self, task, rng):
        import subprocess

        while True:
            subprocess.run([sys.executable, "-c", ""], check=True)
            yield rng.uniform(size=(1, task.dim))
