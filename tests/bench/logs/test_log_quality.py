"""Tests of the log quality check on SciPy simulations of linear servos, each with one fault."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from bench.logs.quality.log_quality import check_log_quality
from sims.recording.recording import Recording, Run

ARM = """<mujoco model="two"><compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="hip" axis="0 1 0" range="-2 2"/><geom size="0.1" pos="0 0 -0.3"/>
<body pos="0 0 -0.6"><joint name="knee" axis="0 1 0" range="-2 2"/>
<geom size="0.1" pos="0 0 -0.3"/></body></body></worldbody>
<actuator><position name="m_hip" joint="hip" kp="100" kv="10" ctrlrange="-1 1"/>
<position name="m_knee" joint="knee" kp="100" kv="10" ctrlrange="-1 1"/></actuator></mujoco>"""
RATE, SECONDS, NOISE = 100.0, 40.0, 1e-3
JOINTS = {"hip": 12.0, "knee": 20.0}
"""Natural frequency of each servo in rad/s."""


def multisine(t, rng):
    frequencies = rng.uniform(0.2, 3.0, 12)
    phases = rng.uniform(0, 2 * np.pi, 12)
    return 0.12 * np.sin(2 * np.pi * frequencies * t[:, None] + phases).sum(axis=1)


def followed(u, w, fine):
    """Return the exact response of a second-order servo with damping 0.7 to held commands."""
    a, b = [1.0, 1.4 * w, w * w], [w * w]
    numerator, denominator, _ = cont2discrete((b, a), 1.0 / fine)
    return lfilter(np.ravel(numerator), denominator, u)


def run_of(seed, name="1", stamp=lambda t, rng: t, late=lambda t: t, seconds=SECONDS):
    """Simulate a run with stamps `stamp(t, rng)` whose sensors are read at `late(stamp)`."""
    rng, fine = np.random.default_rng(seed), 1000.0
    t = stamp(np.arange(0.0, seconds, 1.0 / RATE), rng)
    whole = np.arange(0.0, seconds + 1.0, 1.0 / fine)
    channels, inputs = {}, {}
    for joint, w in JOINTS.items():
        smooth = multisine(whole, rng)
        held = np.interp(t, whole, smooth)
        u = held[np.clip(np.searchsorted(t, whole, side="right") - 1, 0, t.size - 1)]
        q = followed(u, w, fine)
        v = np.gradient(q, 1.0 / fine)
        inputs[f"u.m_{joint}"] = held
        channels[f"q.{joint}"] = np.interp(late(t), whole, q) + NOISE * rng.normal(size=t.size)
        channels[f"qd.{joint}"] = np.interp(late(t), whole, v) + 5 * NOISE * rng.normal(size=t.size)
    return Run(name, t, channels, inputs, {}, {}, False)


def recording_of(*runs, noise=None):
    return Recording(Path("log.csv"), "two", "", {}, noise or {}, tuple(runs))


def found(kind, *runs, noise=None):
    return list(check_log_quality(recording_of(*runs, noise=noise), kind))


def changed(run, **signals):
    """Return the run with changed channels: `signals` maps channel names, with _ for the dot, to
    functions.
    """
    changes = {name.replace("_", ".", 1): change for name, change in signals.items()}
    return replace(
        run, channels={n: changes.get(n, lambda y: y)(y.copy()) for n, y in run.channels.items()}
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_sound_log_has_no_finding(kind, seed):
    assert found(kind, run_of(seed)) == []


def test_jitter(kind):
    run = run_of(1, stamp=lambda t, rng: np.sort(t + 0.2 / RATE * rng.normal(size=t.size)))
    (finding,) = found(kind, run)
    assert finding.about == "clock"
    # Two stamps that are each off by 20 % give an interval that is off by 20 % * sqrt(2) = 28 %.
    assert "vary by 2" in finding.text
    assert int(finding.text.split("by ")[1].split("%")[0]) == pytest.approx(28, abs=3)
    assert "its own stamp" in finding.remedy


def test_lost_samples(kind):
    def thin(t, rng):
        return t[(rng.random(t.size) > 0.05) | (t == 0)]

    (finding,) = found(kind, run_of(2, stamp=thin))
    assert finding.about == "clock"
    assert finding.text.startswith(("19", "20", "21", "18"))
    assert "are lost in 1" in finding.text


def test_stamps_of_commands_are_no_samples(kind):
    """Command stamps between two sensor stamps do not count as lost sensor samples."""
    run = run_of(4)
    times = np.sort(np.concatenate([run.times, run.times + 1e-5]))

    def sensed(values):
        cells = np.full(times.size, np.nan)
        cells[::2] = values
        return cells

    channels = {name: sensed(values) for name, values in run.channels.items()}
    inputs = {name: np.repeat(values, 2) for name, values in run.inputs.items()}
    spread = replace(run, times=times, channels=channels, inputs=inputs)
    assert [one.text for one in found(kind, spread) if one.about == "clock"] == []
    lost = {name: sensed(values) for name, values in run.channels.items()}
    for values in lost.values():
        values[200:400] = np.nan
    (finding,) = (one for one in found(kind, replace(spread, channels=lost)))
    assert finding.text.startswith("100 samples")


def test_samples_that_came_twice(kind):
    run = run_of(3)
    again = np.flatnonzero(np.random.default_rng(0).random(run.times.size) < 0.03)[1:]
    channels = {name: values.copy() for name, values in run.channels.items()}
    for values in channels.values():
        values[again] = values[again - 1]
    (finding,) = found(kind, replace(run, channels=channels))
    assert "repeat the one before" in finding.text
    count = int(finding.text.split()[0])
    assert 0.85 * again.size <= count <= again.size


@pytest.mark.parametrize("ppm", [100.0, -250.0])
def test_drift(kind, ppm):
    """A sensor clock that is fast by e shows t at the true time t / (1 + e)."""
    runs = [run_of(seed, str(seed), late=lambda t: t / (1 + ppm * 1e-6)) for seed in range(4)]
    (finding,) = found(kind, *runs)
    assert finding.about == "drift"
    assert ("fast" if ppm > 0 else "slow") in finding.text
    said = float(finding.text.split("runs ")[1].split(" ppm")[0])
    error = float(finding.text.split("±")[1].split(")")[0])
    assert said == pytest.approx(abs(ppm), abs=1.5 * error)
    assert error < 60


def test_an_interval_of_drift_holds():
    """In clean logs, the estimated drift is within two sigmas of zero in about 95 % of cases."""
    from bench.logs.quality import clock_checks

    inside = 0
    for seed in range(24):
        (one,) = clock_checks._estimate_run_drifts(run_of(seed, seconds=12.0), "u.m_hip", "q.hip")
        inside += abs(one.drift) < 2 * one.error
    assert inside >= 20


def test_coarse_steps(kind):
    def coarse(y):
        return 0.05 * np.round(y / 0.05)

    (finding,) = found(kind, changed(run_of(4), q_hip=coarse))
    assert finding.about == "quantisation"
    assert "0.05" in finding.text


def test_steps_that_the_stated_noise_does_not_know(kind):
    def stepped(y):
        return 0.01 * np.round(y / 0.01)

    run = changed(run_of(5), q_knee=stepped)
    (finding,) = found(kind, run, noise={"q.knee": 1e-4})
    assert finding.remedy == "state noise = 0.0029 or more"


def test_a_sensor_at_its_end(kind):
    (finding,) = found(kind, changed(run_of(6), q_knee=lambda y: np.minimum(y, 0.3)))
    assert finding.about == "saturation"
    assert "q.knee stays at its highest value, 0.3 rad" in finding.text


def test_commands_beyond_their_range(kind):
    run = run_of(7)
    run = replace(run, inputs={**run.inputs, "u.m_hip": 4 * run.inputs["u.m_hip"]})
    texts = [f.text for f in found(kind, run) if f.about == "saturation"]
    assert len(texts) == 1
    assert "u.m_hip is at or beyond its range, -1 to 1" in texts[0]


def test_stillness(kind):
    def stop_moving(y):
        noise = NOISE * np.random.default_rng(1).normal(size=y.size)
        return np.where(np.arange(y.size) < 0.7 * y.size, y[0] + noise, y)

    run = changed(run_of(8), q_hip=stop_moving, qd_hip=lambda y: np.nan * y)
    texts = [f.text for f in found(kind, run) if f.about == "stillness"]
    assert texts == ["q.hip (70%) of the samples are at rest"]


@pytest.mark.parametrize(
    ("change", "text", "remedy"),
    [
        (lambda v: -v, "q.hip moves -", "sign"),
        (lambda v: np.rad2deg(v), "moves 0.017", "one of the two is in degrees"),
        (lambda v: 1e-3 * v, "moves 1e+03", "one of the two is in thousandths"),
        (lambda v: 1.3 * v, "moves 0.77", "gain"),
        (lambda v: np.random.default_rng(0).permutation(v), "does not match", "another joint"),
        (lambda v: np.roll(v, 2), "behind the derivative", "filtered"),
    ],
)
def test_a_velocity_that_is_not_the_derivative(kind, change, text, remedy):
    (finding,) = found(kind, changed(run_of(9), qd_hip=change))
    assert finding.about == "contradiction"
    assert text in finding.text
    assert remedy in finding.remedy


def test_how_far_a_velocity_is_behind(kind):
    (finding,) = found(kind, changed(run_of(10), qd_knee=lambda v: np.roll(v, 2)))
    said = float(finding.text.split("is ")[1].split(" ms")[0])
    assert said == pytest.approx(20.0, abs=2.0)
