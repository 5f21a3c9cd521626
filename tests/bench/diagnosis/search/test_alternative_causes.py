from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.search.alternative_causes import AlternativeFinder
from bench.diagnosis.search.held_out_model_choice import HeldOutValidation
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from tests.bench.diagnosis.search.search_models import held_out, model, search_of

BEST = model("a", likelihood=100.0)
INDISTINGUISHABLE = model("b", likelihood=100.0 - 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO)
DISTINGUISHABLE = model("c", likelihood=100.0 - 2.0 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO)


def placed(place="", contains=(), coordinate=None):
    return SimpleNamespace(place=place, contains=contains, coordinate=coordinate)


def evidence(
    monkeypatch, trial=None, structure=False, plausible="abc", luck=0.0, best=1e-5, sizes=(1, 1, 1),
    loops=(), excess_of_ranges=None, **excess,
):  # fmt: skip
    scores = SimpleNamespace(
        effects=("a", "b", "c"), null_quantiles=np.full(3, luck), null_scores=np.zeros((3, 40))
    )
    search = search_of(
        model(),
        BEST,
        INDISTINGUISHABLE,
        DISTINGUISHABLE,
        excess={(n,): e for n, e in excess.items()},
    )
    search.scores_by_effects = {frozenset(): scores}
    search.best_p_values = {frozenset(): best}
    slots = {name: slice(0, size) for name, size in zip("abc", sizes, strict=True)}
    effects = {name: placed(coordinate=joint) for joint, name in enumerate("abc")}
    search.evaluator = SimpleNamespace(
        available_effects=effects,
        get_coefficient_indices=lambda name: range(slots[name].stop),
        has_linearisation=False,
        simulator=SimpleNamespace(system=SimpleNamespace(loops=loops)),
    )
    ranks = {name: 1.0 if name in plausible else 2.0 for name in "abc"} | (excess_of_ranges or {})
    monkeypatch.setattr(
        AlternativeFinder, "_compute_range_excess", lambda self, effect: ranks[effect]
    )
    (found,) = AlternativeFinder(search, trial, structure).collect_evidence(BEST)
    return found


def significant_evidence(monkeypatch, search):
    """Return the evidence for the best model if all effects are plausible and significant."""
    monkeypatch.setattr(AlternativeFinder, "_compute_range_excess", lambda self, effect: 1.0)
    monkeypatch.setattr(AlternativeFinder, "_compute_p_value", lambda self, rest, effect, gain: 0.0)
    (found,) = AlternativeFinder(search, None, structure=False).collect_evidence(BEST)
    return found


def test_what_is_not_behind_by_the_odds_is_an_alternative(monkeypatch):
    found = evidence(monkeypatch)
    assert (found.effect, found.alternatives, found.preferred) == ("a", ("b",), "a")
    assert found.gain == pytest.approx(100.0)
    assert found.p_value <= 1e-5


@pytest.mark.parametrize(
    ("loops", "excess", "alternatives"),
    [
        ((), 0.0, ("b",)),
        (({0, 2},), 0.0, ("c", "b")),
        (({0, 2},), 0.5, ("b",)),
        (({1, 2},), 0.0, ("b",)),
    ],
)
def test_in_a_loop_the_excess_decides(monkeypatch, loops, excess, alternatives):
    """Effect c is far behind by its likelihood, but leaves as little of the data unexplained."""
    found = evidence(monkeypatch, loops=loops, a=0.0, b=0.0, c=excess)
    assert found.alternatives == alternatives


@pytest.mark.parametrize(
    ("luck", "best", "p_value"), [(150.0, 1e-5, 1e-5), (0.0, 0.7, 0.0), (150.0, 1.0, 1.0)]
)
def test_the_refit_or_the_best_score_may_see_that_it_is_no_chance(monkeypatch, luck, best, p_value):
    """The gain of 100 is above all surrogates or below the null quantile; the score also counts."""
    assert evidence(monkeypatch, luck=luck, best=best).p_value == pytest.approx(p_value, abs=1e-12)


def test_a_competitor_with_plausible_coefficients_is_preferred(monkeypatch):
    assert evidence(monkeypatch, plausible="bc").preferred == "b"


def test_of_two_implausible_effects_that_nearer_to_its_range_is_preferred(monkeypatch):
    found = evidence(monkeypatch, excess_of_ranges={"a": 200.0, "b": 1.5, "c": 1.2})
    assert found.preferred == "b", "c is distinguishable"


def test_held_out_runs_have_a_voice(monkeypatch):
    left = {("a",): 1.0, ("b",): 1.2, ("c",): 0.8}
    found = evidence(monkeypatch, HeldOutValidation(*held_out(left)))
    assert found.alternatives == ("c",), "merits of both add up"
    assert found.preferred == "c"


def test_where_structure_is_left_what_it_leaves_decides_and_the_effect_stands(monkeypatch):
    found = evidence(monkeypatch, structure=True, a=1.0, b=1.5, c=0.9, plausible="bc")
    assert found.alternatives == ("c",)
    assert found.preferred == "a"


@pytest.mark.parametrize(
    ("sizes", "left", "alternatives"),
    [
        ((1, 1, 2), 0.97, ()),
        ((1, 1, 2), 0.9, ("c",)),
        ((1, 1, 4), 0.9, ()),
        ((1, 1, 4), 0.8, ("c",)),
        ((4, 1, 4), 0.97, ("c",)),
        ((4, 1, 1), 1.02, ("c",)),
    ],
)
def test_more_numbers_that_leave_as_much_structure_are_no_alternative(
    monkeypatch, sizes, left, alternatives
):
    found = evidence(monkeypatch, structure=True, sizes=sizes, a=1.0, b=9.0, c=left)
    assert found.alternatives == alternatives


@pytest.mark.parametrize("place", ["*", "elbow"])
@pytest.mark.parametrize(
    ("family", "contains", "kept"),
    [("b", ("a",), ()), ("a", ("b",), ("b",)), ("b", ("c",), ("b",))],
)
def test_what_contains_a_place_or_law_that_does_as_well_is_no_answer(
    monkeypatch, family, contains, kept, place
):
    """The simpler effect is preferred; a family whose place scores far lower stays in the set."""
    search = search_of(model(), BEST, INDISTINGUISHABLE, DISTINGUISHABLE)
    effects = {name: placed() for name in "abc"} | {family: placed(place, contains)}
    search.evaluator = SimpleNamespace(available_effects=effects, has_linearisation=False)
    found = significant_evidence(monkeypatch, search)
    assert found.alternatives == kept
    assert found.preferred == ("b" if family == "a" else "a")


@pytest.mark.parametrize(("lower_bound", "alternatives"), [(-1.0, ("b",)), (0.1, ())])
def test_the_null_gain_of_one_of_two_signs_does_not_count_for_a_robot(
    lower_bound, alternatives, monkeypatch
):
    """Only an effect with shape parameters keeps its penalty."""
    search = search_of(
        model(), BEST, model("b", likelihood=100.0 - 3.0 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO)
    )
    search.evaluator = SimpleNamespace(
        available_effects={"a": placed(), "b": placed()},
        has_linearisation=True,
        parameters=[SimpleNamespace(bounds=(lower_bound, 1.0))] * 2,
        coefficient_slices={"a": slice(0, 1), "b": slice(1, 2)},
    )
    search.get_effect_penalty = {"a": 0.0, "b": 3.0 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO}.get
    found = significant_evidence(monkeypatch, search)
    assert found.alternatives == alternatives
