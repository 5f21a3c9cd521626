import numpy as np
import pytest

from bench.diagnosis.evaluation.autoregressive_surrogates import draw_surrogates
from tests.bench.diagnosis.explained_samples import autocorrelation, correlated, everything, holes


def test_surrogates_keep_variance_and_autocorrelation():
    rng = np.random.default_rng(12)
    made = rng.standard_normal((6, 700, 2))
    # The first channel is an oscillating second-order autoregression, the second is white noise.
    ringing = made[:, :, 0]
    for t in range(2, 700):
        ringing[:, t] += 1.2 * ringing[:, t - 1] - 0.6 * ringing[:, t - 2]
    made *= [0.01, 5.0]
    like = draw_surrogates(made, everything(made), 60, np.random.default_rng(0))
    assert like.shape == (60, 6, 700, 2)
    spread = like.std(axis=(0, 1, 2))
    np.testing.assert_allclose(spread, made.std(axis=(0, 1)), rtol=0.05)
    for lag in range(1, 9):
        for c in range(2):
            kept = autocorrelation(like[..., [c]], lag)
            own = autocorrelation(made[..., [c]], lag)
            assert kept == pytest.approx(own, abs=0.05), (lag, c)
    apart = np.corrcoef(like[:, 0, :, 0])[np.triu_indices(60, 1)]
    assert abs(apart.mean()) < 0.01, "one surrogate tells nothing of another"


def test_surrogates_are_the_same_for_a_seed_and_zero_where_nothing_was_seen():
    made = correlated(np.random.default_rng(13), 0.6, 1.0, (3, 100, 1))
    seen = holes(made.shape, 0.2, 14)
    residual = np.where(seen, made, 0.0)
    generators = [np.random.default_rng(seed) for seed in (5, 5, 6)]
    one, two, other = (draw_surrogates(residual, seen, 7, rng) for rng in generators)
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)
    assert (one[:, ~seen] == 0).all()
    assert (one[:, seen] != 0).all()


def test_surrogates_have_no_offset_whatever_the_residual_has():
    made = correlated(np.random.default_rng(15), 0.8, 1.0, (4, 300, 1)) + 2.0
    like = draw_surrogates(made, everything(made), 80, np.random.default_rng(0))
    # There are 80 x 4 x 300 samples with a correlation time of about nine samples.
    assert abs(like.mean()) < 4 * like.std() * 3 / np.sqrt(like.size)


def test_surrogates_of_nothing_are_nothing():
    seen = np.ones((1, 30, 1), dtype=bool)
    nothing = np.zeros((1, 30, 1))
    assert not draw_surrogates(nothing, seen, 5, np.random.default_rng(0)).any()


def test_surrogates_of_few_samples_are_those_samples():
    seen = np.ones((1, 3, 1), dtype=bool)
    values = np.array([1.0, -2.0, 3.0]).reshape(1, 3, 1)
    few = draw_surrogates(values, seen, 9, np.random.default_rng(0))
    assert set(np.abs(few).ravel()) <= {1.0, 2.0, 3.0}


def test_residuals_of_surrogates_are_as_autocorrelated_as_those_of_the_noise():
    """Removing an offset and a slope from runs of 60 samples reduces the autocorrelation."""
    times = np.linspace(-1.0, 1.0, 60)
    absorbed, _ = np.linalg.qr(np.stack([np.ones(60), times], axis=1))

    def left(noises):
        taken = np.einsum("tk,...tc->...kc", absorbed, noises)
        return noises - np.einsum("tk,...kc->...tc", absorbed, taken)

    rng = np.random.default_rng(16)
    own, naive, corrected = [], [], []
    for _ in range(60):
        residual = left(correlated(rng, 0.85, 1.0, (3, 60, 1)))
        seen = everything(residual)
        own.append(autocorrelation(residual, 1))
        naive.append(autocorrelation(left(draw_surrogates(residual, seen, 40, rng)), 1))
        again = draw_surrogates(residual, seen, 40, rng, project_out=left)
        corrected.append(autocorrelation(left(again), 1))
    assert np.mean(corrected) == pytest.approx(np.mean(own), abs=0.015)
    assert np.mean(naive) < np.mean(own) - 0.04, "without it their autocorrelation is too small"


def test_white_noise_has_nothing_to_correct():
    made = np.random.default_rng(17).standard_normal((2, 2000, 1))
    usual = draw_surrogates(made, everything(made), 5, np.random.default_rng(0))
    asked = []

    def left(noises):
        asked.append(noises)
        return noises

    like = draw_surrogates(made, everything(made), 5, np.random.default_rng(0), project_out=left)
    np.testing.assert_array_equal(like, usual)
    assert not asked
