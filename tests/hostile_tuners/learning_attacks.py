"""Learned tuners that try to train on more than they are given; `ends` is the expected status."""

import contextlib
import gc
import itertools
import json
import os
import struct
import sys

import numpy as np

from methods.tuners.random_search import RandomSearch


class HonestLearner(RandomSearch):
    """Learns honestly the mean of its observations, which does not help the tuning."""

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


class Counter(HonestLearner):
    """Resets the simulation counter and increases the budget."""

    name = "counter"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        for _ in range(3):
            super().fit(simulator, rng, budget)
            simulator.used, simulator.budget = 0, 10**9


class Fence(HonestLearner):
    """Extends the training range to the whole parameter range, where the wide targets are."""

    name = "fence"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        simulator.training = np.array([[0.0] * simulator.dim, [1.0] * simulator.dim])
        super().fit(simulator, rng, budget)


class NotInside(HonestLearner):
    """Simulates NaN, which is neither inside nor outside the training range."""

    name = "not-inside"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        simulator.simulate(rng, np.full((budget, simulator.dim), np.nan))


class Stream:
    """A random generator with a chosen state."""

    def __init__(self, number):
        self.bit_generator = self
        inner = {"state": number, "inc": -number * 47026247687942121848144207491837523524 % 2**128}
        self.state = {"bit_generator": "PCG64", "state": inner, "has_uint32": 0, "uinteger": 0}


class Streams(HonestLearner):
    """Samples every scenario from a fixed random state, so that it is an easy one."""

    name = "streams"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        self.learned_mean = simulator.simulate(Stream(12345), points).mean(axis=0)


class ProcessSearch(HonestLearner):
    """Searches its process for simulators and problems to simulate with."""

    name = "behind"

    def fit(self, simulator, rng, budget):
        from bench.benchmark.runner import run_in_worker

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
        held += [problem for _, problem in run_in_worker._problems.values()]
        self.found = len([one for one in held if hasattr(one, "_problem") or hasattr(one, "cube")])
        super().fit(simulator, rng, budget)

    def state(self):
        return {**super().state(), **{f"found-{i}": np.zeros(1) for i in range(self.found)}}

    def restore(self, state):
        super().restore(state)
        if len(state) > 1:
            raise ValueError(f"it got through: {len(state)}")


class Huge(HonestLearner):
    """Announces a training result that is larger than any memory."""

    name = "huge"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        (channel,) = (one for one in gc.get_objects() if type(one).__name__ == "MessageChannel")
        os.write(channel._writing, struct.pack("<cBxxIQ", b"L", 0, 0, 1 << 40))


class Names(HonestLearner):
    """Names its arrays like paths and like internal arrays of the harness."""

    name = "names"
    ends = "crashed"

    def state(self):
        names = ("../../left", "/tmp/simgap-cheat-left", "file", "allow_pickle", "__key__", "a\0b")
        counts = {"__simulations_and_seconds__": np.zeros(2)}
        return {**super().state(), **counts, **{name: np.zeros(1) for name in names}}


class Keyword(HonestLearner):
    """Names an array like an argument of the function that writes it."""

    name = "keyword"
    ends = "crashed"

    def state(self):
        return {**super().state(), "file": np.zeros(1)}


class Pickles(HonestLearner):
    name = "pickles"
    ends = "crashed"

    def state(self):
        return {"mean": np.array([itertools.count()], dtype=object)}


def send_directly(kind, body, flags=0, size=0):
    """Send a message to the harness directly, without the code of the tuner server."""
    (channel,) = (one for one in gc.get_objects() if type(one).__name__ == "MessageChannel")
    with contextlib.suppress(OSError):
        channel.send(kind, body, flags=flags, size=size)
    return channel


class Watched(HonestLearner):
    """Requests the uncounted training simulator, although no observer of the training exists."""

    name = "watched"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        send_directly(b"P", b"", flags=1).receive(1 << 30)
        super().fit(simulator, rng, budget)


class Pretends(HonestLearner):
    """Announces arrays of a training result that it does not send."""

    name = "pretends"
    ends = "crashed"

    def fit(self, simulator, rng, budget):
        says = [["mean", "<f8", [1 << 39, 1 << 39]]]
        send_directly(b"L", json.dumps(says).encode() + b"\n" + bytes(64))
        os.read(0, 1)
