"""Tests of the subsampled search of long recordings, confirmed on all samples."""

import numpy as np
import pytest

from bench.diagnosis.evaluation.search_control import SearchControl, SearchStoppedError
from bench.diagnosis.search import alternative_causes, subsampled_search
from bench.diagnosis.search.alternative_causes import refine_best_model
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.subsampled_search import search_with_subsampling
from tests.bench.diagnosis.explained_samples import recording, searched

SIGMA = [0.003]
WITH_FRICTION = {"effects": ["friction.coulomb=0.3"], "observe": ["x"], "noise": ["x=0.003"]}


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """Lower the sample limits so that short runs are thinned."""
    monkeypatch.setattr(subsampled_search, "MIN_SAMPLES_TO_THIN", 600)
    monkeypatch.setattr(subsampled_search, "MIN_THINNED_SAMPLES", 100)


@pytest.fixture(scope="module")
def log():
    return recording("slider", runs=2, seconds=1.5, rate=400.0, seed=3, **WITH_FRICTION)


@pytest.fixture
def search(log):
    return searched(log, SIGMA)[0]


@pytest.mark.slow
def test_what_few_samples_show_is_fitted_to_all_of_them(search, log, monkeypatch):
    found = refine_best_model(search, search_with_subsampling(search))
    assert found.effects == ("friction.coulomb",)
    assert found.fit.simulated.shape == search.evaluator.observed.shape
    assert search.settled_effects == {"friction.coulomb"}
    monkeypatch.setattr(subsampled_search, "MIN_SAMPLES_TO_THIN", 10_000)
    usual = searched(log, SIGMA)[0]
    same = refine_best_model(usual, search_with_subsampling(usual))
    assert same.effects == found.effects
    (place,) = search.evaluator.get_coefficient_indices("friction.coulomb")
    assert found.fit.theta[place] == pytest.approx(same.fit.theta[place], rel=1e-3)
    assert len(search.models) < len(usual.models), "few of them are fitted to all samples"


def test_where_all_samples_show_more_the_search_is_made_on_all(search, monkeypatch):
    monkeypatch.setattr(
        subsampled_search, "_is_confirmed_by_all_samples", lambda search, model: False
    )
    asked = []
    run = EffectSearch.run

    def counted(self):
        asked.append(self.evaluator.observed.shape[1])
        return run(self)

    monkeypatch.setattr(EffectSearch, "run", counted)
    assert search_with_subsampling(search).effects == ("friction.coulomb",)
    assert asked == [150, 600]
    assert search.settled_effects is None


def test_what_shows_nothing_is_not_searched_with_fewer_samples(monkeypatch):
    clean = recording(
        "slider", runs=2, seconds=1.5, rate=400.0, seed=3, observe=["x"], noise=["x=0.003"]
    )
    search, base = searched(clean, SIGMA)
    monkeypatch.setattr(alternative_causes, "refine_best_model", None)
    assert search_with_subsampling(search) is base


def test_a_search_that_has_to_end_tells_what_few_samples_support(search, monkeypatch):
    ended = SearchControl(stop=lambda: any(len(m.effects) > 0 for m in foreseen))
    foreseen = []
    enter = EffectSearch.add_fit

    def watched(self, fit):
        model = enter(self, fit)
        if self is not search:
            foreseen.append(model)
        return model

    monkeypatch.setattr(EffectSearch, "add_fit", watched)
    search.evaluator.search_control = ended
    with pytest.raises(SearchStoppedError):
        search_with_subsampling(search)
    assert search.best_supported_model is not None
    assert np.isfinite(search.best_supported_model.penalised_log_likelihood)
    assert search.get_best_so_far() is search.best_supported_model
