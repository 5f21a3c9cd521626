"""Tests of the p-values at which a search accepts an effect or stops."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_model import Likelihood
from bench.diagnosis.fitting.fitted_models import FAILED_LIKELIHOOD
from bench.diagnosis.search.effect_search import EffectSearch, is_hopeless
from tests.bench.diagnosis.explained_samples import recording, searched
from tests.bench.diagnosis.search.search_models import model, search_of

BASE, LARGER = model(likelihood=10.0), model("a", likelihood=30.0)


def search(monkeypatch, **answers):
    """Return a search with two fitted models and fixed results of its methods."""
    made = EffectSearch.__new__(EffectSearch)
    made.models = {frozenset(m.effects): m for m in (BASE, LARGER)}
    for question, answer in answers.items():
        asked = answer if callable(answer) else lambda *_, answer=answer: answer
        monkeypatch.setattr(EffectSearch, question, asked)
    return made


@pytest.mark.parametrize(
    ("likelihood", "p_value", "taken"),
    [(30.0, 0.0029, True), (30.0, 0.0031, False), (9.9, 0.0, False), (10.1, 0.0, True)],
)
def test_an_effect_is_taken_that_has_merit_and_is_no_chance(
    monkeypatch, likelihood, p_value, taken
):
    larger = model("a", likelihood=likelihood)
    made = search(
        monkeypatch, is_complete=lambda self, best, p_value: best is not BASE,
        compute_missing_effect_p_value=p_value,
        _search_size=lambda self, best, size: larger, compute_excess_residual=0.1,
        is_noise_like=False,
        correct_step_errors=lambda self, model: model,
    )  # fmt: skip
    assert made.run() is (larger if taken else BASE)


def test_where_nothing_suggests_an_effect_none_is_tried(monkeypatch):
    p_values, sizes = [], []

    def plain(self, best, p_value):
        p_values.append(p_value)
        return best is LARGER

    def grown(self, best, size):
        sizes.append(size)
        return LARGER

    asked = {
        "is_complete": plain, "_search_size": grown, "compute_missing_effect_p_value": 0.0,
        "compute_excess_residual": 0.1, "is_noise_like": False,
    }  # fmt: skip
    asked["correct_step_errors"] = lambda self, model: model
    assert search(monkeypatch, **asked).run() is LARGER
    assert (p_values, sizes) == ([0.1, 0.015], [1]), "a second effect needs stronger evidence"


@pytest.mark.parametrize(
    ("p_value", "quiet", "plain"),
    [(0.11, True, True), (0.09, True, False), (0.11, False, False), (0.1, True, False)],
)
def test_a_model_is_plain_that_neither_scores_nor_loudness_doubt(
    monkeypatch, p_value, quiet, plain
):
    made = search(
        monkeypatch, score_missing_effects=SimpleNamespace(p_value=p_value), is_noise_like=quiet
    )
    assert made.is_complete(BASE, 0.1) is plain


def scores(p_value, lucky):
    """Return scores of two effects; 100 surrogates exceed their null quantile by 0, 1, ... 99."""
    drawn = np.vstack([np.arange(100.0), np.full(100, -50.0)])
    return SimpleNamespace(
        effects=("a", "b"),
        null_quantiles=np.array([lucky, 0.0]),
        null_scores=drawn,
        p_value=p_value,
    )


def test_a_gain_counts_less_what_luck_gives_its_effects(monkeypatch):
    """The gain is 20: with a null quantile of 12, 92 of 100 surrogates exceed it, without it 80."""
    about = {None: scores(0.9, 5.0), "larger": scores(0.95, 0.0)}
    made = search(
        monkeypatch,
        score_missing_effects=lambda self, m, against=None: about["larger" if against else None],
        compute_residual="what the larger model leaves",
    )  # fmt: skip
    assert made.compute_missing_effect_p_value(BASE, LARGER) == pytest.approx(81 / 101)
    about["larger"] = scores(0.02, 0.0)
    assert made.compute_missing_effect_p_value(BASE, LARGER) == pytest.approx(0.02), (
        "the best score may see more"
    )
    about["larger"] = scores(0.9, 12.0)
    assert made.compute_missing_effect_p_value(BASE, LARGER) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("sigma", "stated", "p_value", "quiet"),
    [
        (1.29, True, 0.0, True),
        (1.31, True, 1.0, False),
        (1.31, False, 0.011, True),
        (1.31, False, 0.009, False),
        (6.9, False, 1.0, True),
        (7.1, False, 1.0, False),
    ],
)
def test_the_residual_may_be_noise_up_to_the_floor_or_if_its_correlation_decays(
    monkeypatch, sigma, stated, p_value, quiet
):
    monkeypatch.setattr(
        "bench.diagnosis.search.scored_models.compute_portmanteau_p_value", lambda *_: p_value
    )
    made = search(monkeypatch, compute_residual=np.zeros((1, 1, 1)))
    made.evaluator = SimpleNamespace(observed=np.zeros((1, 1, 1)))
    made.noise = SimpleNamespace(sigma=np.array([2.0]))
    made.is_noise_stated = np.array([stated])
    likelihood = Likelihood(0.0, 2.0 * np.array([sigma]), None)
    asked = SimpleNamespace(fit=SimpleNamespace(cost=1.0), likelihood=likelihood)
    assert made.is_noise_like(asked) is quiet


def test_a_model_that_could_not_be_simulated_leaves_no_noise(monkeypatch):
    made = search(monkeypatch)
    made.noise = SimpleNamespace(sigma=np.array([2.0]))
    failed = SimpleNamespace(fit=SimpleNamespace(cost=np.inf), likelihood=FAILED_LIKELIHOOD)
    assert made.is_noise_like(failed) is False


def test_pieces_that_explain_nothing_leave_nothing_to_refit(monkeypatch):
    """Segments searched with fewer effects may have no model with this number of effects."""
    recorded = recording("pendulum", noise=["0.01"], observe=["q"], runs=2, seconds=4.0, rate=50.0)
    made, _ = searched(recorded, 0.01, candidates=["friction.coulomb", "gravity.tilt"])
    made.refit_from_segments(1)
    known = set(made.models)
    assert {len(names) for names in known} == {0, 1}, "the pieces are searched"

    monkeypatch.setattr(EffectSearch, "refit_extensions", lambda *args: None)
    made.refit_from_segments(2)
    assert set(made.models) == known


@pytest.mark.parametrize(
    ("thorough", "nearest", "hopeless"),
    [(False, 3.0, True), (True, 3.0, False), (True, 4.4, True), (False, 4.4, True)],
)
def test_a_thorough_search_goes_on_where_the_nearest_models_come_nearer(
    thorough, nearest, hopeless
):
    """The best single effect leaves 5 (0.85 of it is 4.25); its extension leaves 4.9."""
    left = {(): 20.0, ("a",): 5.0, ("a", "b"): 4.9, ("c", "d"): nearest}
    models = [model(*names) for names in left]
    asked = search_of(*models, excess=left)
    asked.base_model, asked.thorough = models[0], thorough
    assert is_hopeless(asked, models[2]) is hopeless
