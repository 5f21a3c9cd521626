"""Tests of the results that are cached between score tests of one model."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.search_control import SearchControl
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit
from tests.bench.cli.test_search_progress import Events
from tests.bench.diagnosis.explained_samples import recording, searched


def search_slider(candidates, **options):
    """Return a search of two runs of a slider, and its base model."""
    recorded = recording("slider", noise=["0.01"], observe=["x"], runs=2, rate=50.0, **options)
    return searched(recorded, 0.01, candidates=candidates)


@pytest.mark.parametrize(("moved", "anew"), [(0.01, False), (1.0, True)])
def test_directions_are_simulated_anew_where_a_model_has_moved(moved, anew):
    """A fit that differs by `moved` sigmas RMS replaces the base model."""
    search, base = search_slider(["friction.coulomb", "spring.linear"], seconds=2.0)
    search.score_missing_effects(base)
    once = search.evaluator.simulation_count
    assert search.score_missing_effects(base) is search.cached_scans[frozenset()].scores

    shifted = replace(base.fit, simulated=base.fit.simulated + moved * 0.01, cost=0.0)
    search.models[frozenset()] = replace(base, penalised_log_likelihood=-np.inf)
    again = search.add_fit(shifted)
    scores = search.score_missing_effects(again)
    assert (search.evaluator.simulation_count > once) is anew
    # The residual is that of the new fit, even if the directions are those of the old one.
    assert scores is not search.superseded_scans.get(frozenset())
    assert set(scores.effects) == {"friction.coulomb", "spring.linear"}
    np.testing.assert_array_equal(
        search.cached_scans[frozenset()].fit.simulated, (shifted if anew else base.fit).simulated
    )


def test_scores_at_the_base_model_are_reported_after_a_better_fit_replaced_it():
    search, base = search_slider(["friction.coulomb", "spring.linear"], seconds=2.0)
    assert search.base_scores is None
    scores = search.score_missing_effects(base)
    assert search.base_scores is scores
    search.models[frozenset()] = replace(base, penalised_log_likelihood=-np.inf)
    search.add_fit(base.fit)
    assert frozenset() not in search.scores_by_effects
    assert search.base_scores is scores


def test_scores_of_a_model_do_not_depend_on_earlier_scores():
    chances = []
    for first in (True, False):
        search, base = search_slider(
            ["friction.coulomb", "spring.linear", "drag.linear"], effects=["friction.coulomb=0.1"]
        )
        start = replace(base.fit.make_start(), effects=("drag.linear",))
        search.refit_models([start])
        larger = search.models[frozenset(["drag.linear"])]
        models = [base, larger] if first else [larger, base]
        for model in models:
            search.score_missing_effects(model)
            assess_lack_of_fit(search, model)
        chances.append(
            [
                *search.score_missing_effects(base).null_quantiles,
                *search.score_missing_effects(larger).null_quantiles,
            ]
        )
        chances[-1].append(assess_lack_of_fit(search, larger).p_value)
    assert chances[0] == chances[1]


def test_what_was_scored_longest_ago_makes_room_and_is_scored_again_alike(monkeypatch):
    names = ["drag.linear", "spring.linear"]
    search, base = search_slider(["friction.coulomb", *names], effects=["friction.coulomb=0.1"])
    search.refit_models([replace(base.fit.make_start(), effects=(name,)) for name in names])
    first, second = (search.models[frozenset([name])] for name in names)
    search.score_missing_effects(base)
    before = search.score_missing_effects(first)
    held = {frozenset(), frozenset(first.effects)}
    assert set(search.cached_scans) == held

    # The cache has space for one model next to the base model.
    size = search.cached_scans[frozenset(first.effects)].directions.responses.nbytes
    monkeypatch.setattr("bench.diagnosis.search.scored_models.DIRECTION_CACHE_BYTES", 1.5 * size)
    search.score_missing_effects(second)
    assert set(search.cached_scans) == {frozenset(), frozenset(second.effects)}
    once = search.evaluator.simulation_count
    assert search.score_missing_effects(first) is before
    assert search.evaluator.simulation_count == once

    # Extensions of both models are fitted, including those of the dropped model.
    search.refit_extensions([first, second], 3)
    assert search.scores_by_effects[frozenset(first.effects)] is before
    known = {frozenset([*one, "friction.coulomb"]) for one in (first.effects, second.effects)}
    assert known <= set(search.models)


def test_a_survey_of_several_models_reports_each_of_them():
    candidates = ["friction.coulomb", "spring.linear", "drag.linear"]
    search, _ = search_slider(candidates, seconds=2.0)
    names = [("friction.coulomb",), ("spring.linear",)]
    search.refit_models([replace(search.base_model.fit.make_start(), effects=one) for one in names])
    heard = Events()
    search.evaluator.search_control = SearchControl(listener=heard)
    search.refit_extensions([search.models[frozenset(one)] for one in names], 0)
    stage = heard.stages.index(("testing 2 effects added to each of 2 models", 2))
    assert heard.finished[stage] == 2
