"""Measure the cost of a rollout in each engine, in one process on one core.

Run with ``OMP_NUM_THREADS=1 python -m tests.benchmarks.engine_speed``; prints JSON. The number is
the minimum processor time of some repetitions. The engines alternate, so that changes of the
machine affect all of them.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np

from sims.core.simulator import Scenario
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider

REPEATS = 5
LANES, ROLLOUTS = 1000, 10


def once(work):
    started = process_time()
    work()
    return process_time() - started


def ball():
    """Return seconds per rollout of 400 samples at 60 Hz.

    The batch engine simulates many elements at once, PyBullet one after the other.
    """
    scenario = Scenario(np.arange(400) / 60, {"z": 4.5})
    theta = np.random.default_rng(1).uniform(0.3, 0.7, (LANES, 1))
    batch, bullet = Ball(engine="batch"), Ball(engine="pybullet")
    bullet.simulate(theta[:1], scenario)
    seconds = [
        (
            once(lambda: batch.simulate(theta, scenario)) / LANES,
            once(lambda: bullet.simulate(theta[:ROLLOUTS], scenario)) / ROLLOUTS,
        )
        for _ in range(REPEATS)
    ]
    mine, theirs = np.min(seconds, axis=0)
    bullet.close()
    return {"batch": mine, "pybullet": theirs, "ratio": theirs / mine}


def recording(cls, effects):
    """Return seconds for 64 parameter vectors on each of 4 runs of 4 s at 100 Hz, in one call."""
    rng = np.random.default_rng(2)
    t = np.arange(400) / 100
    simulator = cls(engine="batch", effects=effects)
    inputs = {channel.name: np.repeat(rng.uniform(-0.3, 0.3, 8), 50) for channel in cls.inputs[:1]}
    if cls is Servo:
        inputs["torque_enable"] = np.ones(t.size)
    first = next(iter(cls.states))
    runs = [Scenario(t, {("z" if cls is Ball else first): 1.0 + 0.3 * k}, inputs) for k in range(4)]
    middle = [
        p.nominal if k < len(cls.system.parameters) else 0.3 * p.bounds[1]
        for k, p in enumerate(simulator.parameters)
    ]
    theta = np.array(middle) * rng.uniform(0.95, 1.05, (256, len(middle)))
    lanes = [runs[k % 4] for k in range(256)]
    return min(once(lambda: simulator.simulate_batch(theta, lanes)) for _ in range(REPEATS))


CASES = [
    (Ball, ()), (Ball, ("drag.quadratic",)),
    (Ball, ("drag.quadratic", "lift.magnus", "contact.friction")),
    (Pendulum, ()), (Pendulum, ("drag.linear",)), (Pendulum, ("friction.coulomb",)),
    (Pendulum, ("friction.stribeck",)),
    (Slider, ()), (Slider, ("friction.coulomb",)), (Servo, ()), (Servo, ("friction.load",)),
    (Servo, ("input.delay",)),
]  # fmt: skip


def main():
    result = {
        "ball_seconds_per_rollout": ball(),
        "recording_seconds": {
            " + ".join([cls.name, *effects]): recording(cls, effects) for cls, effects in CASES
        },
    }
    json.dump(result, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
