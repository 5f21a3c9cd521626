"""Tests of sample thinning for recordings sampled much faster than the robot moves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.core.plugin_registries import simulators
from bench.logs.sample_thinning import thin_recording
from sims.recording.recording import Recording, Run

RNG = np.random.default_rng(3)
NOISE = 1e-4


def run(rate, motion, seconds=4.0, noise=NOISE, linear=frozenset()):
    """Return a run with one channel at a sample rate in Hz and a ramp as its input."""
    times = np.arange(int(seconds * rate) + 1) / rate
    values = motion(times) + noise * RNG.standard_normal(times.size)
    return Run("1", times, {"q": values}, {"u": 2.0 * times}, {}, {}, False, linear=linear)


def recording(*runs):
    return Recording(Path("log.csv"), "robot", "", {}, {}, tuple(runs))


def slow(times):
    return np.sin(2.0 * np.pi * 1.5 * times)


def shaken(times):
    """Add a vibration of 60 Hz with an amplitude of 0.01 rad to the slow motion."""
    return slow(times) + 0.01 * np.sin(2.0 * np.pi * 60.0 * times)


class Robot:
    has_model = True


@pytest.mark.parametrize(("rate", "every"), [(500, 5), (1000, 10), (800, 8)])
def test_a_slow_motion_is_thinned_to_a_hundred_hertz(rate, every):
    found, note = thin_recording(recording(run(rate, slow)), Robot)
    (kept,) = found.runs
    assert np.median(np.diff(kept.times)) == pytest.approx(every / rate)
    assert kept.channels["q"].size == kept.times.size
    assert f"one sample in {every}" in note


def test_a_vibration_is_kept():
    found, note = thin_recording(recording(run(1000, shaken)), Robot)
    (kept,) = found.runs
    # A spline needs about five samples per period; at least half of this is required here.
    assert np.median(np.diff(kept.times)) < 1.0 / (2.5 * 60.0)
    assert "one sample in" in note


def test_inputs_that_are_held_take_their_mean():
    found, _ = thin_recording(recording(run(500, slow)), Robot)
    (kept,) = found.runs
    # The mean of a ramp held over five steps of 2 ms is its value 4 ms after the first sample.
    np.testing.assert_allclose(kept.inputs["u"][:-1], 2.0 * (kept.times[:-1] + 0.004), atol=1e-9)


def test_inputs_that_go_straight_are_taken_at_the_samples():
    found, _ = thin_recording(recording(run(500, slow, linear=frozenset({"u"}))), Robot)
    (kept,) = found.runs
    np.testing.assert_allclose(kept.inputs["u"], 2.0 * kept.times, atol=1e-12)


def test_usual_rates_short_runs_and_gaps_are_left_alone():
    gaps = run(500, slow)
    gaps.channels["q"][::4] = np.nan
    for one in (run(250, slow), run(500, slow, seconds=0.1), gaps):
        whole = recording(one)
        assert thin_recording(whole, Robot)[0] is whole


def test_a_system_without_a_model_file_is_left_alone():
    whole = recording(run(1000, slow))
    assert thin_recording(whole, simulators.get("pendulum"))[0] is whole


def test_all_runs_must_be_slow():
    runs = [replace(run(1000, motion), name=name) for name, motion in (("1", slow), ("2", shaken))]
    found, _ = thin_recording(recording(*runs), Robot)
    intervals = {float(np.median(np.diff(one.times)).round(9)) for one in found.runs}
    assert len(intervals) == 1
    assert intervals.pop() < 1.0 / (2.5 * 60.0)
