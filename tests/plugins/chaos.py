"""Tuners with severe misbehaviour; each names the status with which its runs must end."""

import ctypes
import os
import signal
import sys
import time

import numpy as np

from methods.tuner import Tuner

STATUSES = {}


def ends(status):
    def note(kind):
        STATUSES[kind.name] = status
        return kind

    return note


@ends("crashed")
class ChaosRaise(Tuner):
    def tune(self, task, rng):
        yield task.start
        raise RuntimeError("boom")


@ends("timeout")
class ChaosHang(Tuner):
    def tune(self, task, rng):
        yield task.start
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(3600)


@ends("crashed")
class ChaosExit(Tuner):
    def tune(self, task, rng):
        yield task.start
        os._exit(7)


@ends("crashed")
class ChaosQuietExit(Tuner):
    def tune(self, task, rng):
        yield task.start
        os._exit(0)


@ends("crashed")
class ChaosSegfault(Tuner):
    def tune(self, task, rng):
        yield task.start
        ctypes.string_at(0)


@ends("done")
class ChaosOverAsk(Tuner):
    def tune(self, task, rng):
        while True:
            yield rng.uniform(size=(7, task.dim))


@ends("diverged")
class ChaosNan(Tuner):
    def tune(self, task, rng):
        yield task.start
        yield np.full(task.dim, np.nan)


@ends("crashed")
class ChaosCheat(Tuner):
    """Take the simulator from the calling frames, and simulate outside the budget."""

    def tune(self, task, rng):
        yield task.start
        frame = sys._getframe()
        while "evaluate" not in frame.f_locals:
            frame = frame.f_back
        points = rng.uniform(size=(1000, task.dim))
        _, losses = frame.f_locals["evaluate"](points)
        while True:
            yield points[losses.argmin()]


@ends("crashed")
class ChaosRecordSpoiler(Tuner):
    """Modify the recorded losses to look better."""

    def tune(self, task, rng):
        seen = yield task.start
        seen.losses[:] = 0.0
        while True:
            yield task.start


@ends("crashed")
class ChaosMemoryHog(Tuner):
    def tune(self, task, rng):
        yield task.start
        held = []
        while True:
            held.append(np.ones(10_000_000))


@ends("done")
class ChaosShout(Tuner):
    """Print megabytes."""

    def tune(self, task, rng):
        while True:
            print("x" * 1_000_000)
            os.write(2, b"y" * 1_000_000)
            yield rng.uniform(size=(1, task.dim))


@ends("done")
class ChaosGlobals(Tuner):
    """Seed the global random generator, and change the working directory."""

    def tune(self, task, rng):
        np.random.seed(0)  # noqa: NPY002
        os.chdir("/")
        while True:
            yield rng.uniform(size=(1, task.dim))
