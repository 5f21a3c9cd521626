"""Tests of forces and drives at rest and at their limits: the batch engine against closed forms.

`tests.exams.systems.test_reference_simulations` compares the motion with each effect with that of
an independent simulation.
"""

import numpy as np
import pytest

from tests.sims.effects.effect_systems import moment, run
from tests.sims.effects.test_force_laws import limit

FREE = {"gravity": 0.0}
MASS, LENGTH, GRAVITY = 0.2, 0.5, 10.0  # of a pendulum with weight torque sin q
HEAVY = {"mass": MASS, "length": LENGTH, "gravity": GRAVITY}


def slide(times, fixed, mass=1.0, u=0.0, **initial):
    """Return x and v, each (T,)."""
    return run("slider", times, fixed, [mass], {"u": np.broadcast_to(u, times.shape)}, **initial).T


def moved(fixed, u, q=0.5):
    """Return how far a pendulum with weight torque sin q moves in 0.2 s from rest, rad."""
    times = np.arange(21) * 0.01
    inputs = {"u": np.full(times.size, u)}
    return run("pendulum", times, fixed, [0.06], inputs, HEAVY, q=q)[-1, 0] - q


def test_friction_over_the_joint_is_never_less_than_its_least():
    at = [limit("friction.position", moment("slider", [[x]], [[0.0]]), 0.2, 0.5, 0.0, 1.0)
          for x in (0.0, 0.25, 0.75)]  # fmt: skip
    assert at == pytest.approx([0.7, 1.2, 0.2])
    assert limit("friction.position", moment("slider", [[0.3]], [[0.0]]), 0.4, 0.0, 0.0, 0.0) == 0.4


WEIGHT = float(np.sin(0.5))


@pytest.mark.parametrize(
    ("fixed", "lifts", "sinks"),
    [
        # moves up if u (1 - motor) > w (1 + external), down if u (1 + motor) < w (1 - external)
        ({"friction.load_direction": (0.3, 0.1)}, 1.1 / 0.7, 0.9 / 1.3),
        ({"friction.load_direction": (0.0, 0.4)}, 1.4, 0.6),
        ({"friction.load": 0.2}, 1.2 / 0.8, 0.8 / 1.2),
        ({"friction.load_direction": (0.2, 0.2)}, 1.2 / 0.8, 0.8 / 1.2),
        # moves up if u - w > c (u + w) + d w^2, down if w - u > c (u + w) + d u^2, here with c = 0
        (
            {"friction.load_quadratic": (0.0, 0.5)},
            1 + 0.5 * WEIGHT,
            (np.sqrt(1 + 2 * WEIGHT) - 1) / WEIGHT,
        ),
        ({"friction.load_quadratic": (0.2, 0.5)}, (1.2 + 0.5 * WEIGHT) / 0.8, None),
    ],
)
def test_a_loaded_gear_lifts_and_sinks_beyond_its_drive_and_back_drive_lines(fixed, lifts, sinks):
    assert moved(fixed, 1.01 * lifts * WEIGHT) > 5e-4
    assert moved(fixed, 0.99 * lifts * WEIGHT) == 0.0
    if sinks:
        assert moved(fixed, 1.01 * sinks * WEIGHT) == 0.0
        assert moved(fixed, 0.99 * sinks * WEIGHT) < -5e-4


def test_what_helps_the_drive_is_not_transmitted():
    helped = moment("pendulum", [[0.5]], [[0.0]], inputs=[-WEIGHT], **HEAVY)
    assert limit("friction.load_quadratic", helped, 0.0, 0.5) == 0.0
    assert limit("friction.load_direction", helped, 0.3, 0.1) == pytest.approx(0.2 * WEIGHT)


def test_a_drive_that_does_not_brake_at_all_lets_things_roll_on():
    times = np.arange(0, 2, 0.01)
    for c in (1.0, 1.4):
        _, v = slide(times, {"supply.braking": c}, 2.0, -2.0, v=1.5)
        assert v == pytest.approx(np.full(times.size, 1.5), abs=1e-9), "no more than all is lost"


def test_stribeck_friction_holds_up_to_its_greatest_level():
    times, c = np.arange(0, 2, 0.01), {"friction.stribeck": [1.0, 0.5, 0.05]}
    assert not slide(times, c, 1.0, 1.49)[0].any()
    _, v = slide(times, c, 1.0, 1.51)
    assert v[-1] > 0.3
    assert np.diff(v)[-10:] / 0.01 == pytest.approx(
        0.51, abs=1e-3
    )  # only the Coulomb level remains


STIFFNESS = 0.5 * 200.0 * 0.00287738 * 7.4 / 4.0  # kt kp voltage / resistance, N m / rad


def turn(times, fixed, goal, constants=None, **initial):
    """Return the angle of a servo, (T,)."""
    inputs = {"goal": np.broadcast_to(goal, times.shape), "torque_enable": np.ones(times.size)}
    return run("servo", times, fixed, [0.5, 4.0, 2e-3], inputs, constants, **initial)[:, 0]


@pytest.mark.parametrize("begin", [0.95, 1.04, 1.3, 0.2])
def test_a_servo_with_a_dead_zone_rests_where_it_first_comes_within_it(begin):
    times = np.arange(0, 6, 0.01)
    q = turn(times, {"servo.deadband": 0.06}, 1.0, FREE, q=begin)
    if abs(begin - 1.0) < 0.06:
        assert q == pytest.approx(begin, abs=1e-12)
    else:
        # at the edge of the dead zone it is driven no further, and damped by its back EMF
        assert abs(q[-1] - 1.0) <= 0.06 + 1e-3
        assert abs(turn(times, {}, 1.0, FREE, q=begin)[-1] - 1.0) < 1e-3


def test_gravity_pulls_a_servo_by_the_dead_zone_further_down():
    times, width = np.arange(0, 8, 0.01), 0.05
    fixed = {"servo.deadband": width}
    plain, dead = (turn(times, f, 1.0, q=0.9)[-1] for f in ({}, fixed))
    for q, error in ((plain, 1.0 - plain), (dead, 1.0 - dead - width)):
        assert STIFFNESS * error == pytest.approx(0.49 * 9.81 * 0.1 * np.sin(q), rel=1e-5)


def test_a_servo_whose_supply_sags_hangs_lower():
    times, c = np.arange(0, 8, 0.01), 0.5
    q = turn(times, {"supply.sag": c}, 1.0, q=0.9)[-1]
    wanted = STIFFNESS * (1.0 - q)
    assert wanted / (1 + c * wanted) == pytest.approx(0.49 * 9.81 * 0.1 * np.sin(q), rel=1e-5)
