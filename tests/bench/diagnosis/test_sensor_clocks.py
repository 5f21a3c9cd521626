"""Tests of clock errors in logs, and of hidden effects in them, on sliders simulated with SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.diagnosis.explain import explain
from bench.logs.quality.log_quality import check_log_quality
from bench.logs.recording_loading import load_recording
from tests.bench.diagnosis.simulated_logs import write_log

NOISE, MASS, INTERVAL = 1e-3, 2.0, 0.02
SLIDER = f'system = "slider"\n[channels.x]\nunit = "m"\nnoise = {NOISE}\n[inputs.u]\nunit = "N"\n'


def motion(begin, end, state, force, coulomb):
    """Return position and speed as a function of time; a closed form if there is no friction."""
    if not coulomb:
        x, v = state
        return lambda t: np.array(
            [x + (t - begin) * (v + force / MASS * (t - begin) / 2), v + force / MASS * (t - begin)]
        )

    def rate(_, state):
        return [state[1], (force - coulomb * np.tanh(state[1] / 1e-3)) / MASS]

    return solve_ivp(
        rate, (begin, end), state, rtol=1e-8, atol=1e-10, max_step=0.01, dense_output=True
    ).sol


def log(folder, coulomb, stamp=None, lost=0.0, drift=0.0, seed=0, seconds=6.0):
    """Write three runs with a force that changes and a position that is read at every stamp.

    Args:
        coulomb: dry friction in N.
        stamp: function that makes time stamps from equidistant ones.
        lost: fraction of the sensor's samples that are missing.
        drift: fraction by which the sensor's clock is fast.
    """
    rng, runs = np.random.default_rng(seed), []
    for run in range(3):
        even = np.arange(0.0, seconds, INTERVAL)
        times = even if stamp is None else stamp(even, rng)
        u = 2.0 * np.sin(3 * times + run) + 1.0 * np.sin(7.3 * times)

        state, pieces = np.array([0.0, 0.5]), []
        for begin, end, force in zip(times[:-1], times[1:], u[:-1], strict=True):
            pieces.append(motion(begin, end, state, force, coulomb))
            state = pieces[-1](end)
        at = np.clip(times[0] + (times - times[0]) / (1.0 + drift), times[0], times[-1])
        inside = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(pieces) - 1)
        x = np.array([pieces[i](t)[0] for i, t in zip(inside, at, strict=True)])
        x += NOISE * rng.standard_normal(x.size)
        x[rng.random(x.size) < lost] = np.nan
        runs.append((times, u, x))
    return write_log(folder, SLIDER, "u,x", runs)


def jittered(times, rng):
    return np.sort(times + 0.2 * INTERVAL * rng.uniform(-1.7, 1.7, times.size))


CLOCKS = {
    "jitter of 20 %": {"stamp": jittered},
    "5 % of the samples lost": {"lost": 0.05},
    "5 % of the rows lost": {"stamp": lambda t, rng: t[(rng.random(t.size) > 0.05) | (t == 0)]},
    "a drift of 100 ppm": {"drift": 1e-4},
}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("coulomb", [0.0, 0.2])
def test_a_clock_hides_no_cause_and_makes_none(tmp_path, clock, coulomb):
    found = explain(log(tmp_path, coulomb, **CLOCKS[clock]))
    assert found.verdict == ("named" if coulomb else "adequate")
    assert [cause.effect for cause in found.causes] == ["friction.coulomb"] * bool(coulomb)
    if coulomb:
        (number,) = found.causes[0].coefficients.values()
        assert number.value == pytest.approx(coulomb, rel=0.02)
    assert found.answer.parameters["mass"].value == pytest.approx(MASS, rel=0.01)


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_quality_check_describes_the_clock(tmp_path, clock):
    long = 40.0 if "drift" in clock else 6.0
    found = list(
        check_log_quality(*load_recording(log(tmp_path, 0.0, seconds=long, **CLOCKS[clock])))
    )
    told = [finding.text_line for finding in found if finding.about in ("clock", "drift")]
    if clock == "5 % of the samples lost":
        # Lost samples are empty cells: the table of channels reports them, and the clock is even.
        assert told == []
    elif "drift" not in clock:
        (line,) = told
        assert ("vary by" in line) == ("jitter" in clock)
        assert ("are lost" in line) == ("rows" in clock)


def test_a_slip_in_the_only_run_is_named_at_its_stamp_and_confirmed_by_later_samples(tmp_path):
    """The log of a pendulum has stamps from 100 s on; its last third is held out."""
    times, mass, length, inertia = np.arange(0.0, 5.0, 0.02), 0.15, 0.1, 3.3e-3

    def rate(_t, state):
        return [state[1], -mass * 9.81 * length / inertia * np.sin(state[0])]

    swung = solve_ivp(rate, (0.0, 5.0), [1.0, 0.0], t_eval=times, rtol=1e-9, atol=1e-11)
    q = swung.y[0] + 0.003 * np.random.default_rng(0).standard_normal(times.size)
    q[times > 1.611] += 0.02
    description = (
        'system = "pendulum"\n[channels.q]\nunit = "rad"\nnoise = 0.003\n'
        f"[constants]\nmass = {mass}\nlength = {length}\ngravity = 9.81\n"
    )
    answer = explain(write_log(tmp_path, description, "q", [(100 + times, q)])).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect, cause.alternatives) == ("named", "sensor.slip", ())
    jump, instant = cause.coefficients["coefficient"], cause.coefficients["instant"]
    assert jump.low < 0.02 < jump.high < 0.025
    assert instant.low < 101.611 < instant.high < instant.low + 0.06
    assert answer.heldout.gap_closed > 0.9
