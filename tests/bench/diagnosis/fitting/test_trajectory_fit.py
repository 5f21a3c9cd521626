from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_fit import (
    OBSERVED_STATE_PRIOR_SIGMA,
    UNOBSERVED_STATE_PRIOR_SIGMA,
    TrajectoryFitter,
    compute_state_prior,
)
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.explained_samples import (
    autoregressive,
    changed,
    evaluator,
    fit_model,
    recorded,
    recording,
    white,
    with_runs,
)

TRUE_RATE = 2.7e-3


def swings():
    """Return noise-free runs of different lengths and rates."""
    made = []
    for q, rate, samples in ((0.7, 50, 60), (-1.2, 80, 130), (2.2, 100, 90)):
        times = np.arange(samples) / rate
        made.append(recorded(Pendulum(), [TRUE_RATE], [{"q": q}], times))
    return with_runs(made[0], [part.runs[0] for part in made])


def fitted(there, theta=None, iterations=30, **options):
    noise = white(there, 1e-3)
    return fit_model(there, noise, theta=theta, iterations=iterations, **options)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_parameters_and_initial_states_of_noiseless_runs_come_back(share):
    """A share of the samples is missing."""
    rng = np.random.default_rng(3)

    def lose(values):
        return np.where(rng.random(values.size) < share, np.nan, values)

    runs = tuple(changed(run, q=lose, qd=lose) for run in swings().runs)
    there = evaluator(replace(swings(), runs=runs))
    fit = fitted(there)
    assert there.observed.shape == (3, 130, 2)
    assert fit.theta[0] == pytest.approx(TRUE_RATE, rel=2e-5)
    released = [[0.7, 0], [-1.2, 0], [2.2, 0]]
    np.testing.assert_allclose(fit.initial_states, released, atol=1e-3)
    np.testing.assert_allclose(fit.initial_states[:, 0], [0.7, -1.2, 2.2], atol=1.5e-4)
    seen = np.isfinite(there.observed)
    # The deviation is below the assumed noise, in rad and rad/s.
    assert np.abs(fit.simulated - there.observed)[seen].max() < 1e-3
    assert fit.cost < 60, "sum of squares over 560 samples in units of a noise of 1e-3"
    assert not seen[0, 60:].any()
    assert seen.sum() == pytest.approx((1 - share) * 560, abs=40)


def test_the_linear_model_predicts_the_cost_that_a_fit_reaches():
    """Close to the optimum of noisy runs, the first step is predicted to return there."""
    there = evaluator(swings())
    rng = np.random.default_rng(7)
    there.observed[:] += 1e-3 * rng.standard_normal(there.observed.shape)
    best = fitted(there)
    nearby = replace(best.make_start(), theta=best.theta * 1.001)
    fitter = TrajectoryFitter(there, white(there, 1e-3))
    (cost,) = fitter.predict_costs([nearby])
    (unfitted,) = fitter.fit_models([nearby], iterations=0)
    assert best.cost == pytest.approx(560, rel=0.15)
    assert unfitted.cost > 1.5 * best.cost
    assert cost == pytest.approx(best.cost, rel=0.02)


def test_an_effect_is_fitted_with_the_parameters():
    made = recording(effects=["drag.linear=8e-4"], theta=["2.7e-3"], runs=2, seconds=1.5, rate=60)
    there = evaluator(made, candidates=["drag.linear", "friction.coulomb"])
    fit = fitted(there, effects=("drag.linear",))
    assert list(fit.free_indices) == [0, 1]
    assert fit.theta[0] == pytest.approx(TRUE_RATE, rel=1e-4)
    assert fit.theta[1] == pytest.approx(8e-4, rel=1e-3)
    assert fit.theta[2] == 0


def test_the_jacobian_is_the_derivative():
    there = evaluator(swings(), candidates=["drag.linear"])
    fit = fitted(there, effects=("drag.linear",))
    runs = np.arange(3)
    for column, step in ((0, 1e-6), (1, 1e-6)):
        moved = np.tile(fit.theta, (2, 1))
        moved[:, column] += [step, 2 * step]  # drag cannot be negative
        thetas = [np.tile(theta, (3, 1)) for theta in moved]
        one, two = (there.simulate(theta, runs, fit.initial_states) for theta in thetas)
        # This is a second-order one-sided difference with three points.
        forward = (4 * one - two - 3 * fit.simulated) / (2 * step)
        near = np.isfinite(forward)
        scale = np.abs(forward[near]).max()
        np.testing.assert_allclose(
            fit.jacobian[..., column][near], forward[near], atol=0.02 * scale
        )


def test_several_models_in_one_call_equal_one_by_one():
    there = evaluator(swings(), candidates=["drag.linear", "friction.coulomb", "sensor.delay"])
    starts = []
    for effects, inertia in (
        ((), 2e-3),
        (("drag.linear",), 4e-3),
        (("sensor.delay",), 3e-3),
        ((), 6e-3),
    ):
        theta = there.get_nominal_theta()
        theta[0] = inertia
        starts.append(FitStart(effects, theta, there.initial_state_guesses))
    fitter = TrajectoryFitter(there, white(there, 1e-3))
    together = fitter.fit_models(starts, 6)
    alone = [fitter.fit_models([start], 6)[0] for start in starts]
    for a, b in zip(together, alone, strict=True):
        assert a.effects == b.effects
        np.testing.assert_allclose(a.theta, b.theta, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(a.initial_states, b.initial_states, rtol=1e-9, atol=1e-12)
        assert a.cost == pytest.approx(b.cost, rel=1e-6, abs=1e-9)


def test_only_the_first_share_counts():
    def corrupt_second_half(values):
        values[values.size // 2 :] = 50.0
        return values

    runs = tuple(
        changed(run, q=corrupt_second_half, qd=corrupt_second_half) for run in swings().runs
    )
    there = evaluator(replace(swings(), runs=runs))
    assert fitted(there, share=0.45).theta[0] == pytest.approx(TRUE_RATE, rel=1e-4)
    assert abs(fitted(there).theta[0] / TRUE_RATE - 1) > 0.05


def test_bounds_are_kept():
    starts, times = [{"q": 0.8}, {"q": 1.3}], np.arange(80) / 60
    # Negative drag makes the motion grow.
    runaway = Pendulum(fixed={"drag.linear": -5e-4})
    made = recorded(runaway, [TRUE_RATE], starts, times)
    there = evaluator(made, candidates=["drag.linear"])
    theta = there.get_nominal_theta()
    theta[1] = 1e-4
    fit = fitted(there, theta, effects=("drag.linear",))
    assert fit.theta[1] == 0.0, "negative drag is not allowed"


def test_a_parameter_that_would_leave_its_bounds_ends_at_them():
    starts, times = [{"q": 0.8}, {"q": 1.3}], np.arange(80) / 60
    # A tenth of the stated gravity requires ten times the inertia.
    light = recorded(Pendulum({"gravity": 0.981}), [6e-3], starts, times)
    there = evaluator(replace(light, constants={**light.constants, "gravity": 9.81}))
    theta = there.get_nominal_theta()
    theta[0] = 8e-3
    assert fitted(there, theta).theta[0] == 1e-2, "an inertia of 6e-2 would be needed"


def test_frozen_parameters_and_known_initial_states_stay():
    made = swings()
    # The first angle is specified wrongly but treated as known.
    stated = (0.71, -1.2, 2.2)
    runs = [replace(run, initial={"q": q}) for run, q in zip(made.runs, stated, strict=True)]
    there = evaluator(replace(made, runs=tuple(runs)))
    fit = fitted(there)
    assert tuple(fit.initial_states[:, 0]) == stated
    assert (there.known_state_mask == [[True, False]] * 3).all()
    assert np.abs(fit.initial_states[1:, 1]).max() > 0
    frozen = fitted(evaluator(made), fixed_parameters=frozenset({0}))
    assert frozen.theta[0] == 3.3e-3
    assert frozen.free_indices.size == 0
    alone = fitted(evaluator(made), fits_parameters=False)
    assert alone.theta[0] == 3.3e-3
    assert alone.cost > 1e3 * fitted(evaluator(made)).cost


def test_no_derivative_is_simulated_by_what_is_known():
    made = swings()
    told = [{"q": 0.7, "qd": 0.0}, {"q": -1.2}, {"q": 2.2}]
    runs = [replace(run, initial=known) for run, known in zip(made.runs, told, strict=True)]
    there = evaluator(replace(made, runs=tuple(runs)))
    fit = fitted(there, iterations=0)
    assert there.simulation_count == 3 * (1 + 1 + 1), "as it is, the inertia moved, the rate moved"
    usual = fitted(evaluator(made), iterations=0, states=there.initial_state_guesses)
    np.testing.assert_array_equal(fit.jacobian[..., 0], usual.jacobian[..., 0])
    assert not fit.jacobian[..., 1].any()
    assert not fit.jacobian[0, ..., 2].any(), "a state that only one run states"
    assert fit.jacobian[1:, ..., 2].any()


def test_what_is_known_beforehand_depends_on_the_channels():
    made = recording(runs=1, seconds=0.5, observe=["q"])
    np.testing.assert_array_equal(
        compute_state_prior(evaluator(made)),
        [OBSERVED_STATE_PRIOR_SIGMA, OBSERVED_STATE_PRIOR_SIGMA],
    )
    only_rate = recording(runs=1, seconds=0.5, observe=["qd"])
    np.testing.assert_array_equal(
        compute_state_prior(evaluator(only_rate)),
        [UNOBSERVED_STATE_PRIOR_SIGMA, OBSERVED_STATE_PRIOR_SIGMA],
    )


def test_least_squares_with_coloured_noise_is_generalised():
    """With AR(1) noise, generalised least squares is closer to the true parameters."""
    times, errors = np.arange(150) / 100, []
    rng = np.random.default_rng(11)
    for _ in range(12):
        clean = recorded(Pendulum(observe=["q"]), [TRUE_RATE], [{"q": 1.0}], times)
        noise = rng.standard_normal(150)
        for t in range(1, 150):
            noise[t] = 0.95 * noise[t - 1] + np.sqrt(1 - 0.95**2) * noise[t]
        run = changed(clean.runs[0], q=lambda v, noise=noise: v + 0.02 * noise)
        there = evaluator(replace(clean, runs=(run,)))
        # The noise is treated once as white and once as AR(1).
        fits = [
            fit_model(there, noise)
            for noise in (white(there, 0.02), autoregressive(there, 0.02, 0.95))
        ]
        errors.append([fit.theta[0] / TRUE_RATE - 1 for fit in fits])
    ordinary, generalised = np.sqrt(np.square(errors).mean(axis=0))
    assert generalised < 0.85 * ordinary
    assert generalised < 0.01
