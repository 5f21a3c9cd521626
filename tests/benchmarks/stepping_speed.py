"""Measure the cost of stepping with traced forces and with forces that NumPy evaluates.

Run with ``OMP_NUM_THREADS=1 python -m tests.benchmarks.stepping_speed``; prints a table. Runs have
4 s at 100 Hz. The number is the processor time of the engine's own work, the minimum of some
repetitions, in one process on one core. The variants alternate, so that changes of the machine
affect both. The last rows are the times of MuJoCo alone, without reading results.
"""

from __future__ import annotations

import contextlib
from itertools import chain
from time import process_time
from unittest import mock

import numpy as np

from sims.core.simulator import Scenario
from sims.engines.compiled import force_program, register_programs
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider
from tests.benchmarks.mujoco_batches import native, once

BATCH_SIZES = (1, 16, 256, 1024)
REPEATS = 4
CASES = (
    (Pendulum, ()),
    (Pendulum, ("drag.linear", "friction.coulomb")),
    (Ball, ("drag.quadratic",)),
    (Ball, ("drag.quadratic", "lift.magnus", "contact.friction")),
    (Slider, ()),
    (Slider, ("friction.stribeck",)),
    (Servo, ()),
    (Servo, ("friction.load",)),
)


def work(cls, effects, batch_size):
    """Return the simulator, parameter vectors and scenarios of a batch on four runs."""
    rng = np.random.default_rng(2)
    t = np.arange(400) / 100
    simulator = cls(engine="batch", effects=effects)
    inputs = {channel.name: np.repeat(rng.uniform(-0.3, 0.3, 8), 50) for channel in cls.inputs[:1]}
    if cls is Servo:
        inputs["torque_enable"] = np.ones(t.size)
    first = "z" if cls is Ball else next(iter(cls.states))
    runs = [Scenario(t, {first: 1.0 + 0.3 * k}, inputs) for k in range(4)]
    middle = [
        p.nominal if k < len(cls.system.parameters) else 0.3 * p.bounds[1]
        for k, p in enumerate(simulator.parameters)
    ]
    theta = np.array(middle) * rng.uniform(0.95, 1.05, (batch_size, len(middle)))
    return simulator, theta, [runs[k % 4] for k in range(batch_size)]


class Noted:
    """An engine that measures its own time."""

    def __init__(self, engine):
        self.engine, self.seconds = engine, 0.0

    def __getattr__(self, name):
        return getattr(self.engine, name)

    def integrate(self, batch):
        started = process_time()
        motion = self.engine.integrate(batch)
        self.seconds += process_time() - started
        return motion


@contextlib.contextmanager
def evaluate_with_numpy():
    """Have NumPy evaluate all forces in a `with` block."""
    with (
        mock.patch.object(register_programs.TracedPrograms, "find", return_value=None),
        mock.patch.dict(force_program._traced_forces, clear=True),
    ):
        yield


def seconds(cls, effects, batch_size, repeats=REPEATS):
    """Return processor seconds (2, 2): evaluated and traced, each for the engine and the call."""
    simulator, theta, scenarios = work(cls, effects, batch_size)
    simulator.engine = engine = Noted(simulator.engine)
    best = np.full((2, 2), np.inf)
    for repeat in range(repeats + 1):
        for k, way in enumerate((evaluate_with_numpy, contextlib.nullcontext)):
            with way():
                engine.seconds = 0.0
                started = process_time()
                simulator.simulate_batch(theta, scenarios)
                found = engine.seconds, process_time() - started
            if repeat:  # The first call includes imports and tracing.
                best[k] = np.minimum(best[k], found)
    return best


def table():
    """Yield the rows of the table."""
    yield "| system and effects | elements | evaluated, ms | traced | ratio | of the whole call |"
    yield "|---|---|---|---|---|---|"
    for cls, effects in CASES:
        for batch_size in BATCH_SIZES:
            (old, old_call), (new, new_call) = seconds(cls, effects, batch_size)
            name = " + ".join([cls.name, *(f"`{effect}`" for effect in effects)])
            per_element = 1e3 / batch_size
            yield (
                f"| {name} | {batch_size:,} | {per_element * old:.3f} | {per_element * new:.4f}"
                f" | {old / new:.1f} | {old_call / new_call:.1f} |"
            )


def yardsticks():
    """Yield the rows of MuJoCo's own stepping."""
    for batch_size in BATCH_SIZES:
        work = native(batch_size)
        least = min(once(work, batch_size)[0] for _ in range(REPEATS))
        yield f"| MuJoCo itself: pendulum, dry friction | {batch_size:,} | | {least:.2f} | | |"


def main():
    for row in chain(table(), yardsticks()):
        print(row, flush=True)


if __name__ == "__main__":
    main()
