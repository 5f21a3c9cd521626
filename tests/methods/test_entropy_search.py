import numpy as np
import pytest

from methods.learning.gaussian_process import GaussianProcess, KernelSettings
from methods.tuner import Array
from methods.tuners.entropy_search import (
    EntropySearch,
    compute_entropy_terms,
    compute_log_losses,
    compute_minimiser_probability,
    generate_quasi_random_points,
    replace_failed_losses,
)
from tests.methods.analytic_problems import START, TRUE_PARAMETERS, decays, errors, run, smooth

PUBLISHED = EntropySearch(published=True)


def bowl(centre: float) -> GaussianProcess:
    points = np.linspace(0.0, 1.0, 8)[:, None]
    return GaussianProcess(
        points, (points[:, 0] - centre) ** 2, KernelSettings(kernel="rbf", noise=(1e-8, 0.1))
    )


@pytest.mark.parametrize("true_parameter", [0.0, 0.3, 0.77])
def test_probability_of_the_minimiser_sums_to_one_and_peaks_at_the_minimum(
    true_parameter: float,
) -> None:
    grid = np.linspace(0.0, 1.0, 101)[:, None]
    p = compute_minimiser_probability(bowl(true_parameter), grid, 400, np.random.default_rng(0))
    assert p.sum() == pytest.approx(1.0, abs=1e-12)
    assert p.min() >= 0.0
    assert abs(grid[p.argmax(), 0] - true_parameter) <= 0.021


def test_probability_is_even_where_nothing_is_known() -> None:
    process = GaussianProcess(
        np.array([[0.5]]), np.array([1.0]), KernelSettings(length=(1e-3, 1.0))
    )
    p = compute_minimiser_probability(
        process, np.linspace(0.0, 0.4, 10)[:, None], 20000, np.random.default_rng(0)
    )
    assert np.allclose(p, 0.1, atol=0.01)


def test_uncertainty_is_minus_p_log_p() -> None:
    expected = [0.5 * np.log(2.0), 0.25 * np.log(4.0), 0.25 * np.log(4.0), -1.0]
    assert compute_entropy_terms(np.array([0.5, 0.25, 0.25, 0.0])) == pytest.approx(expected)
    assert compute_entropy_terms(np.array([0.0, 1.0, 0.0])).argmax() == 1


def test_published_search_stays_on_its_grid_and_stops_when_its_estimate_repeats() -> None:
    trace = run(PUBLISHED, *smooth(1, 100))
    assert trace.status == "converged"
    assert trace.reason == "the estimate repeated"
    assert 2 <= len(trace.losses) < 60
    grid = np.linspace(0.0, 1.0, 50)
    assert np.abs(trace.proposals[1:] - grid).min(axis=1).max() == 0.0
    assert np.abs(trace.recommendations[1:] - grid).min(axis=1).max() == 0.0
    changes = np.abs(np.diff(trace.recommendations[1:], axis=0)).max(axis=1)
    assert (changes[:-1] > 1e-3).all()
    assert changes[-1] == 0.0


def test_published_search_knows_several_parameters() -> None:
    trace = run(EntropySearch(published=True, grid=40), *smooth(2, 60))
    assert len(np.unique(trace.proposals[1:], axis=0)) <= 40


def test_default_is_not_bounded_by_a_grid() -> None:
    found = [
        errors(EntropySearch(), decays, TRUE_PARAMETERS[:1], START[:1], 30, seed)[-1]
        for seed in range(3)
    ]
    assert max(found) < 2e-3
    assert run(EntropySearch(), *smooth(1, 30)).status == "done"


def test_spread_points_are_even() -> None:
    def gap(points: Array) -> float:
        return float(np.diff(np.sort(points[:, 0])).max())

    for dim in (1, 2, 10):
        points = generate_quasi_random_points(200, np.full(dim, 0.3))
        assert points.shape == (200, dim)
        assert points.min() >= 0.0
        assert points.max() < 1.0
        assert np.allclose(points.mean(axis=0), 0.5, atol=0.03)
        assert gap(points) < gap(np.random.default_rng(0).uniform(size=(200, dim)))


def test_failed_simulations_count_as_the_worst() -> None:
    assert replace_failed_losses(np.array([1.0, np.nan, 3.0, np.inf])).tolist() == [
        1.0,
        3.0,
        3.0,
        3.0,
    ]
    assert replace_failed_losses(np.array([np.nan])).tolist() == [0.0]
    assert np.isfinite(compute_log_losses(np.zeros(3))).all()
