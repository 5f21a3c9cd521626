"""Tests of scores against generalised least squares with full matrices."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import nnls

from bench.diagnosis.evaluation.autoregressive_surrogates import draw_surrogates
from bench.diagnosis.evaluation.noise_model import PHI_GRID, NoiseModel
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.search.candidate_directions import DirectionSet
from bench.diagnosis.search.score_test import (
    ScoreTest,
    compute_calibrated_scores,
    compute_explained_squares,
    estimate_tail_p_value,
    group_probes,
)
from bench.diagnosis.search.whitened_products import InnerProducts, WhiteningDesign
from tests.bench.diagnosis.explained_samples import correlated, covariance_of, linear_fit

SIGMA = np.array([0.5, 2.0])
RUNS, SAMPLES, Q, STATES, K = 3, 14, 2, 2, 5


def score_candidates(at, residual, directions, seen, sigma, surrogate=None):
    """Score every effect once, with a new test and white noise."""
    noise = NoiseModel(np.array(sigma), np.zeros(len(sigma)))
    return ScoreTest(at, directions, seen, noise).compute_scores(residual, surrogate)


def problem(seed=0, holes=0.0):
    """Return Jacobian, directions, residual and mask; two directions are nearly equal."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(RUNS, SAMPLES, 2, Q + STATES))
    directions = rng.normal(size=(RUNS, SAMPLES, 2, K)) * [1.0, 1e3, 1.0, 1e-3, 1.0]
    directions[..., 4] = directions[..., 0] + 0.3 * directions[..., 4]
    residual = rng.normal(size=(RUNS, SAMPLES, 2)) * SIGMA + 0.4 * directions[..., 0]
    seen = rng.random(residual.shape) >= holes
    return jacobian, directions, np.where(seen, residual, 0.0), seen


def dense(jacobian, seen, phi, *values):
    """Return values (R, T, C, ...) whitened to (n, ...), with parameters and states projected out.

    It uses the square root of the full inverse covariance of each run and channel.
    """
    design, rest = [], [[] for _ in values]
    for r in range(RUNS):
        for c in range(2):
            here = seen[r, :, c]
            root = np.linalg.cholesky(np.linalg.inv(covariance_of(here[None], phi))).T / SIGMA[c]
            own = np.zeros((int(here.sum()), Q + RUNS * STATES))
            own[:, :Q] = jacobian[r, here, c, :Q]
            own[:, Q + r * STATES : Q + (r + 1) * STATES] = jacobian[r, here, c, Q:]
            design.append(root @ own)
            for part, value in zip(rest, values, strict=True):
                part.append(root @ value[r, here, c])
    matrix = np.vstack(design)
    result = []
    for part in rest:
        whole = np.concatenate(part)
        result.append(whole - matrix @ np.linalg.lstsq(matrix, whole, rcond=None)[0])
    return result


def whole(jacobian, directions, residual, seen):
    """Return the inner products of one residual with all directions in one block."""
    block = np.arange(directions.shape[3])[None]
    design = WhiteningDesign(linear_fit(jacobian, Q), directions, seen, SIGMA, [block])
    products = InnerProducts(design, residual[None])

    def projected(phi):
        total, (gram,), cross = products.project(phi)
        return total, gram[0], cross

    return projected


@pytest.mark.parametrize("phi", [0.0, 0.3, 0.8, 0.95])
@pytest.mark.parametrize("holes", [0.0, 0.2])
def test_products_are_those_of_whole_matrices(phi, holes):
    jacobian, directions, residual, seen = problem(1, holes)
    jacobian, directions = (np.where(seen[..., None], part, 0.0) for part in (jacobian, directions))
    total, gram, cross = whole(jacobian, directions, residual, seen)(phi)
    d, r = dense(jacobian, seen, phi, directions, residual)
    assert total[0] == pytest.approx(r @ r, rel=1e-9)
    np.testing.assert_allclose(gram, d.T @ d, rtol=1e-8, atol=1e-9 * np.abs(d.T @ d).max())
    np.testing.assert_allclose(cross[:, 0], d.T @ r, rtol=1e-7)


@pytest.mark.parametrize("holes", [0.0, 0.2])
def test_what_the_models_own_freedom_leaves_is_what_least_squares_leave(holes):
    jacobian, directions, residual, seen = problem(10, holes)
    jacobian = np.where(seen[..., None], jacobian, 0.0)
    design = WhiteningDesign(linear_fit(jacobian, Q), directions, seen, SIGMA, [])
    noises = np.stack([residual, np.where(seen, residual[::-1], 0.0)])
    left = design.project_out(noises)
    assert (left[:, ~seen] == 0).all()
    # The dense computation orders the samples by run, then by channel.
    order = [left[:, r, seen[r, :, c], c] / SIGMA[c] for r in range(RUNS) for c in range(2)]
    expected = dense(jacobian, seen, 0.0, np.moveaxis(noises, 0, -1))[0]
    np.testing.assert_allclose(np.concatenate(order, axis=1).T, expected, atol=1e-9)


PROBES = tuple(CandidateDirection("abcd"[min(i, 3)], 0, 0, np.ones(1), True) for i in range(K))


def score_problem(jacobian, directions, residual, seen, surrogate=None):
    """Score the four effects of `problem`."""
    made = DirectionSet(PROBES, directions)
    return score_candidates(linear_fit(jacobian, Q), residual, made, seen, SIGMA, surrogate)


def log_likelihood(residual, seen, phi):
    """Return twice the log-likelihood with a common estimated sigma, up to a constant."""
    count = int(seen.sum())
    determinants = sum(
        np.linalg.slogdet(covariance_of(seen[r, :, c][None], phi))[1]
        for r in range(RUNS)
        for c in range(2)
    )
    return -count * np.log(residual @ residual) - determinants


def test_scores_are_gains_in_log_likelihood_at_the_best_correlation():
    jacobian, directions, residual, seen = problem(2)
    found = score_problem(jacobian, directions, residual, seen)
    nothing, best = -np.inf, dict.fromkeys("abcd", -np.inf)
    for phi in PHI_GRID:
        d, r = dense(jacobian, seen, phi, directions, residual)
        nothing = max(nothing, log_likelihood(r, seen, phi))
        for name, columns in {"a": [0], "b": [1], "c": [2], "d": [3, 4]}.items():
            left = r - d[:, columns] @ np.linalg.lstsq(d[:, columns], r, rcond=None)[0]
            best[name] = max(best[name], log_likelihood(left, seen, phi))
    expected = {name: value - nothing for name, value in best.items()}
    assert found.effects == tuple(sorted(expected, key=lambda name: -expected[name]))
    np.testing.assert_allclose(found.score, [expected[name] for name in found.effects], rtol=1e-6)
    assert found.effects[0] == "a", "it makes the difference"
    (peak,) = found.peaks[0]
    assert peak[1][0] == pytest.approx(0.4, abs=0.15)
    assert found.p_value == 1.0, "without surrogates nothing is known of chance"


def test_coefficients_that_cannot_be_negative_are_held_at_zero():
    jacobian, directions, residual, seen = problem(3)
    d, r = dense(jacobian, seen, 0.0, directions, residual)
    scale = np.linalg.norm(d, axis=0)
    gram, cross = (d.T @ d)[None, :4, :4], np.stack([d.T @ r, -(d.T @ r)], axis=1)[None, :4]
    for column, sign in enumerate((1.0, -1.0)):
        gain, c = compute_explained_squares(gram, sign * cross, (True,) * 4)
        solved, left = nnls(d[:, :4] / scale[:4], sign * r)
        assert gain[0, 0] == pytest.approx(r @ r - left**2, rel=1e-8)
        assert compute_explained_squares(gram, cross, (True,) * 4)[0][0, column] == gain[0, 0]
        np.testing.assert_allclose(c[0], solved / scale[:4], rtol=1e-6, atol=1e-12)
        assert (c[0] == 0).sum() == (solved == 0).sum() > 0
    held, _ = compute_explained_squares(gram, cross, (True,) * 4)
    free, _ = compute_explained_squares(gram, cross, (False,) * 4)
    left = r - d[:, :4] @ np.linalg.lstsq(d[:, :4], r, rcond=None)[0]
    np.testing.assert_allclose(free, r @ r - left @ left, rtol=1e-8)
    assert (free > held).all()


def test_a_large_group_is_one_regression_and_equal_columns_count_once():
    jacobian, directions, residual, seen = problem(4)
    doubled = np.concatenate([directions, 7.0 * directions[..., :2]], axis=3)
    d, r = dense(jacobian, seen, 0.0, doubled, residual)
    gram, cross = d.T @ d, (d.T @ r)[:, None]
    gain, c = compute_explained_squares(gram[None], cross[None], (False,) * 7)
    left = r - d @ np.linalg.lstsq(d, r, rcond=None)[0]
    assert gain[0, 0] == pytest.approx(r @ r - left @ left, rel=1e-6)
    np.testing.assert_allclose(r - d @ c[0], left, atol=1e-6)
    alike = np.array([0, 5])
    pair, _ = compute_explained_squares(
        gram[np.ix_(alike, alike)][None], cross[alike][None], (False, False)
    )
    one, _ = compute_explained_squares(gram[None, :1, :1], cross[None, :1], (False,))
    assert pair[0, 0] == pytest.approx(one[0, 0], rel=1e-9)


def test_groups_solved_together_are_what_each_is_alone():
    jacobian, directions, residual, seen = problem(9)
    d, r = dense(jacobian, seen, 0.0, directions, residual)
    shrunk = d.T @ np.stack([r, r[::-1], -r], axis=1)
    columns = np.array([[0, 4], [1, 2], [3, 3], [2, 0]])
    gram = np.stack([(d.T @ d)[np.ix_(some, some)] for some in columns])
    gram[3, 1] = gram[3, :, 1] = 0.0  # projected out completely
    cross = shrunk[columns]
    for positive in ((False, True), (True, True), (False, False)):
        gain, c = compute_explained_squares(gram, cross, positive)
        for i in range(len(columns)):
            alone, own = compute_explained_squares(gram[i : i + 1], cross[i : i + 1], positive)
            np.testing.assert_allclose(gain[i], alone[0], rtol=1e-12)
            np.testing.assert_allclose(c[i], own[0], rtol=1e-12)
        assert c[3, 1] == 0.0


def test_what_the_model_absorbs_is_no_evidence():
    jacobian, directions, residual, seen = problem(5)
    directions[..., 0] = 3.0 * jacobian[..., 0] - jacobian[..., 3]
    found = score_problem(jacobian, directions, residual, seen)
    assert found.score[found.effects.index("a")] == pytest.approx(0.0, abs=1e-6)
    directions[..., 1] = (
        1e9 * jacobian[..., 1] + directions[..., 2]
    )  # of two equal directions only rounding errors remain
    directions[..., 3] = 1e9 * jacobian[..., 1] + directions[..., 2]
    projected = whole(jacobian, directions, residual, seen)
    for phi in PHI_GRID:
        _, gram, cross = projected(phi)
        np.testing.assert_array_equal(gram, gram.T)
        assert not gram[[0, 1, 3]].any()
        assert not cross[[0, 1, 3]].any()
        assert np.linalg.eigvalsh(gram[2:3, 2:3])[0] > 0


def test_directions_of_an_effect_act_together_within_a_group():
    marked = [
        CandidateDirection("a", 0, 0, np.ones(2), True),
        CandidateDirection("a", 0, 1, np.ones(2), False),
        CandidateDirection("a", 1, 0, np.ones(2), True),
    ]
    made = group_probes(marked)
    assert [(g.column_indices, g.positive) for g in made] == [
        ((0, 1), (False, True)),
        ((2,), (False,)),
    ]


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_p_values_of_clean_residuals_are_uniform(phi):
    """For 200 noise residuals, p-values match each level within three standard errors."""
    rng = np.random.default_rng(6)
    times = np.linspace(0, 1, 150)
    jacobian = np.stack([times, np.ones(150), np.sin(5 * times)], axis=1)[None, :, None].repeat(
        2, axis=0
    )
    smooth = np.stack([np.cos(k * times + k) for k in range(1, 9)], axis=1)
    directions = DirectionSet(
        tuple(CandidateDirection("abcdefgh"[k], 0, 0, np.ones(1), k % 2 == 0) for k in range(8)),
        smooth[None, :, None].repeat(2, axis=0) * np.array([1.0, -0.5])[:, None, None, None],
    )
    fit, seen, p = linear_fit(jacobian, 1), np.ones((2, 150, 1), dtype=bool), []
    for _ in range(200):
        residual = correlated(rng, phi, 0.1, (2, 150, 1))
        for r in range(2):
            j = jacobian[r, :, 0, 1:]
            residual[r, :, 0] -= j @ np.linalg.lstsq(j, residual[r, :, 0], rcond=None)[0]
        like = draw_surrogates(residual, seen, 60, rng)
        p.append(score_candidates(fit, residual, directions, seen, [0.1], like).p_value)
    p = np.array(p)
    assert (p < 0.01).mean() <= 0.03
    for level in (0.1, 0.3, 0.5):
        assert (p < level).mean() == pytest.approx(
            level, abs=3 * np.sqrt(level * (1 - level) / 200) + 0.03
        ), level


def test_a_cause_has_a_small_p_value():
    jacobian, directions, residual, seen = problem(7)
    rng = np.random.default_rng(0)
    like = draw_surrogates(residual - 0.4 * directions[..., 0], seen, 100, rng)
    clean, caused = (
        score_problem(jacobian, directions, residual + size * directions[..., 0], seen, like)
        for size in (-0.4, 0.6)
    )
    assert clean.p_value > 0.05
    assert caused.p_value < 1e-4
    assert caused.null_scores.shape == (4, 100)
    np.testing.assert_allclose(np.quantile(caused.null_scores, 0.9, axis=1), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("first", "drawn"), [(0.5, [100]), (0.02, [100, 400]), (0.001, [100, 400]), (1e-5, [100])]
)
def test_a_chance_near_those_that_decide_is_found_from_more_surrogates(first, drawn):
    asked = []
    chances = iter([first, 0.3])
    test = SimpleNamespace(compute_scores=lambda *given: SimpleNamespace(p_value=next(chances)))
    found = compute_calibrated_scores(test, np.zeros((1, 9, 1)), asked.append, 100)
    assert asked == drawn
    assert found.p_value == (first if len(drawn) == 1 else 0.3)


def test_the_tail_beyond_the_surrogates_is_exponential():
    drawn = np.random.default_rng(1).exponential(2.0, size=(1, 4000))
    for value in (1.0, 4.0, 12.0, 40.0):
        assert np.log(estimate_tail_p_value(drawn, np.array([value]))) == pytest.approx(
            -value / 2, rel=0.12
        )
    assert estimate_tail_p_value(drawn, np.zeros(0)) == 1.0
    assert estimate_tail_p_value(np.zeros((1, 10)), np.array([5.0])) == pytest.approx(1 / 11), (
        "ten surrogates cannot say more"
    )


def test_an_effect_of_many_shapes_keeps_the_best_that_beat_their_neighbours():
    rng = np.random.default_rng(8)
    t = np.arange(400) / 100.0
    frequencies = np.linspace(0.5, 8.0, 40)
    waves = np.stack(
        [f(2 * np.pi * hertz * t) for hertz in frequencies for f in (np.sin, np.cos)], axis=-1
    )
    made = 0.5 * np.sin(2 * np.pi * frequencies[10] * t) + 0.3 * np.cos(
        2 * np.pi * frequencies[30] * t
    )
    residual = (made + 0.1 * rng.standard_normal(400))[None, :, None]
    seen = np.ones(residual.shape, dtype=bool)
    found = DirectionSet(
        tuple(CandidateDirection("wave", k // 2, k % 2, np.ones(3), True) for k in range(80)),
        waves[None, :, None],
    )
    fit = linear_fit(1e-9 * rng.standard_normal((1, 400, 1, 2)), 1)
    (peaks,) = score_candidates(fit, residual, found, seen, [0.1]).peaks
    by_place = {group.column_indices[0] // 2: c for group, c in peaks}
    assert {10, 30} <= set(by_place)
    np.testing.assert_allclose(by_place[10], [0.5, 0.0], atol=0.05)
    np.testing.assert_allclose(by_place[30], [0.0, 0.3], atol=0.05)
    assert len(peaks) == 3
