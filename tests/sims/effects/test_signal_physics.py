"""Tests of effects on inputs and sensors on the batch engine, against closed forms."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.systems.slider import Slider
from tests.sims.effects.effect_systems import run

TIMES = np.arange(0, 3, 0.02)
STEP = np.where(TIMES >= 0.5 - 1e-9, 2.0, 0.0)  # N, from 0.5 s on


def slide(fixed, u=0.0, times=TIMES, mass=2.0, **initial):
    """Return x and v, each (T,)."""
    return run("slider", times, fixed, [mass], {"u": np.broadcast_to(u, times.shape)}, **initial).T


def compute_applied_input(fixed, u, times=TIMES):
    """Return the input applied to a slider of 2 kg between samples, from velocity differences."""
    return 2.0 * np.diff(slide(fixed, u, times)[1]) / np.diff(times)


@pytest.mark.parametrize(
    ("delay", "within"), [(0.1, 1e-9), (0.1234, 0.02**2 / 8), (0.003, 0.02**2 / 8)]
)
def test_input_delay_is_an_exact_shift(delay, within):
    """The impulse is exact; the position error comes from using the mean input over the step in
    which the jump arrives.
    """
    x, v = slide({"input.delay": delay}, STEP)
    since = np.maximum(TIMES - 0.5 - delay, 0.0)
    assert v == pytest.approx(since, abs=1e-9)  # 2 N on 2 kg
    assert x == pytest.approx(since**2 / 2, abs=within)


def moved(effects=(), coefficients=(), **stated):
    """Simulate a driven slider with additional properties of its inputs in the recording."""
    times = np.arange(0, 3, 0.02)
    given = Scenario(times, {}, {"u": 2 * np.sin(4 * times)}, **stated)
    return Slider(effects=list(effects)).simulate(np.array([[2.0, *coefficients]]), given)[0]


def test_what_a_recording_states_is_what_the_effects_do():
    straight = moved(linear=frozenset({"u"}))
    assert straight == pytest.approx(moved(["input.hold"], [1.0]), abs=1e-9)
    assert moved(["input.hold"], [1.0], linear=frozenset({"u"})) == pytest.approx(moved(), abs=1e-9)
    for late in (0.013, -0.013):
        assert moved(offset=late) == pytest.approx(moved(["input.delay"], [late]), abs=2e-5)
    assert np.abs(straight - moved()).max() > 1e-3


def test_a_straight_command_moves_a_slider_as_its_integral_says():
    ramp = Scenario(np.arange(0, 2.01, 0.5), {}, {"u": 3.0 * np.arange(0, 2.01, 0.5)}, linear={"u"})
    x, v = Slider().simulate(np.array([[2.0]]), ramp)[0].T
    assert v == pytest.approx(0.75 * ramp.times**2, abs=1e-9)  # 3 t on 2 kg
    assert x == pytest.approx(0.25 * ramp.times**3, abs=1e-4)


def test_a_chain_starts_settled():
    """A lag after a gain and a bias begins at their output for the first value, not at the
    command.
    """
    fixed = {"input.gain": 0.5, "input.bias": 0.2, "input.lag": 0.3}
    assert compute_applied_input(fixed, 2.0) == pytest.approx(3.2, abs=1e-9)
    readings, _ = slide({"sensor.gain": 0.5, "sensor.bias": 0.2, "sensor.lag": 0.3}, x=2.0)
    assert readings == pytest.approx(3.2, abs=1e-12)


def test_a_slip_before_the_run_is_a_bias():
    times = np.arange(0, 1, 0.01)
    slipped = run("pendulum", times + 7.0, {"sensor.slip": (0.03, 3.0)}, q=0.8)
    assert slipped == pytest.approx(run("pendulum", times, {"sensor.bias": 0.03}, q=0.8), abs=1e-12)
