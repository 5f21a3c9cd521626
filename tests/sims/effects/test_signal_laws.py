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
        ("input.gain", 0.5, [-3, -1.5, 0, 0.75, 1.5, 3]),
        ("sensor.gain", -0.5, [-1, -0.5, 0, 0.25, 0.5, 1]),
        ("input.bias", 0.5, [-1.5, -0.5, 0.5, 1, 1.5, 2.5]),
        ("sensor.bias", -0.5, [-2.5, -1.5, -0.5, 0, 0.5, 1.5]),
        ("sensor.drift", 2.0, [-1.8, -0.6, 0.6, 1.3, 2.0, 3.2]),
        ("input.deadband", 0.75, [-1.25, -0.25, 0, 0, 0.25, 1.25]),
        ("input.saturation", 0.75, [-0.75, -0.75, 0, 0.5, 0.75, 0.75]),
        ("input.saturation", -0.75, RAMP),
        ("input.deadband", -0.75, RAMP),
        ("backlash", -0.75, RAMP),
        ("input.lag", -0.1, RAMP),
        ("input.rate", -0.1, RAMP),
        ("servo.derivative", -0.1, RAMP),
        ("servo.profile", -0.1, RAMP),
        # a jump counts twice for the time c, over which the rate is computed
        ("servo.derivative", 0.1, [-4.0, 0.0, 1.0, 1.0, 1.5, 3.0]),
        ("servo.derivative", 0.2, [-4.0, -2.0, 2.0, 2.0, 2.0, 3.5]),
        ("servo.derivative", 0.05, [-3.0, -0.5, 0.5, 0.75, 1.25, 2.5]),
        ("sensor.lag", -0.1, RAMP),
    ],
)
def test_values_by_hand(name, c, expected):
    assert through(name, c, RAMP) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", ["input.delay", "sensor.delay"])
def test_delays_look_back_and_a_negative_one_ahead(name):
    t = np.array([[0.0, 0.5, 1.0]])
    assert effects.get_effect(name)().times(batch_coefficients(0.25), t).tolist() == [
        [-0.25, 0.25, 0.75]
    ]
    assert effects.get_effect(name)().times(batch_coefficients(-0.25), t).tolist() == [
        [0.25, 0.75, 1.25]
    ]


def test_a_slow_clock_lets_more_time_pass_between_its_stamps():
    assert effects.get_effect("clock.skew")().times(
        batch_coefficients(0.25), np.array([[0.0, 1.0, 4.0]])
    ).tolist() == [[0.0, 1.25, 5.0]]


def test_backlash_plays_its_width():
    there_and_back = np.concatenate([np.linspace(0, 2, 21), np.linspace(1.9, -2, 40)])
    felt = through("backlash", 0.6, there_and_back)
    assert felt[:21] == pytest.approx(
        np.maximum(np.linspace(0, 2, 21) - 0.3, 0)
    )  # starts in the middle of the play
    still = there_and_back[21:] > 2 - 0.6 - 1e-9
    assert felt[21:][still] == pytest.approx(1.7)  # a reversal costs the full width
    assert felt[21:][~still] == pytest.approx(there_and_back[21:][~still] + 0.3)


def test_backlash_starts_centred_on_the_first_value():
    assert through("backlash", 0.6, [5.2, 5.4, 5.0], start=5.0) == pytest.approx([5.0, 5.1, 5.1])


@pytest.mark.parametrize("step", [0.001, 0.1, 3.0])
@pytest.mark.parametrize("lag", [1e-15, 1e-3, 0.2, 50.0])
def test_input_lag_is_the_exact_mean_of_a_step_response(step, lag):
    ends = step * np.arange(1, 9)
    begins = ends - step
    integral = [t - lag * -np.expm1(-t / lag) for t in (begins, ends)]  # of 1 - exp(-t / lag)
    assert through("input.lag", lag, np.ones(8), step) == pytest.approx(
        (integral[1] - integral[0]) / step, abs=1e-9
    )


def test_input_lag_does_not_depend_on_how_the_time_is_divided():
    rng = np.random.default_rng(3)
    values, steps = rng.normal(size=6), rng.uniform(0.01, 0.3, size=6)
    coarse = through("input.lag", 0.1, values, steps)
    fine = through("input.lag", 0.1, np.repeat(values, 5), np.repeat(steps / 5, 5))
    assert fine.reshape(6, 5).mean(axis=1) == pytest.approx(coarse, abs=1e-12)


@pytest.mark.parametrize("step", [0.001, 0.1, 3.0])
@pytest.mark.parametrize("lag", [1e-15, 1e-3, 0.2, 50.0])
def test_sensor_lag_is_exact_on_a_ramp(step, lag):
    t = step * np.arange(1, 9)
    expected = 2 * (t - lag * -np.expm1(-t / lag))
    assert through("sensor.lag", lag, 2 * t, step) == pytest.approx(expected, abs=1e-9)


def test_sensor_lag_of_a_jump_within_a_step_settles_as_an_exponential():
    read = through("sensor.lag", 0.2, np.ones(50), 0.01, start=1.0)
    assert read == pytest.approx(np.ones(50))
    jump = through("sensor.lag", 0.2, np.concatenate([[0.0], np.ones(49)]), 0.01)
    assert np.diff(np.log(1 - jump[1:])) == pytest.approx(-0.05 * np.ones(48))


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


@pytest.mark.parametrize("lead", [0.004, 0.05, 0.3])
def test_a_d_term_on_the_error_leads_a_ramp_by_its_time(lead):
    ramp = 3.0 * 0.01 * np.arange(100) + 0.5 * 3.0 * 0.01
    led = through("servo.derivative", lead, ramp, step=0.01, start=0.0)
    begun = 0.01 * np.arange(100) > lead
    assert led[begun] == pytest.approx((ramp + 3.0 * lead)[begun], abs=1e-9)


def test_a_limit_of_the_rate_rises_straight_and_stays():
    # at 5 per second, a step of 0.1 s rises by 0.5; the means over the steps are those of a ramp
    assert through("input.rate", 5.0, [0.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.9]) == pytest.approx(
        [0.0, 0.25, 0.75, 1.25, 1.75, 2.0, 1.91]
    )


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
