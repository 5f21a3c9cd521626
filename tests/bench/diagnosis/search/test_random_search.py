"""Tests of the random search of coefficients and initial states, with a sliding block."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.kalman.cubature_filter import SmoothedStart
from bench.diagnosis.search.random_search import RandomStartSearch

NOISE = 1e-4
TIMES = np.linspace(0.0, 1.0, 101)
FRICTION, GRAVITY = 0.3, 9.81
STARTS = np.array([[0.1, 1.2], [-0.2, 0.8]])
EDGE = 0.15  # Position of a bump over which a slow block does not slide, m.


def slide(friction, states):
    """Return positions (L, T, 1) of blocks that slide until they stand, or until a bump.

    Args:
        friction: (L,) friction coefficients.
        states: (L, 2) initial positions and velocities.
    """
    position, speed = states[:, :1], np.maximum(states[:, 1:], 0.0)
    deceleration = GRAVITY * friction[:, None]
    times = np.minimum(TIMES, speed / deceleration)
    path = position + speed * times - 0.5 * deceleration * times**2
    # The energy at the bump decides whether the block passes it: the run then changes by a step.
    passes = speed**2 > 2.0 * deceleration * (EDGE - position) + 0.5
    return np.where(passes | (path < EDGE), path, EDGE)[..., None]


def make_search(known=False, seed=0):
    """Return a search about starts that are wrong by two noises, and the true starts."""
    rng = np.random.default_rng(seed)
    observed = slide(np.full(2, FRICTION), STARTS) + NOISE * rng.standard_normal((2, 101, 1))
    evaluator = SimpleNamespace(
        observed=observed,
        known_state_mask=np.full((2, 2), known),
        initial_state_guesses=STARTS,
        search_control=SimpleNamespace(check_not_stopped=lambda: None),
        simulate=lambda theta, runs, states: slide(theta[:, 1], states),
    )
    deviations = np.array([NOISE, 1e-3])
    covariance = np.diag(deviations**2)
    smoothed = [SmoothedStart(0.0, start + 2.0 * deviations, covariance) for start in STARTS]
    return RandomStartSearch(evaluator, np.array([NOISE]), smoothed, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(3))
def test_coefficient_and_initial_states_are_found_together(seed):
    found = make_search(seed=seed).run(
        np.array([7.0, 0.31]), [1], np.array([0.01]), np.array([[0.0, 1.0]])
    )
    assert found.theta[0] == 7.0
    assert found.theta[1] == pytest.approx(FRICTION, abs=1.5e-3)
    assert found.mean_square < 1.5
    assert np.abs(found.states - STARTS) / np.array([NOISE, 1e-3]) == pytest.approx(0.0, abs=4.0)


def test_known_initial_states_are_kept_and_bounds_are_respected():
    found = make_search(known=True).run(
        np.array([7.0, 0.32]), [1], np.array([0.01]), np.array([[0.31, 1.0]])
    )
    np.testing.assert_array_equal(found.states, STARTS)
    assert found.theta[1] == pytest.approx(0.31, abs=1e-3)
    assert found.theta[1] >= 0.31


def test_initial_states_alone_are_searched_without_coefficients():
    found = make_search().run(np.array([7.0, FRICTION]), [], np.zeros(0), np.zeros((0, 2)))
    assert found.theta.tolist() == [7.0, FRICTION]
    assert found.mean_square < 1.2
    assert np.abs(found.states - STARTS) / np.array([NOISE, 1e-3]) == pytest.approx(0.0, abs=2.0)
