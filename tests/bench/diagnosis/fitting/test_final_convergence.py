"""Tests of the final convergence of the reported model, with the noise of its residual."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.validation.confidence_intervals import compute_intervals
from sims.systems.slider import Slider
from tests.bench.diagnosis.explained_samples import (
    autoregressive,
    correlated,
    evaluator,
    fit_model,
    make_search,
    recorded,
    white,
)

MASS, DRAG, SIGMA = 1.3, 0.4, 0.004
NAME = "drag.linear"


@pytest.fixture
def there():
    times = np.arange(240) / 60
    push = np.where(np.sin(5 * times) > 0, 1.0, -1.0)
    made = recorded(Slider(fixed={NAME: DRAG}, observe=["x"]), [MASS], [({}, {"u": push})], times)
    return evaluator(made, candidates=[NAME])


def search_of(there, phi, seed=0):
    """Return a search that assumes white noise, with AR(1) noise of this phi added to the data."""
    rng = np.random.default_rng(seed)
    there.observed[...] += correlated(rng, phi, SIGMA, there.observed.shape)
    return make_search(there, white(there, SIGMA), rng)


def entered(search, theta, iterations, exact=False):
    fit = fit_model(
        search.evaluator,
        search.noise,
        (NAME,),
        theta,
        iterations=iterations,
        is_final_fit=exact,
    )
    return search.add_fit(fit)


def off(search, model, best):
    """Return the largest parameter distance from the best fit, in standard errors."""
    found = compute_intervals(search, best)
    spread = np.array([(found[i][2] - found[i][1]) / 3.92 for i in range(2)])
    return np.abs((model.fit.theta - best.fit.theta) / spread).max()


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_it_is_where_generalised_least_squares_ends(there, phi):
    search = search_of(there, phi)
    begun = entered(search, [1.1, 0.1], 2)
    told = search.fit_to_convergence(begun)
    assert told.likelihood.phi[0] == pytest.approx(phi, abs=0.12)
    noise = autoregressive(there, told.likelihood.sigma[0], told.likelihood.phi)
    best = search._rate_fit(
        fit_model(there, noise, (NAME,), [1.1, 0.1], iterations=60, is_final_fit=True)
    )
    assert off(search, told, best) < 0.05
    assert off(search, begun, best) > 0.3
    assert search.models[frozenset({NAME})] is told
    # The cost is in units of the search's own noise, as for all other models.
    left = (there.observed - told.fit.simulated)[search.observed_mask] / SIGMA
    assert told.fit.cost == pytest.approx(float(left @ left), rel=1e-3)


def test_what_is_there_already_stays_and_keeps_its_scores(there):
    search = search_of(there, 0.0)
    model = entered(search, [MASS, DRAG], 60, exact=True)
    search.scores_by_effects[frozenset({NAME})] = "scores"
    assert off(search, search.fit_to_convergence(model), model) < 0.05
    assert search.scores_by_effects[frozenset({NAME})] == "scores"
    far = entered(search_of(there, 0.0, seed=1), [0.9, 0.0], 0)
    search.models[frozenset({NAME})] = far
    search.fit_to_convergence(far)
    assert frozenset({NAME}) not in search.scores_by_effects, "of another place they tell nothing"


def test_a_model_that_cannot_be_simulated_stays_as_it_is(there):
    search = search_of(there, 0.0)
    model = entered(search, [MASS, DRAG], 20)
    lost = replace(model, fit=replace(model.fit, cost=np.inf))
    assert search.fit_to_convergence(lost) is lost


def test_a_residual_that_is_no_noise_does_not_bias_it(there):
    """A drift that no effect explains must not bias the converged fit.

    With AR(1) noise weighting, a smooth residual of the whole drift and a drag of zero would fit
    better.
    """
    search = search_of(there, 0.0)
    times = np.arange(there.observed.shape[1]) / 60
    there.observed[...] += 0.5 * (times / times[-1])[None, :, None] ** 3
    begun = entered(search, [MASS, DRAG], 60, exact=True)
    noise = autoregressive(there, begun.likelihood.sigma[0], begun.likelihood.phi)
    (fit,) = TrajectoryFitter(there, noise, is_final_fit=True).fit_models(
        [begun.fit.make_start()], 60
    )
    pulled = search._rate_fit(
        replace(fit, cost=TrajectoryFitter(there, search.noise).compute_cost(fit))
    )
    assert pulled.penalised_log_likelihood > begun.penalised_log_likelihood
    assert pulled.fit.cost > 2.0 * begun.fit.cost
    assert pulled.fit.theta[1] == 0.0
    told = search.fit_to_convergence(begun)
    assert told.fit.cost < 1.2 * begun.fit.cost
