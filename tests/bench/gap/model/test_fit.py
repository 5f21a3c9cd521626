from dataclasses import replace

import numpy as np
import pytest

from bench.gap.model.arrow import arrow_step
from bench.gap.model.fit import MEASURED, UNMEASURED, Fitter, Start, prior_of
from sims.ball.simulator import Ball
from sims.pendulum.simulator import Pendulum
from tests.bench.gap.made import changed, recorded, recording, white, with_runs, world

TRUTH = 2.7e-3


def swings():
    """Runs of different lengths and rates, without noise."""
    parts = [(0.7, 50, 60), (-1.2, 80, 130), (2.2, 100, 90)]
    made = [recorded(Pendulum(), [TRUTH], [{"q": q}], np.arange(n) / rate) for q, rate, n in parts]
    return with_runs(made[0], [part.runs[0] for part in made])


def fitted(there, theta=None, sigma=1e-3, iterations=30, states=None, effects=(), **options):
    theta = there.nominal() if theta is None else theta
    start = Start(effects, theta, there.guess if states is None else states)
    return Fitter(there, white(there, sigma), **options).fit([start], iterations)[0]


def test_parameters_and_initial_states_of_noiseless_runs_come_back():
    there = world(swings())
    fit = fitted(there)
    assert there.observed.shape == (3, 130, 2)
    assert fit.theta[0] == pytest.approx(TRUTH, rel=2e-5)
    np.testing.assert_allclose(fit.states, [[0.7, 0], [-1.2, 0], [2.2, 0]], atol=1e-3)
    seen = np.isfinite(there.observed)
    assert np.abs(fit.simulated - there.observed)[seen].max() < 1e-3  # the noise, in rad/s
    assert fit.cost < 60, "sum of squares over 560 samples in units of a noise of 1e-3"
    assert not seen[0, 60:].any()


def test_restitution_and_six_initial_states_of_noiseless_bounces():
    times = np.arange(90) / 60
    starts = [{"z": 2.0, "vx": 1.0, "vz": 0.5}, {"z": 3.0, "y": 0.3, "vy": -0.7}]
    there = world(recorded(Ball(observe=["x", "y", "z"]), [0.72], starts, times))
    fit = fitted(there)
    assert fit.theta[0] == pytest.approx(0.72, abs=2e-5)
    np.testing.assert_allclose(fit.states[0], [0, 0, 2, 1, 0, 0.5], atol=1e-4)
    np.testing.assert_allclose(fit.states[1], [0, 0.3, 3, 0, -0.7, 0], atol=1e-4)


def test_an_effect_is_fitted_with_the_parameters():
    made = recording(effects=["drag.linear=8e-4"], theta=["2.7e-3"], runs=2, seconds=1.5, rate=60)
    there = world(made, candidates=["drag.linear", "friction.coulomb"])
    fit = fitted(there, effects=("drag.linear",))
    assert list(fit.free) == [0, 1]
    assert fit.theta[0] == pytest.approx(TRUTH, rel=1e-4)
    assert fit.theta[1] == pytest.approx(8e-4, rel=1e-3)
    assert fit.theta[2] == 0


def test_the_jacobian_is_the_derivative():
    there = world(swings(), candidates=["drag.linear"])
    fit = fitted(there, effects=("drag.linear",))
    runs = np.arange(3)
    for column, step in ((0, 1e-6), (1, 1e-6)):
        moved = np.tile(fit.theta, (2, 1))
        moved[:, column] += [step, 2 * step]  # drag cannot be negative
        one, two = (there.simulate(np.tile(theta, (3, 1)), runs, fit.states) for theta in moved)
        forward = (4 * one - two - 3 * fit.simulated) / (2 * step)
        near = np.isfinite(forward)
        scale = np.abs(forward[near]).max()
        np.testing.assert_allclose(
            fit.jacobian[..., column][near], forward[near], atol=0.02 * scale
        )


def test_several_models_in_one_call_equal_one_by_one():
    there = world(swings(), candidates=["drag.linear", "friction.coulomb", "sensor.delay"])
    starts = []
    for effects, inertia in (
        ((), 2e-3),
        (("drag.linear",), 4e-3),
        (("sensor.delay",), 3e-3),
        ((), 6e-3),
    ):
        theta = there.nominal()
        theta[0] = inertia
        starts.append(Start(effects, theta, there.guess))
    fitter = Fitter(there, white(there, 1e-3))
    together, alone = fitter.fit(starts, 6), [fitter.fit([start], 6)[0] for start in starts]
    for a, b in zip(together, alone, strict=True):
        assert a.effects == b.effects
        np.testing.assert_allclose(a.theta, b.theta, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(a.states, b.states, rtol=1e-9, atol=1e-12)
        assert a.cost == pytest.approx(b.cost, rel=1e-6, abs=1e-9)


def test_missing_samples_change_nothing_but_what_is_known():
    rng = np.random.default_rng(3)
    runs = []
    for run in swings().runs:
        lost = {name: rng.random(run.times.size) < 0.4 for name in ("q", "qd")}
        holes = {n: (lambda v, n=n, lost=lost: np.where(lost[n], np.nan, v)) for n in lost}
        runs.append(changed(run, **holes))
    there = world(replace(swings(), runs=tuple(runs)))
    fit = fitted(there)
    assert np.isnan(there.observed).sum() > 200
    assert fit.theta[0] == pytest.approx(TRUTH, rel=2e-5)
    np.testing.assert_allclose(fit.states[:, 0], [0.7, -1.2, 2.2], atol=1.5e-4)


def test_only_the_first_share_counts():
    def spoilt(values):
        values[values.size // 2 :] = 50.0
        return values

    runs = tuple(changed(run, q=spoilt, qd=spoilt) for run in swings().runs)
    there = world(replace(swings(), runs=runs))
    assert fitted(there, share=0.45).theta[0] == pytest.approx(TRUTH, rel=1e-4)
    assert abs(fitted(there).theta[0] / TRUTH - 1) > 0.05


def test_bounds_are_kept():
    runaway = Pendulum(fixed={"drag.linear": -5e-4})  # motion that feeds itself
    made = recorded(runaway, [TRUTH], [{"q": 0.8}, {"q": 1.3}], np.arange(80) / 60)
    there = world(made, candidates=["drag.linear"])
    theta = there.nominal()
    theta[1] = 1e-4
    fit = fitted(there, theta, effects=("drag.linear",))
    assert fit.theta[1] == 0.0, "drag that pushes is none"
    heavy = recorded(
        Pendulum({"gravity": 0.981}), [6e-3], [{"q": 0.8}, {"q": 1.3}], np.arange(80) / 60
    )
    there = world(replace(heavy, constants={**heavy.constants, "gravity": 9.81}))
    assert fitted(there, np.array([8e-3, *there.nominal()[1:]])).theta[0] == 1e-2, (
        "an inertia of 6e-2 would be needed"
    )


def test_frozen_parameters_and_known_initial_states_stay():
    made = swings()
    told = tuple(
        replace(run, initial={"q": q}) for run, q in zip(made.runs, (0.71, -1.2, 2.2), strict=True)
    )
    there = world(replace(made, runs=told))
    fit = fitted(there)
    np.testing.assert_array_equal(fit.states[:, 0], [0.71, -1.2, 2.2])
    assert (there.known == [[True, False]] * 3).all()
    assert np.abs(fit.states[1:, 1]).max() > 0
    frozen = fitted(world(made), frozen=frozenset({0}))
    assert frozen.theta[0] == 3.3e-3
    assert frozen.free.size == 0
    alone = fitted(world(made), parameters=False)
    assert alone.theta[0] == 3.3e-3
    assert alone.cost > 1e3 * fitted(world(made)).cost


def test_what_is_known_beforehand_depends_on_the_channels():
    made = recording(runs=1, seconds=0.5, observe=["q"])
    np.testing.assert_array_equal(prior_of(world(made)), [MEASURED, MEASURED])
    only_rate = recording(runs=1, seconds=0.5, observe=["qd"])
    np.testing.assert_array_equal(prior_of(world(only_rate)), [UNMEASURED, MEASURED])


def dense_step(residual, jacobian, q, drift, prior, known):
    """The undamped step of all unknowns at once, by ordinary least squares."""
    runs, s = drift.shape
    rows, right = [], []
    for r in range(runs):
        j = jacobian[r].reshape(-1, q + s)
        own = np.zeros((len(j), runs * s))
        own[:, r * s : (r + 1) * s] = j[:, q:]
        rows.append(np.hstack([j[:, :q], own]))
        right.append(residual[r].ravel())
    rows.append(np.hstack([np.zeros((runs * s, q)), np.diag(1 / np.tile(prior, runs))]))
    right.append(-drift.ravel())
    matrix = np.vstack(rows)
    matrix[:, q:][:, np.broadcast_to(known, drift.shape).ravel()] = 0.0
    solved = np.linalg.lstsq(matrix, np.concatenate(right), rcond=None)[0]
    before, after = (np.concatenate(right) - matrix @ x for x in (0 * solved, solved))
    return solved[:q], solved[q:].reshape(runs, s), before @ before - after @ after


@pytest.mark.parametrize("known", [[False, False], [True, False], [True, True]])
def test_a_step_is_that_of_all_unknowns_at_once(known):
    rng = np.random.default_rng(5)
    residual, jacobian = (
        rng.normal(size=(4, 9, 2)),
        rng.normal(size=(4, 9, 2, 3 + 2)) * [1, 10, 0.1, 3, 0.5],
    )
    drift, prior = rng.normal(size=(4, 2)), np.array([3.0, 0.7])
    drift[:, known] = 0.0
    known = np.tile(known, (4, 1))
    solved = arrow_step(residual, jacobian, 3, drift, prior, known, 0.0, np.zeros(3, dtype=bool))
    shared, own, promised = dense_step(residual, jacobian, 3, drift, prior, known)
    np.testing.assert_allclose(solved.shared, shared, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(solved.own, own, rtol=1e-6, atol=1e-8)
    assert solved.promised == pytest.approx(promised, rel=1e-8)
    stuck = np.array([False, True, False])
    held = arrow_step(residual, jacobian, 3, drift, prior, known, 0.0, stuck)
    free = dense_step(residual, jacobian[..., [0, 2, 3, 4]], 2, drift, prior, known)
    np.testing.assert_allclose(held.shared, [free[0][0], 0.0, free[0][1]], rtol=1e-6, atol=1e-9)
    smaller = arrow_step(residual, jacobian, 3, drift, prior, known, 10.0, np.zeros(3, dtype=bool))
    assert np.abs(smaller.shared).max() < 0.5 * np.abs(shared).max()
    assert smaller.promised < promised


def test_least_squares_with_coloured_noise_is_generalised():
    """With noise that remembers, fits that know it are nearer to the truth than those that do not."""
    times, errors = np.arange(150) / 100, []
    rng = np.random.default_rng(11)
    for _ in range(12):
        clean = recorded(Pendulum(observe=["q"]), [TRUTH], [{"q": 1.0}], times)
        noise = rng.standard_normal(150)
        for t in range(1, 150):
            noise[t] = 0.95 * noise[t - 1] + np.sqrt(1 - 0.95**2) * noise[t]
        run = changed(clean.runs[0], q=lambda v, noise=noise: v + 0.02 * noise)
        there = world(replace(clean, runs=(run,)))
        start = Start((), there.nominal(), there.guess)
        plain = white(there, 0.02)
        fits = [Fitter(there, noise).fit([start], 20)[0] for noise in (plain, plain.coloured(0.95))]
        errors.append([fit.theta[0] / TRUTH - 1 for fit in fits])
    ordinary, generalised = np.sqrt(np.square(errors).mean(axis=0))
    assert generalised < 0.85 * ordinary
    assert generalised < 0.01
