"""Tests of difference quotients over wide changes, for simulations that jump."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from bench.diagnosis.prediction_error.settled_simulations import (
    MAX_RESPONSE,
    MIN_RESPONSE,
    refine_with_wide_differences,
)

SIGMA, JUMP, PERIOD = 0.01, 0.002, 0.002
TRUE = np.array([0.3, -1.2])
RUNS, SAMPLES = 4, 60


class JumpingRuns:
    """Runs that are linear in two coefficients, with jumps wherever the first one passes a step."""

    def __init__(self):
        rng = np.random.default_rng(5)
        self.slopes = (
            rng.normal(size=(2, RUNS, SAMPLES, 1)) * np.array([0.5, 0.2])[:, None, None, None]
        )
        self.pattern = np.sign(rng.normal(size=(RUNS, SAMPLES, 1)))
        observed = self.simulate(TRUE, None) + SIGMA * rng.normal(size=(RUNS, SAMPLES, 1))
        self.evaluator = SimpleNamespace(observed=observed)
        self.simulated = []

    def simulate(self, theta, states):
        jump = JUMP * (np.floor(theta[0] / PERIOD) % 2) * self.pattern
        return np.tensordot(theta, self.slopes, 1) + jump

    def simulate_residuals(self, theta, states):
        return (self.evaluator.observed - self.simulate(theta, states)) / SIGMA

    def scale_by_noise(self, values):
        return values / SIGMA

    def fit_settled_states(self, theta, states):
        self.simulated.append(theta.copy())
        return states

    def make_fit(self, theta):
        """Return a fit whose derivatives are differences over a small change across a jump."""
        small = 1e-4
        columns = []
        for k in range(2):
            changed = theta.copy()
            changed[k] += small
            columns.append((self.simulate(changed, None) - self.simulate(theta, None)) / small)
        simulated = self.simulate(theta, None)
        cost = float(np.square((self.evaluator.observed - simulated) / SIGMA).sum())
        return TrajectoryFit(
            ("one", "two"), theta, np.zeros((RUNS, 0)), np.array([0, 1]), simulated,
            np.stack(columns, axis=3), cost, is_own_jacobian=False,
        )  # fmt: skip


BOUNDS = {0: (-5.0, 5.0), 1: (-5.0, 5.0)}


def test_wide_differences_find_the_slope_between_jumps():
    followed = JumpingRuns()
    # The small difference lies across a jump, and its quotient is far from the slope.
    begin = np.array([0.32 - 5e-5, -1.15])
    fit = followed.make_fit(begin)
    slopes = np.sqrt(np.square(followed.slopes).sum(axis=(1, 2, 3)))
    small = np.sqrt(np.square(fit.jacobian).sum(axis=(0, 1, 2)))
    assert small[0] > 3 * slopes[0]
    refined = refine_with_wide_differences(followed, fit, BOUNDS)
    wide = np.sqrt(np.square(refined.jacobian).sum(axis=(0, 1, 2)))
    # A jump has the norm 3.1 in units of the noise, the response by which it is divided 20.
    assert wide == pytest.approx(slopes, rel=0.04)
    # Two points whose sums of squares differ by less than a jump are not distinguished.
    jump = JUMP / SIGMA * np.sqrt(RUNS * SAMPLES)
    assert (np.abs(refined.theta - TRUE) < (2.0 + jump) * SIGMA / slopes).all()
    assert np.square(refined.theta - TRUE).sum() < 0.1 * np.square(begin - TRUE).sum()
    np.testing.assert_array_equal(refined.simulated, followed.simulate(refined.theta, None))
    assert refined.is_own_jacobian
    assert not fit.is_own_jacobian


def test_the_change_is_within_its_range_of_the_noise():
    followed = JumpingRuns()
    refine_with_wide_differences(followed, followed.make_fit(TRUE - 0.01), BOUNDS)
    changes = {abs(theta[1] - (TRUE[1] - 0.01)) for theta in followed.simulated}
    norm = np.sqrt(np.square(followed.slopes[1] / SIGMA).sum())
    assert any(MIN_RESPONSE < change * norm < MAX_RESPONSE for change in changes)


def test_coefficients_stay_within_their_bounds():
    followed = JumpingRuns()
    bounds = {0: (-5.0, 5.0), 1: (-1.15, 5.0)}
    refined = refine_with_wide_differences(
        followed, followed.make_fit(np.array([0.32, -1.1])), bounds
    )
    assert min(theta[1] for theta in followed.simulated) >= -1.15
    assert refined.theta[1] == pytest.approx(-1.15)


def test_a_simulation_that_fails_leaves_the_fit_as_it_is():
    followed = JumpingRuns()
    fit = followed.make_fit(TRUE)
    followed.simulate = lambda theta, states: np.full((RUNS, SAMPLES, 1), np.nan)
    assert refine_with_wide_differences(followed, fit, BOUNDS) is fit
