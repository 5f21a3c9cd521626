"""Grade an answer against the true causes of its case.

An answer is a dictionary as `explain` writes it (DESIGN §6).

| outcome | kinds of cases | when |
|---|---|---|
| right | all | clean: adequate; single, double: all causes, no other; foreign: unknown or partial |
| set | single, double | the cause is in a set of effects that the data cannot distinguish |
| class | single, double | an effect equivalent in any data is named (`equivalent_effects`) |
| one | double | one of the two is named (alone or in a set), the other is not |
| wrong | single, double, foreign | another effect is named; foreign: as full explanation |
| extra | single | the cause is named, and another one in addition |
| unnamed | single, double | a discrepancy is detected, no cause named |
| missed | single, double, foreign | nothing is detected |
| alarm | clean | a discrepancy is detected |
| undecided | all | the verdict is unidentifiable |
| failed | all | there is no answer: the diagnoser crashed or took too long |
| skipped | all | the diagnoser does not support the simulator; not counted |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.case_generation.effect_coefficients import list_coefficient_names
from bench.diagnosis_benchmark.case_generation.equivalent_effects import find_equivalent_effects

NamedSets = list[tuple[str, ...]]
CoverageCheck = Callable[[str, tuple[str, ...]], bool]
EquivalentEffects = Callable[[str], frozenset[str]]
MAX_SET_SIZE = 2
"""Maximum number of effects of a set in which a cause counts as identified."""


@dataclass(frozen=True)
class Grade:
    """Grade of an answer.

    Attributes:
        outcome: see this module.
        set_size: number of effects in the set that contains the true cause (the larger of two); 0
            if none does.
        class_size: number of effects in that set, with effects that are equivalent in any data
            counted as one.
        named: named causes, alternatives separated by bars: ``drag.linear|wind + force.bias``.
        covered: for each coefficient or parameter of a correct answer, whether the 95 % interval
            contains the true value; None if the interval is open.
    """

    outcome: str
    set_size: int
    class_size: int
    named: str
    covered: dict[str, bool | None]

    @property
    def is_correct(self) -> bool:
        """True if the cause is named alone or in a set of at most `MAX_SET_SIZE` effects."""
        return self.outcome == "right" or (self.outcome == "set" and self.set_size <= MAX_SET_SIZE)

    @property
    def is_correct_up_to_equivalence(self) -> bool:
        """True if the cause is named alone or in a small set, equivalent effects counted once."""
        return self.outcome == "right" or (
            self.outcome in ("set", "class") and self.class_size <= MAX_SET_SIZE
        )


def grade_answer(case: BenchmarkCase, verdict: Mapping[str, Any] | None) -> Grade:
    """Grade the verdict of a diagnoser on one benchmark case.

    An answer names causes; each is a set of effects that the data cannot distinguish, a leading
    effect and its alternatives. The grade depends on these sets; of a correct answer, the 95 %
    intervals of its numbers are compared with the true values, too.

    Args:
        case: the case with its true causes. Its kind is clean (no cause), single, double, or
            foreign (an unmodelled cause, which the library does not contain).
        verdict: the answer as a dictionary; None for a missing answer.

    Returns:
        * ``outcome``: right (every cause is named alone), set (in a set with alternatives), class
          (an equivalent effect is named), one (of two), extra (another one in addition), wrong,
          unnamed, missed, alarm, undecided, or failed (no answer),
        * ``set_size``: number of effects in the largest set that contains a true cause; 0 without,
        * ``class_size``: the same with equivalent effects counted as one,
        * ``named``: the named causes as text, such as ``drag.linear|wind + force.bias``,
        * ``covered``: by coefficient or parameter, whether its interval contains the true value.
    """
    if verdict is None:
        return Grade("failed", set_size=0, class_size=0, named="", covered={})
    # One tuple of names for each cause: the leading effect, then its alternatives.
    sets = list_named_sets(verdict)
    outcome, set_size, class_size = grade_sets(
        case.kind,
        case.effects,
        verdict,
        lambda effect: find_equivalent_effects(case.system, case.driven, effect),
    )
    covered = {}
    # An unmodelled cause has no coefficients, and parameters fitted without it are wrong.
    if outcome in ("right", "set") and case.kind != "foreign":
        covered = _check_interval_coverage(case, verdict, sets)
    named_effects = " + ".join("|".join(names) for names in sets)
    return Grade(outcome, set_size, class_size, named_effects, covered)


def list_named_sets(verdict: Mapping[str, Any]) -> NamedSets:
    """List every cause of an answer with its alternatives."""
    return [(cause["effect"], *cause["alternatives"]) for cause in verdict["causes"]]


def grade_sets(
    kind: str, effects: Iterable[str], verdict: Mapping[str, Any], equivalents: EquivalentEffects
) -> tuple[str, int, int]:
    """Grade an answer by its verdict and its named causes, depending on the kind of case.

    A clean case hides nothing, so only "adequate" is right. A foreign case hides a cause that the
    library does not contain, so the right answer is that no effect explains all. Every other kind
    hides effects of the library, which must be named.

    Args:
        kind: kind of the case: clean, single, double or foreign.
        effects: the hidden effects, at most two.
        verdict: the answer as a dictionary.
        equivalents: returns an effect and all effects that are equivalent to it in any data.

    Returns:
        Outcome (one word, such as right, wrong, missed or alarm); number of effects in the set of
        alternatives that contains the true cause; and number of effects in the set that contains
        it or an equivalent effect, equivalent effects counted as one. A number is 0 without such a
        set.
    """
    verdict_name, size, class_size = verdict["verdict"], 0, 0
    if kind == "clean":
        outcome = "right" if verdict_name == "adequate" else "alarm"
    elif verdict_name == "adequate":
        outcome = "missed"
    elif kind == "foreign":
        outcome = "right" if verdict_name in ("unknown", "partial") else "wrong"
    else:
        sets = list_named_sets(verdict)
        outcome, size, class_size = _grade_library(list(effects), verdict_name, sets, equivalents)
    return ("undecided" if verdict_name == "unidentifiable" else outcome), size, class_size


def _grade_library(
    effects: Sequence[str], verdict_name: str, sets: NamedSets, equivalents: EquivalentEffects
) -> tuple[str, int, int]:
    """Grade an answer on one or two effects of the library.

    An answer is right if each effect is in a set of its own and no set is without an effect. The
    sets are matched twice: to the effects themselves (`exact_matches`), and to effects that are
    equivalent in any data (`equivalent_matches`). Outcomes are tested from the worst to the best:

    * unnamed: no cause is named,
    * wrong, one: no hidden effect is named, or only one of two,
    * extra: all are named, and another effect in addition,
    * class: an effect is replaced by an equivalent one,
    * set, right: all are named, in sets of several alternatives or alone.

    Args:
        effects: the hidden effects.
        verdict_name: verdict of the answer, as "named".
        sets: sets of effects that an answer names; those of one set are alternatives.
        equivalents: returns an effect and all effects that are equivalent to it.

    Returns:
        Outcome, size of the largest matched set, and the same with equivalent effects counted once.
    """
    # Effects listed with the verdict "unknown" are not named.
    if not sets or verdict_name == "unknown":
        return "unnamed", 0, 0
    exact_matches = _match_sets_to_effects(effects, sets, lambda effect, names: effect in names)
    equivalent_matches = _match_sets_to_effects(
        effects, sets, lambda effect, names: bool(equivalents(effect) & set(names))
    )
    if len(equivalent_matches) < len(effects):
        return ("one" if equivalent_matches else "wrong"), 0, 0
    largest_set = max(len(sets[set_index]) for set_index in equivalent_matches.values())
    class_count = max(
        _count_classes(sets[set_index], equivalents) for set_index in equivalent_matches.values()
    )
    if len(sets) > len(effects):
        return "extra", largest_set, class_count
    if len(exact_matches) < len(effects):
        return "class", 0, class_count  # only equivalent effects are named
    largest_set = max(len(sets[set_index]) for set_index in exact_matches.values())
    return ("right" if largest_set == 1 else "set"), largest_set, class_count  # set of one: alone


def _match_sets_to_effects(
    effects: Iterable[str], sets: NamedSets, is_in_set: CoverageCheck
) -> dict[str, int]:
    """Assign effects to sets, each set to at most one effect.

    An effect that takes the first set in which it is may leave none for the other effect. With at
    most two effects, it suffices to try both orders of effects and of sets.

    Args:
        effects: the hidden effects, at most two.
        sets: sets of effects that an answer names; those of one set are alternatives.
        is_in_set: returns whether a set contains an effect.

    Returns:
        Index of the set of each effect, for the assignment with the most effects.
    """
    most_matches: dict[str, int] = {}
    for order in (list(effects), list(effects)[::-1]):
        for takes_last_set in (False, True):
            matches: dict[str, int] = {}
            for effect in order:
                matching_sets = [
                    i
                    for i, names in enumerate(sets)
                    if is_in_set(effect, names) and i not in matches.values()
                ]
                if matching_sets:
                    matches[effect] = matching_sets[-1 if takes_last_set else 0]
            most_matches = max(most_matches, matches, key=len)
    return most_matches


def _count_classes(names: Sequence[str], equivalents: EquivalentEffects) -> int:
    """Count the distinct effects of a set, equivalent effects counted as one.

    A name ``effect@*`` means the effect at any joint. It is not counted if the set also contains
    the effect at one joint, as ``effect@elbow``.

    Args:
        names: names of the effects in the set.
        equivalents: returns an effect and all effects that are equivalent to it in any data.
    """
    effects_at_joints = {name.partition("@")[0] for name in names if not name.endswith("@*")}
    counted_names = [
        name
        for name in names
        if not name.endswith("@*") or name.partition("@")[0] not in effects_at_joints
    ]
    # The alphabetically first equivalent effect represents its class.
    return len({min(equivalents(name)) for name in counted_names})


def _check_interval_coverage(
    case: BenchmarkCase, verdict: Mapping[str, Any], sets: NamedSets
) -> dict[str, bool | None]:
    """Compare the intervals of base parameters and of leading causes with the true values.

    The intervals of a correct diagnoser must be calibrated, too: about 95 % of them should contain
    the true value.

    Args:
        case: the case with its true causes.
        verdict: the answer as a dictionary.
        sets: the named sets; the first name of each is its leading cause.

    Returns:
        By parameter or coefficient, whether the 95 % interval contains the true value; see
        `Grade`. It is empty if a leading cause is wrong.
    """
    truth, intervals = dict(case.parameters), dict(verdict["parameters"])
    leading_causes = {names[0] for names in sets}
    for cause in verdict["causes"]:
        if cause["effect"] in case.effects:
            names = list_coefficient_names(case.system, cause["effect"])
            for name, value in zip(names, case.effects[cause["effect"]], strict=False):
                truth[f"{cause['effect']}.{name}"] = value
                intervals[f"{cause['effect']}.{name}"] = cause["coefficients"].get(name)
    if not set(case.effects) <= leading_causes:
        return {}  # parameters fitted together with a wrong cause are not comparable
    # Not every diagnoser gives intervals for all numbers.
    return {
        name: contains_value(intervals[name], value)
        for name, value in truth.items()
        if intervals.get(name)
    }


def contains_value(estimate: Mapping[str, float | None], value: float) -> bool | None:
    """Return whether a 95 % interval contains a value; None if the interval is open.

    Args:
        estimate: bounds ``low`` and ``high``, of which None is an open end.
        value: the true value.
    """
    low, high = estimate["low"], estimate["high"]
    if low is None or high is None:
        return None
    return bool(low <= value <= high)
