"""Learned tuners that train on more than they are given; each says in which status its runs end."""

import contextlib
import gc
import itertools
import json
import os
import struct
import sys

import numpy as np

from methods.tuners.random_search import RandomSearch


class School(RandomSearch):
    """Learns honestly: the mean of its observations, which is of no use."""

    name = "school"
    learned = True
    ends = "done"

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        self.learned_mean = simulator.simulate(rng, points).mean(axis=0)

    def state(self):
        return {"mean": self.learned_mean}

    def restore(self, state):
        self.learned_mean = state["mean"]


class Counter(School):
    """Puts the counter back and raises the budget."""

    name = "counter"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        for _ in range(3):
            super().fit(simulator, rng, budget)
            simulator.used, simulator.budget = 0, 10**9


class Fence(School):
    """Simulates where targets lie that are wide."""

    name = "fence"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        simulator.training = np.array([[0.0] * simulator.dim, [1.0] * simulator.dim])
        super().fit(simulator, rng, budget)


class NotInside(School):
    """NaN is neither inside the fence nor outside."""

    name = "not-inside"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        simulator.simulate(rng, np.full((budget, simulator.dim), np.nan))


class Stream:
    """Draws what it likes."""

    def __init__(self, number):
        self.bit_generator = self
        inner = {"state": number, "inc": -number * 47026247687942121848144207491837523524 % 2**128}
        self.state = {"bit_generator": "PCG64", "state": inner, "has_uint32": 0, "uinteger": 0}


class Streams(School):
    """Has every scenario drawn by a stream that stands still, so that it is an easy one."""

    name = "streams"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        self.learned_mean = simulator.simulate(Stream(12345), points).mean(axis=0)


class Behind(School):
    """Simulates with what it finds behind its simulator."""

    name = "behind"

    def fit(self, simulator, rng, budget):
        from bench.benchmark.runner import worker_tasks

        held = [
            one
            for one in gc.get_objects()
            if type(one).__name__
            in (
                "TrainingSimulator",
                "CountedTrainingSimulator",
                "TuningProblem",
            )
        ]
        frame = sys._getframe()
        while frame is not None:
            held += [value for value in frame.f_locals.values() if hasattr(value, "cube")]
            frame = frame.f_back
        held += [problem for _, problem in worker_tasks._problems.values()]
        self.found = len([one for one in held if hasattr(one, "_problem") or hasattr(one, "cube")])
        super().fit(simulator, rng, budget)

    def state(self):
        return {**super().state(), **{f"found-{i}": np.zeros(1) for i in range(self.found)}}

    def restore(self, state):
        super().restore(state)
        if len(state) > 1:
            raise ValueError(f"it got through: {len(state)}")


class Huge(School):
    """Says that it has learned more than any memory holds."""

    name = "huge"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        (channel,) = (one for one in gc.get_objects() if type(one).__name__ == "MessageChannel")
        os.write(channel._writing, struct.pack("<cBxxIQ", b"L", 0, 0, 1 << 40))


class Names(School):
    """Arrays by names that are paths, and that are the harness's own."""

    name = "names"
    ends = "crashed"

    def state(self):
        names = ("../../left", "/tmp/simgap-cheat-left", "file", "allow_pickle", "__key__", "a\0b")
        counts = {"__simulations_and_seconds__": np.zeros(2)}
        return {**super().state(), **counts, **{name: np.zeros(1) for name in names}}


class Keyword(School):
    """An array whose name is an argument of what writes it."""

    name = "keyword"
    ends = "crashed"

    def state(self):
        return {**super().state(), "file": np.zeros(1)}


class Pickles(School):
    name = "pickles"
    ends = "crashed"

    def state(self):
        return {"mean": np.array([itertools.count()], dtype=object)}


def say(kind, body, flags=0, size=0):
    """Tell the harness something, past the code that speaks for tuners."""
    (channel,) = (one for one in gc.get_objects() if type(one).__name__ == "MessageChannel")
    with contextlib.suppress(OSError):
        channel.send(kind, body, flags=flags, size=size)
    return channel


class Watched(School):
    """Asks for the second ground, which is not counted, though nobody looks on."""

    name = "watched"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        say(b"P", b"", flags=1).receive(1 << 30)
        super().fit(simulator, rng, budget)


class Pretends(School):
    """Tells that it has learned, by arrays that it does not send."""

    name = "pretends"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        says = [["mean", "<f8", [1 << 39, 1 << 39]]]
        say(b"L", json.dumps(says).encode() + b"\n" + bytes(64))
        os.read(0, 1)
