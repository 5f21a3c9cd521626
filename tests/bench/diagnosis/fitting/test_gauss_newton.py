import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt import compute_gauss_newton_step

FREE = np.zeros((4, 2))
NONE = np.zeros(3, dtype=bool)
"""Mask of active bounds: none."""


def dense_step(residual, jacobian, q, drift, prior, known):
    """Compute the undamped step of all unknowns at once by ordinary least squares."""
    runs, s = drift.shape
    rows, right = [], []
    for r in range(runs):
        j = jacobian[r].reshape(-1, q + s)
        # The columns of a run's initial states are zero in all other runs.
        own = np.zeros((len(j), runs * s))
        own[:, r * s : (r + 1) * s] = j[:, q:]
        rows.append(np.hstack([j[:, :q], own]))
        right.append(residual[r].ravel())

    # The prior counts as one more observation of each initial state.
    weights = np.diag(1 / np.tile(prior, runs))
    rows.append(np.hstack([np.zeros((runs * s, q)), weights]))
    right.append(-drift.ravel())

    matrix = np.vstack(rows)
    fixed = np.broadcast_to(known, drift.shape).ravel()
    matrix[:, q:][:, fixed] = 0.0
    before = np.concatenate(right)
    solved = np.linalg.lstsq(matrix, before, rcond=None)[0]
    after = before - matrix @ solved
    gained = before @ before - after @ after
    return solved[:q], solved[q:].reshape(runs, s), gained


def equations(known):
    """Return four runs of nine samples; three parameters and two initial states differ in size."""
    rng = np.random.default_rng(5)
    residual = rng.normal(size=(4, 9, 2))
    sizes = [1, 10, 0.1, 3, 0.5]
    jacobian = rng.normal(size=(4, 9, 2, 3 + 2)) * sizes
    drift = rng.normal(size=(4, 2))
    # A known state does not differ from its specified value.
    drift[:, known] = 0.0
    prior = np.array([3.0, 0.7])
    return residual, jacobian, drift, prior, np.tile(known, (4, 1))


@pytest.mark.parametrize("known", [[False, False], [True, False], [True, True]])
def test_a_step_is_that_of_all_unknowns_at_once(known):
    residual, jacobian, drift, prior, known = equations(known)
    solved = compute_gauss_newton_step(residual, jacobian, 3, drift, prior, known, 0.0, FREE, NONE)
    shared, own, promised = dense_step(residual, jacobian, 3, drift, prior, known)
    np.testing.assert_allclose(solved.parameter_step, shared, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(solved.state_steps, own, rtol=1e-6, atol=1e-8)
    assert solved.predicted_decrease == pytest.approx(promised, rel=1e-8)


@pytest.mark.parametrize("known", [[False, False], [True, False], [True, True]])
def test_a_stuck_parameter_is_as_if_it_were_none(known):
    residual, jacobian, drift, prior, known = equations(known)
    stuck = np.array([False, True, False])
    held = compute_gauss_newton_step(residual, jacobian, 3, drift, prior, known, 0.0, FREE, stuck)
    others = jacobian[..., [0, 2, 3, 4]]
    first, last = dense_step(residual, others, 2, drift, prior, known)[0]
    np.testing.assert_allclose(held.parameter_step, [first, 0.0, last], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("known", [[False, False], [True, False], [True, True]])
def test_damping_shortens_the_step_and_what_it_promises(known):
    residual, jacobian, drift, prior, known = equations(known)
    whole, smaller = (
        compute_gauss_newton_step(residual, jacobian, 3, drift, prior, known, d, FREE + d, NONE)
        for d in (0.0, 10.0)
    )
    assert np.abs(smaller.parameter_step).max() < 0.5 * np.abs(whole.parameter_step).max()
    assert smaller.predicted_decrease < whole.predicted_decrease


def test_damping_of_one_state_shortens_its_step_alone():
    residual, jacobian, drift, prior, known = equations([False, False])
    # Without a response to the parameters and to both states at once, steps are independent.
    jacobian[..., :3], jacobian[..., 0, 4], jacobian[..., 1, 3] = 0.0, 0.0, 0.0
    damping = FREE.copy()
    damping[2, 1] = 3.0
    whole, damped = (
        compute_gauss_newton_step(residual, jacobian, 3, drift, prior, known, 0.0, by_state, NONE)
        for by_state in (FREE, damping)
    )
    np.testing.assert_allclose(damped.state_steps, whole.state_steps / (1.0 + damping), rtol=1e-9)
    gains = whole.predicted_decreases - damped.predicted_decreases
    assert np.argwhere(np.abs(gains) > 1e-9).tolist() == [[2, 1]]


@pytest.mark.parametrize("factor", [1e-3, 1e9, 1e12])
def test_a_step_does_not_depend_on_the_units_of_the_parameters(factor):
    """An outlet in m^2 and a lag in s have curvature ratios beyond double precision."""
    residual, jacobian, drift, prior, known = equations([False, False])
    args = 3, drift, prior, known, 0.0, FREE, NONE
    plain = compute_gauss_newton_step(residual, jacobian, *args)
    scaled = jacobian.copy()
    scaled[..., 1] *= factor
    step = compute_gauss_newton_step(residual, scaled, *args)
    expected = plain.parameter_step * np.array([1.0, 1.0 / factor, 1.0])
    np.testing.assert_allclose(step.parameter_step, expected, rtol=1e-5)
    np.testing.assert_allclose(step.state_steps, plain.state_steps, rtol=1e-5)
