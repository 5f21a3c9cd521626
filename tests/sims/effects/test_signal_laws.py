"""Tests of array functions of input and sensor effects against numbers by hand and closed forms."""

import numpy as np
import pytest

from sims import effects
from sims.core.effect import Signal
from tests.exams.robots.robot_signals import profiled
from tests.sims.effects.effect_systems import batch_coefficients


def signal(values, step=0.1, start=None):
    values = np.atleast_2d(np.array(values, dtype=float))
    steps = np.broadcast_to(step, values.shape).astype(float)
    first = np.zeros((len(values), 1)) if start is None else np.full((len(values), 1), start)
    return Signal(values, steps, first, np.cumsum(steps, axis=1))


def through(name, c, *args, **kwargs):
    effect, given = effects.get_effect(name)(), signal(*args, **kwargs)
    change = effect.feel if effect.hook == "input" else effect.read
    return change(batch_coefficients(c, count=len(given.values)), given)[0]


RAMP = np.array([-2.0, -1.0, 0.0, 0.5, 1.0, 2.0])


@pytest.mark.parametrize(
    ("name", "c", "expected"),
    [
        ("input.saturation", -0.75, RAMP),
        ("input.deadband", -0.75, RAMP),
        ("backlash", -0.75, RAMP),
        ("input.lag", -0.1, RAMP),
        ("input.rate", -0.1, RAMP),
        ("servo.derivative", -0.1, RAMP),
        ("servo.profile", -0.1, RAMP),
        # The pulse of a jump has the area c times its height, here within one step.
        ("servo.derivative", 0.1, [-4.0, 0.0, 1.0, 1.0, 1.5, 3.0]),
        ("servo.derivative", 0.2, [-6.0, 1.0, 2.0, 1.5, 2.0, 4.0]),
        ("servo.derivative", 0.05, [-3.0, -0.5, 0.5, 0.75, 1.25, 2.5]),
        ("sensor.lag", -0.1, RAMP),
    ],
)
def test_values_by_hand(name, c, expected):
    assert through(name, c, RAMP) == pytest.approx(expected, abs=1e-12)


def test_the_rate_of_a_jump_lasts_one_period_of_the_controller():
    jump = [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    expected = [0.0, 0.0, 26.0, 26.0, 1.0, 1.0]  # 1 + 0.05 s times 1 / 0.002 s
    assert through("servo.derivative", 0.05, jump, 0.001) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("step", [0.001, 0.1, 3.0])
@pytest.mark.parametrize("lag", [1e-15, 1e-3, 0.2, 50.0])
def test_input_lag_is_the_exact_mean_of_a_step_response(step, lag):
    ends = step * np.arange(1, 9)
    begins = ends - step
    integral = [t - lag * -np.expm1(-t / lag) for t in (begins, ends)]  # of 1 - exp(-t / lag)
    assert through("input.lag", lag, np.ones(8), step) == pytest.approx(
        (integral[1] - integral[0]) / step, abs=1e-9
    )


@pytest.mark.parametrize("step", [0.001, 0.1, 3.0])
@pytest.mark.parametrize("lag", [1e-15, 1e-3, 0.2, 50.0])
def test_sensor_lag_is_exact_on_a_ramp(step, lag):
    t = step * np.arange(1, 9)
    expected = 2 * (t - lag * -np.expm1(-t / lag))
    assert through("sensor.lag", lag, 2 * t, step) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", ["input.lag", "sensor.lag"])
def test_lags_stand_still_while_an_element_waits(name):
    steps = np.array([0.1, 0.1, 0.0, 0.0])
    felt = through(name, 0.05, [1.0, 1.0, 1.0, 1.0], steps)
    assert np.isfinite(felt).all()
    assert felt[2] == felt[3]
    assert felt[1] < felt[2] < 1 if name == "input.lag" else felt[1] == felt[2] < 1


@pytest.mark.parametrize(
    "name",
    ["input.lag", "sensor.lag", "input.deadband", "backlash", "input.saturation", "servo.profile"],
)
def test_elements_that_are_off_keep_every_bit_next_to_elements_that_are_on(name):
    effect = effects.get_effect(name)()
    given = signal(np.random.default_rng(5).normal(size=(3, 40)))
    change = effect.feel if effect.hook == "input" else effect.read
    felt = change(np.array([[[0.0], [0.3], [0.0]]]), given)
    assert np.array_equal(felt[::2], given.values[::2])
    assert np.abs(felt[1] - given.values[1]).max() > 0.1


@pytest.mark.parametrize("limit", [3.0, 12.0, 60.0])
def test_a_motion_profile_is_the_shortest_way_to_commands_that_change(limit):
    """Reference: the double integrator's own solution, exact between commands."""
    h = 0.001
    rng = np.random.default_rng(7)
    stamps, values = np.arange(0, 4, 0.125), np.repeat(rng.uniform(-1, 1, 8), 4)
    values[9:20] += rng.uniform(-0.3, 0.3, 11)
    wanted, fine = profiled(values, stamps, limit)
    commanded = values[np.searchsorted(stamps, fine + 1e-9, side="right") - 1]
    went = through("servo.profile", limit, commanded, h, start=values[0])
    assert went == pytest.approx(wanted, abs=2 * limit * h**2)
    assert np.abs(went - commanded).max() > 0.1


def test_a_motion_profile_stands_still_while_an_element_waits():
    steps = np.array([0.1, 0.1, 0.0, 0.0, 0.1])
    went = through("servo.profile", 2.0, np.ones(5), steps)
    assert went == pytest.approx([0.01 / 3, 0.07 / 3, 0.04, 0.04, 0.19 / 3])
