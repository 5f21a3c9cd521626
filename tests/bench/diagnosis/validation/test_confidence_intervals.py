from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_model import NoiseModel, maximise_likelihood
from bench.diagnosis.fitting.trajectory_derivatives import compute_central_jacobian
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.validation.confidence_intervals import compute_covariance, compute_intervals
from bench.diagnosis.validation.held_out_runs import HeldOutRuns
from sims.systems.pendulum import Pendulum
from sims.systems.slider import Slider
from tests.bench.diagnosis.explained_samples import (
    autoregressive,
    correlated,
    evaluator,
    fit_model,
    make_search,
    recorded,
    recording,
    searched,
    white,
    with_runs,
)


@pytest.mark.parametrize("phi", [0.0, 0.7])
def test_intervals_cover_the_true_parameters(phi):
    """Check 95 % intervals of mass and drag on 60 recordings of a driven slider."""
    times, rng, held = np.arange(120) / 60, np.random.default_rng(20), []
    push = np.where(np.sin(5 * times) > 0, 1.0, -1.0)
    made = recorded(
        Slider(fixed={"drag.linear": 0.4}, observe=["x"]), [1.3], [({}, {"u": push})], times
    )
    there = evaluator(made, candidates=["drag.linear"])
    clean, noise = there.observed.copy(), autoregressive(there, 0.004, phi)
    theta = np.array([1.3, 0.4])
    for _ in range(60):
        there.observed[...] = clean + correlated(rng, phi, 0.004, clean.shape)
        fit = fit_model(there, noise, ("drag.linear",), theta, iterations=12)
        search = make_search(there, noise, rng)
        found = compute_intervals(search, search.add_fit(fit))
        held.append([found[i][1] <= theta[i] <= found[i][2] for i in range(2)])
    assert 0.88 <= np.mean(held) <= 0.99
    assert (np.mean(held, axis=0) >= 0.85).all()


@pytest.mark.parametrize("initial", [{}, {"qd": 0.0}])
def test_the_covariance_is_that_of_all_unknowns_at_once(initial):
    made = recording(runs=2, seconds=0.8, rate=50, noise=["q=0.003", "qd=0.02"], seed=3)
    made = with_runs(made, [replace(made.runs[0], initial=initial), made.runs[1]])
    search, model = searched(made, [0.003, 0.02], candidates=[])
    sigma = model.likelihood.sigma
    assert np.allclose(model.likelihood.phi, 0, atol=0.3)
    flat = NoiseModel(sigma, np.zeros(2))
    model = type(model)(
        model.fit,
        type(model.likelihood)(model.likelihood.value, sigma, flat.phi),
        model.penalised_log_likelihood,
    )
    jacobian = (
        compute_central_jacobian(search.evaluator, model.fit, search.noise).jacobian
        / sigma[:, None]
    )
    rows = np.zeros((2, jacobian[0, ..., 0].size, 5))
    for r in range(2):
        flattened = jacobian[r].reshape(-1, 3)
        rows[r, :, 0], rows[r, :, 1 + 2 * r : 3 + 2 * r] = flattened[:, 0], flattened[:, 1:]
    normal = np.einsum("rnk,rnl->kl", rows, rows) + np.diag([0, *[1e-4] * 4])
    # A known initial state is not an unknown.
    unknown = [0, *(1 + np.flatnonzero(~search.evaluator.known_state_mask))]
    inverse = np.linalg.inv(normal[np.ix_(unknown, unknown)])
    # Values in kg^2 m^4 are far below absolute tolerances, so they are scaled.
    known = compute_covariance(search, model)[0, 0]
    assert known * 1e12 == pytest.approx(inverse[0, 0] * 1e12, rel=1e-6)
    least = 1.0 if initial else 3.0
    assert known > least / normal[0, 0], "initial states take most of what is known of it"
    value, low, high = compute_intervals(search, model)[0]
    assert value == model.fit.theta[0]
    for reach in (value - low, high - value):
        assert reach / np.sqrt(known) == pytest.approx(1.959964, rel=1e-6)


def test_a_coordinate_that_is_not_recorded_hides_no_coefficient_of_the_others():
    """The sideways drift of the ball is not recorded, but its lift coefficient is identifiable."""
    made = recording(
        "ball",
        effects=["lift.magnus=0.25"],
        initial=["vx=4", "z=1.5", "vz=3"],
        noise=["x=0.003", "z=0.003"],
        observe=["x", "z"],
        runs=2,
        seconds=1.0,
        rate=60,
        seed=5,
    )
    there = evaluator(made, candidates=["lift.magnus"])
    noise = white(there, 0.003)
    fit = fit_model(there, noise, ("lift.magnus",), [0.5, 0.2, -0.02], iterations=8)
    search = make_search(there, noise)
    _, low, high = compute_intervals(search, search.add_fit(fit))[1]
    assert low < 0.25 < high
    assert high - low < 0.05


def test_parameters_that_act_alike_have_no_interval():
    """Inertia and gravity of a free swing are equivalent.

    One-sided differences would separate them only by their own error.
    """
    made = recorded(
        Pendulum(), [3.3e-3], [{"q": 0.8}, {"q": 1.2}], np.arange(90) / 60, [0.003, 0.02], seed=5
    )
    search, model = searched(made, [0.003, 0.02], candidates=[], free=["gravity"])
    spread = np.sqrt(np.diagonal(compute_covariance(search, model))) / model.fit.theta[:2]
    assert (spread > 5).all()
    assert np.isnan([compute_intervals(search, model)[i][1] for i in range(2)]).all()
    exact = compute_central_jacobian(search.evaluator, model.fit, search.noise).jacobian
    ratio = exact[..., 0] * model.fit.theta[0] + exact[..., 1] * model.fit.theta[1]
    assert np.abs(ratio).max() < 1e-3 * np.abs(exact[..., 0] * model.fit.theta[0]).max()


def test_what_the_data_do_not_bound_has_no_interval():
    made = recorded(Pendulum(), [3.3e-3], [{"q": 1e-4}], np.arange(60) / 60, [0.01, 0.05])
    there = evaluator(made, candidates=["drag.quadratic"])
    noise = white(there, [0.01, 0.05])
    search = make_search(there, noise)
    fit = fit_model(there, noise, ("drag.quadratic",), [3.3e-3, 1e-3], iterations=3)
    model = search.add_fit(fit)
    assert np.isnan(compute_intervals(search, model)[1][1:]).all()


def test_intervals_follow_the_residual_and_not_the_stated_noise():
    made = recording(runs=2, seconds=0.8, rate=50, noise=["q=0.003", "qd=0.02"], seed=3)
    widths = []
    for factor in (1.0, 3.0):
        search, model = searched(made, np.array([0.003, 0.02]) * factor, candidates=[])
        _, low, high = compute_intervals(search, model)[0]
        widths.append(high - low)
    assert widths[1] / widths[0] == pytest.approx(1.0, rel=0.1)


def test_held_out_runs_estimate_initial_states_and_nothing_else():
    made = recording(
        theta=["4e-3"], runs=3, seconds=1, rate=60, noise=["q=0.003", "qd=0.02"], held_out=0
    )
    there = evaluator(made, candidates=["drag.linear"])
    held_out = HeldOutRuns(there, white(there, [0.003, 0.02]))
    right, wrong, failed = held_out.fit_initial_states(
        [np.array(theta) for theta in ([4e-3, 0.0], [3e-3, 0.0], [np.nan, 0.0])]
    )
    left = (there.observed - right.simulated) / [0.003, 0.02]
    assert np.sqrt(np.square(left).mean()) == pytest.approx(1.0, abs=0.1)
    assert np.sqrt(np.square((there.observed - wrong.simulated) / [0.003, 0.02]).mean()) > 10
    assert right.penalised_log_likelihood > wrong.penalised_log_likelihood + 500
    # Each of the six initial states costs the logarithm of the number of samples.
    residual, count = there.observed - right.simulated, there.observed.size
    likeliest = maximise_likelihood(residual, np.ones(residual.shape, dtype=bool)).value
    assert right.penalised_log_likelihood == pytest.approx(likeliest - 6 * np.log(count), abs=1.0)
    assert failed.penalised_log_likelihood == -np.inf
    assert np.isnan(failed.simulated).all()


@pytest.mark.parametrize("has_contact_jumps", [True, False])
def test_intervals_by_the_scatter_of_runs_cover_the_mean(monkeypatch, has_contact_jumps):
    """Check 95 % intervals of a mass that scatters between 6 runs by more than noise explains."""
    times, rng, held = np.arange(120) / 60, np.random.default_rng(21), []
    push = np.where(np.sin(5 * times) > 0, 1.0, -1.0)
    made = recorded(
        Slider(fixed={"drag.linear": 0.4}, observe=["x"]), [1.3], [({}, {"u": push})] * 6, times
    )
    there = evaluator(made, candidates=[])
    runs, states = np.arange(6), there.initial_state_guesses
    noise = white(there, 0.004)
    # Simulated contacts of a robot may jump.
    monkeypatch.setattr(EffectSearch, "has_contact_jumps", has_contact_jumps)
    for _ in range(50):
        masses = rng.normal(1.3, 0.06, size=(6, 1))
        clean = there.simulate(masses, runs, states)
        there.observed[...] = clean + 0.004 * rng.normal(size=clean.shape)
        fit = fit_model(there, noise, (), [1.3], iterations=12)
        search = make_search(there, noise, rng)
        _, low, high = compute_intervals(search, search.add_fit(fit))[0]
        held.append(low <= 1.3 <= high)
    assert (np.mean(held) >= 0.88) == has_contact_jumps
    assert has_contact_jumps or np.mean(held) < 0.6
