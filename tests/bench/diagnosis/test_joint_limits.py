"""Tests of a hidden end stop, on a slider simulated with SciPy that reaches it at times."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.report_tables import table

MASS, NOISE, INTERVAL, SAMPLES = 1.2, 1e-3, 0.02, 100


def path(force, speed, stiffness, place, loss):
    """Return positions (SAMPLES,) with Hertz contact beyond `place`, integrated per command."""

    def rate(_t, state, u):
        depth = max(state[0] - place, 0.0)
        stop = stiffness * depth**1.5 / 0.1 * max(1.0 + loss * state[1], 0.0)
        return [state[1], (u - stop) / MASS]

    state, x = np.array([0.0, speed]), [0.0]
    for u in force[:-1]:
        done = solve_ivp(
            rate, (0.0, INTERVAL), state, args=(u,), rtol=1e-8, atol=1e-10, max_step=2e-3
        )
        state = done.y[:, -1]
        x.append(state[0])
    return np.array(x)


def test_an_end_stop_is_named_with_its_place_and_what_it_takes(tmp_path):
    stiffness, place, loss = 1500.0, 0.45, 0.4
    rng, runs = np.random.default_rng(3), []
    times = INTERVAL * np.arange(SAMPLES)
    for run, speed in enumerate((0.4, 0.25, 0.3)):
        force = np.where(times % 1.0 < 0.5, 2.0 + 0.6 * run, -2.0 - 0.6 * run)
        x = path(force, speed, stiffness, place, loss)
        runs.append((times, x + NOISE * rng.standard_normal(SAMPLES), force))
    log = table(tmp_path, runs, ["x"], "slider", {"x": NOISE}, ["u"])
    answer = explain(log).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect, cause.alternatives) == ("named", "state.limit", ())
    found = cause.coefficients
    assert found["place"].value == pytest.approx(place, abs=0.005)
    assert found["loss"].value == pytest.approx(loss, abs=0.02)
    assert 0.6 * stiffness < found["stiffness"].value < 1.6 * stiffness
    assert answer.heldout.gap_closed > 0.97
