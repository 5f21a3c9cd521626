"""Tests of drive effects other than the simplest laws: the batch engine against closed forms."""

import numpy as np
import pytest

from tests.sims.effects.effect_systems import moment, run
from tests.sims.effects.test_force_laws import limit

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


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_friction_over_the_joint_takes_its_work(direction):
    least, sine, cosine, period, mass = 0.1, 0.3, -0.4, 0.7, 1.5
    times = np.arange(0, 2, 0.01)
    fixed = {"friction.position": (least, sine, cosine, period)}
    x, v = slide(times, fixed, mass, x=0.2, v=1.5 * direction)

    def work(at):
        angle = 2 * np.pi * at / period
        wave = -sine * np.cos(angle) + cosine * np.sin(angle)
        return (least + 0.5) * at + period / (2 * np.pi) * wave

    taken = direction * (work(x) - work(0.2))
    assert 0.5 * mass * v**2 == pytest.approx(0.5 * mass * 1.5**2 - taken, abs=2e-5)
    assert np.ptp(x) > 1.5 * period


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


def test_a_joint_that_warms_loses_friction():
    times, mass, time = np.arange(0, 4, 0.01), 1.5, 0.8
    cold = -np.expm1(-times / time)
    _, v = slide(times, {"friction.warming": (0.9, 0.0, time)}, mass, v=2.0)
    assert v == pytest.approx(2.0 - 0.9 * time / mass * cold, abs=1e-6)
    _, v = slide(times, {"friction.warming": (0.0, 0.7, time)}, mass, v=2.0)
    assert v == pytest.approx(2.0 * np.exp(-0.7 * time / mass * cold), abs=1e-6)


def test_what_a_cold_joint_holds_it_lets_go_when_it_is_warm():
    times, time = np.arange(0, 4, 0.01), 1.0
    x, _ = slide(times, {"friction.warming": (2.0, 0.0, time)}, 1.0, u=1.0)
    begins = time * np.log(2.0)  # time at which friction falls from 2 N below 1 N
    assert not x[times < begins - 0.02].any()
    # v = (t - t0) - 2 (exp(-t0) - exp(-t))
    late = times[-1] - begins
    expected = late**2 / 2 - late + (1 - np.exp(-late))
    assert x[-1] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("u", [0.5, -3.0, 40.0])
def test_a_supply_that_sags_gives_what_its_voltage_leaves(u):
    """The force follows F = U (1 - c |F|) and stays below 1 / c."""
    times, c, mass = np.arange(0, 1, 0.01), 0.1, 2.0
    _, v = slide(times, {"supply.sag": c}, mass, u)
    force = mass * v[-1] / times[-1]
    assert force == pytest.approx(u * (1 - c * abs(force)), rel=1e-9)
    assert abs(force) < min(abs(u), 1 / c)


def test_a_servo_whose_supply_sags_hangs_lower():
    times, c = np.arange(0, 8, 0.01), 0.5
    inputs = {"goal": np.full(times.size, 1.0), "torque_enable": np.ones(times.size)}
    q = run("servo", times, {"supply.sag": c}, [0.5, 4.0, 2e-3], inputs, q=0.9)[-1, 0]
    stiffness = 0.5 * 200.0 * 0.00287738 * 7.4 / 4.0
    wanted = stiffness * (1.0 - q)
    assert wanted / (1 + c * wanted) == pytest.approx(0.49 * 9.81 * 0.1 * np.sin(q), rel=1e-5)


@pytest.mark.parametrize("c", [0.3, 0.75, -0.5, 0.0])
def test_a_drive_that_hardly_brakes_turns_round_late_and_starts_as_ever(c):
    """A force against the motion is reduced to the fraction 1 - c; the way back is not reduced."""
    times, mass, v0, u = np.arange(0, 6, 0.01), 2.0, 1.5, -2.0
    _, v = slide(times, {"supply.braking": c}, mass, u, v=v0)
    braked = u * (1 - max(c, 0.0)) / mass
    turned = -v0 / braked
    wanted = np.where(times < turned, v0 + braked * times, u / mass * (times - turned))
    assert v == pytest.approx(wanted, abs=1e-6)


def test_a_drive_that_does_not_brake_at_all_lets_things_roll_on():
    times = np.arange(0, 2, 0.01)
    for c in (1.0, 1.4):
        _, v = slide(times, {"supply.braking": c}, 2.0, -2.0, v=1.5)
        assert v == pytest.approx(np.full(times.size, 1.5), abs=1e-9), "no more than all is lost"


@pytest.mark.parametrize(("u", "force"), [(2.0, 6.0), (-2.0, -6.0), (1.0, 1.5), (0.0, 0.0)])
def test_a_propeller_pulls_with_the_square_of_its_input(u, force):
    times = np.arange(0, 1, 0.01)
    x, _ = slide(times, {"input.power": (0.5, 1.0)}, 2.0, u)
    assert x == pytest.approx(force / 2.0 * times**2 / 2, abs=1e-9)
