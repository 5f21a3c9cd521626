"""Helpers to build state snapshots for array functions of effects, and to simulate runs with
effects.
"""

import numpy as np

from sims import effects
from sims.core.simulator import Scenario
from sims.core.system import StateSnapshot
from sims.systems.ball import Ball, BallSystem
from sims.systems.pendulum import Pendulum, PendulumSystem
from sims.systems.servo import Servo, ServoSystem
from sims.systems.slider import Slider, SliderSystem

SIMULATORS = {"ball": Ball, "pendulum": Pendulum, "servo": Servo, "slider": Slider}
SYSTEMS = {
    "ball": BallSystem,
    "pendulum": PendulumSystem,
    "servo": ServoSystem,
    "slider": SliderSystem,
}
NAMES = [
    "drag.linear",
    "drag.quadratic",
    "friction.coulomb",
    "friction.stribeck",
    "friction.load",
    "friction.load_direction",
    "friction.load_quadratic",
    "friction.position",
    "friction.warming",
    "friction.direction",
    "gravity.scale",
    "gravity.tilt",
    "lift.magnus",
    "wind",
    "spring.linear",
    "spring.cubic",
    "force.bias",
    "force.ripple",
    "force.periodic",
    "restitution.speed",
    "contact.friction",
    "input.gain",
    "input.bias",
    "input.delay",
    "input.lag",
    "input.deadband",
    "input.saturation",
    "input.power",
    "input.rate",
    "backlash",
    "sensor.gain",
    "sensor.bias",
    "sensor.delay",
    "sensor.lag",
    "sensor.drift",
    "sensor.eccentricity",
    "supply.braking",
    "supply.sag",
    "sensor.slip",
    "servo.deadband",
    "servo.derivative",
    "servo.profile",
    "clock.skew",
    "state.overflow",
    "friction.hysteresis",
    "joint.backlash",
    "joint.flexibility",
    "state.limit",
]
PAIRS = [
    (name, system)
    for name in NAMES
    for system in SYSTEMS
    if effects.get_effect(name).fits(SYSTEMS[system])
]


def batch_coefficients(*values, count=1):
    """Return coefficients (K, L, 1), equal in every batch element."""
    return np.repeat(np.array(values, dtype=float)[:, None, None], count, axis=1)


def moment(system, x, v, theta=None, inputs=(), t=0.0, **constants):
    """Return a state snapshot of `system` at positions and velocities (L, D); all other values are
    equal in every batch element.
    """
    declared = SYSTEMS[system]
    x, v = np.array(x, dtype=float), np.array(v, dtype=float)
    count = len(x)
    theta = [p.nominal for p in declared.parameters] if theta is None else theta
    known = {c.name: constants.get(c.name, c.value) for c in declared.constants}
    felt = dict(
        zip(
            [c.name for c in declared.inputs],
            [*inputs, *[0.0] * len(declared.inputs)],
            strict=False,
        )
    )
    return StateSnapshot(
        declared(),
        np.tile(np.array(theta, dtype=float), (count, 1)),
        {name: np.full((count, 1), value) for name, value in known.items()},
        np.full((count, 1), t),
        x,
        v,
        {name: np.full((count, 1), value) for name, value in felt.items()},
    )


def run(
    system, times, fixed=None, theta=None, inputs=None, constants=None, observe=None, **initial
):
    """Simulate one run on the batch engine; return the observations (T, C)."""
    simulator = SIMULATORS[system](constants, observe, engine="batch", fixed=fixed or {})
    theta = [p.nominal for p in simulator.parameters] if theta is None else theta
    scenario = Scenario(times, initial, inputs or {})
    return simulator.simulate(np.array([theta], dtype=float), scenario)[0]
