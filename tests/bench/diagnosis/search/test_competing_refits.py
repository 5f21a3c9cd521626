from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.search import alternative_causes as settling
from bench.diagnosis.search.alternative_causes import (
    FAR_EXCESS,
    MAX_COMPETITOR_DISTANCE,
    MAX_COMPETITOR_EXCESS_RATIO,
    list_competing_models,
    refine_best_model,
    select_decisive,
)
from tests.bench.diagnosis.search.search_models import model, search_of


def test_competitors_are_near_by_likelihood_or_by_their_residual():
    best = model("a", likelihood=100.0)
    by_merit = model("b", likelihood=100.0 - 0.9 * MAX_COMPETITOR_DISTANCE)
    by_excess, far = model("c"), model("d")
    larger = model("a", "b", likelihood=100.0)
    excess = {
        ("a",): 1.0,
        ("b",): 9.0,
        ("c",): 0.9 * MAX_COMPETITOR_EXCESS_RATIO,
        ("d",): 1.1 * MAX_COMPETITOR_EXCESS_RATIO,
    }
    search = search_of(best, by_merit, by_excess, far, larger, excess=excess)
    assert [m.effects for m in list_competing_models(search, best)] == [("a",), ("b",), ("c",)]


@pytest.mark.parametrize(("structure", "stands"), [(False, "b"), (True, "a")])
def test_a_competitor_that_is_better_after_convergence_stays_unless_structure_remains(
    monkeypatch, structure, stands
):
    base, best = model(), model("a", likelihood=100.0)
    search = search_of(base, best, model("b", likelihood=90.0))
    search.evaluator = SimpleNamespace(library=["a", "b"])
    refits = []

    def refit(starts, noise):
        refits.append(([start.effects for start in starts], noise))
        search.models[frozenset("b")] = model("b", likelihood=110.0)

    search.refit_models, search.refit_extensions = refit, lambda models, max_effects: None
    monkeypatch.setattr(settling, "generate_shifted_starts", lambda evaluator, fit: [])
    monkeypatch.setattr(
        settling,
        "assess_lack_of_fit",
        lambda search, model: SimpleNamespace(has_structure=structure),
    )
    assert refine_best_model(search, best).effects == (stands,)
    ((effects, noise),) = refits
    assert effects == [("a",), ("b",), ()], (
        "the best model, its competing models and the base model"
    )
    if structure:
        assert noise is None
    else:
        assert isinstance(noise, NoiseModel)
        assert np.array_equal(noise.sigma, [1.0])


def test_a_competitor_of_a_pair_also_starts_from_the_shared_effects(monkeypatch):
    """Fits of a law with many parameters end in different optima.

    A difference of 10.4 in twice the log-likelihood once hid that a command bias and a force bias
    are equivalent.
    """
    best, rival = model("a", "b", likelihood=100.0), model("a", "c", likelihood=90.0)
    best = replace(best, fit=replace(best.fit, theta=np.array([1.0, 2.0, 3.0, 0.0])))
    rival = replace(rival, fit=replace(rival.fit, theta=np.array([1.1, 2.2, 0.0, 4.0])))
    search = search_of(best, rival, model("a"), model("b"))
    slots = {"a": slice(1, 2), "b": slice(2, 3), "c": slice(3, 4)}
    search.evaluator = SimpleNamespace(library=["a", "b", "c"], coefficient_slices=slots)
    begun = []
    search.refit_models, search.refit_extensions = (
        lambda s, noise: begun.extend(s),
        lambda models, max_effects: None,
    )
    monkeypatch.setattr(settling, "generate_shifted_starts", lambda evaluator, fit: [])
    left = SimpleNamespace(has_structure=False)
    monkeypatch.setattr(settling, "assess_lack_of_fit", lambda search, model: left)
    refine_best_model(search, best)
    of_rival = [s.theta.tolist() for s in begun if s.effects == ("a", "c")]
    assert of_rival == [[1.1, 2.2, 0.0, 4.0], [1.0, 2.0, 0.0, 4.0]]
    assert len([s for s in begun if s.effects == ("a", "b")]) == 1


@pytest.mark.parametrize(("excess", "count"), [(FAR_EXCESS, 2), (0.9 * FAR_EXCESS, 3)])
def test_far_from_noise_only_competitors_of_one_effect_decide(excess, count):
    best, neighbour, other = model("a", "b"), model("b", "c"), model("c", "d")
    search = search_of(best, neighbour, other, excess={m.effects: excess for m in (best,)})
    found = select_decisive(search, best, [best, neighbour, other])
    assert found == [best, neighbour, other][:count]
