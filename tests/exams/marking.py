"""Grade an answer of `simgap explain`, by effect and place, with one function for all exams.

Outcomes are those of `bench.diagnosis_benchmark.grading`. Where it says that another cause is named
("wrong"), this module says how near the answer is, and it grades families and numerics.

| outcome | kinds | condition |
|---|---|---|
| place | single, double | the effect is named at another place |
| effect | single, double | another effect is named at the place |
| member | family | causes of the family are named place by place |
| number | single | the cause is named alone with a wrong number, where the number counts |
| partial | single | the same cause, but the verdict is `partial`, where that counts |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field

from bench.diagnosis_benchmark.grading import contains_value, grade_sets, list_named_sets


@dataclass(frozen=True)
class Standard:
    """Standard of a good answer in an exam.

    Attributes:
        max_set: largest set of causes that is still informative.
        equal_below: causes are equal if their ratio to the hidden one is at most this value.
        small_sets_are_fair: whether a set of at most `max_set` is fair without comparison.
        largest_fair_set: largest set that can be fair; its other members must all be compared.
        number_counts: whether a right answer needs a right number and a complete explanation.
    """

    max_set: int = 4
    equal_below: float = 1.05
    small_sets_are_fair: bool = False
    largest_fair_set: int | None = None
    number_counts: bool = False


@dataclass(frozen=True)
class HiddenCause:
    """Hidden cause of a case.

    Attributes:
        kind: clean, single, double, foreign, family or numerics.
        effects: coefficients by effect@place; for an unmodelled cause, its own numbers.
        equivalents: function from an effect to all that are equivalent to it in any data.
    """

    kind: str
    effects: Mapping[str, tuple[float, ...]]
    equivalents: Callable[[str], frozenset[str]] = lambda name: frozenset({name})


@dataclass(frozen=True)
class Mark:
    """Grade of an answer.

    Attributes:
        outcome: see this module.
        causes: named causes; alternatives are joined by "|", several causes by " + ".
        members: causes in the largest set that holds the hidden cause; 0 if there is none.
        classes: the same, with equivalent causes counted as one.
        covered: by coefficient, whether the 95 % interval contains the true value; None for an open
            interval.
        ratios: by other member of the set that holds the hidden cause, its error divided by
            that of the hidden cause, or sigmas of evidence against it; None if not comparable.
        strict: whether the causes are named alone.
        few: whether they are named alone or in a set of at most `Standard.max_set`.
        equivalent: the same, with equivalent causes counted as one.
        fair: whether they are named alone or in a set whose other members do as well.
        any: whether they are named alone or in any set.
        note: errors of the answer in words.
    """

    outcome: str
    causes: str = ""
    members: int = 0
    classes: int = 0
    covered: dict[str, bool | None] = field(default_factory=dict)
    ratios: dict[str, float | None] = field(default_factory=dict)
    strict: bool = False
    few: bool = False
    equivalent: bool = False
    fair: bool = False
    any: bool = False
    note: str = ""

    def to_json(self):
        return asdict(self)


def mark_answer(hidden_cause, verdict, standard, compare=None, covered=None):
    """Grade one answer.

    Args:
        hidden_cause: the hidden cause.
        verdict: document of verdict.json; None if there is no answer.
        standard: what counts as good.
        compare: function from the named sets to `Mark.ratios`; it is called only for sets.
        covered: `Mark.covered`, if it is known already.
    """
    if verdict is None:
        return Mark("failed")
    sets = list_named_sets(verdict)
    outcome, members, classes = _outcome(hidden_cause, verdict, sets)
    if covered is None and outcome in ("right", "set", "extra"):
        covered = covered_intervals(hidden_cause.effects, verdict)
    is_number_right = True
    if standard.number_counts and hidden_cause.effects and outcome in ("right", "set"):
        is_number_right = _is_number_right(hidden_cause, verdict)
    if standard.number_counts and outcome in ("right", "set") and verdict["verdict"] == "partial":
        outcome = "partial"
    elif outcome == "right" and not is_number_right:
        outcome = "number"
    few = outcome == "right" or (outcome == "set" and members <= standard.max_set)
    equivalent = few or (outcome in ("set", "class") and classes <= standard.max_set)
    ratios = {}
    largest = standard.largest_fair_set or members
    if compare and outcome == "set" and members <= largest:
        ratios = {} if standard.small_sets_are_fair and few else compare(sets)
    is_equal = bool(ratios) and all(
        ratio is not None and ratio <= standard.equal_below for ratio in ratios.values()
    )
    if standard.largest_fair_set:
        is_equal = is_equal and len(ratios) == members - 1
    fair = outcome == "right" or (outcome == "set" and is_equal and is_number_right is not False)
    return Mark(
        outcome, " + ".join("|".join(names) for names in sets), members, classes, covered or {},
        ratios, outcome == "right", few, equivalent,
        fair or (standard.small_sets_are_fair and equivalent), outcome in ("right", "set"),
    )  # fmt: skip


def _outcome(hidden_cause, verdict, sets):
    """Return (outcome, members, classes) of the answer to a case of any kind."""
    effects = list(hidden_cause.effects)
    if hidden_cause.kind == "family":
        effects = [f"{effects[0].partition('@')[0]}@*"]
    if hidden_cause.kind == "numerics":
        return _numerics_outcome(verdict, sets)
    outcome, members, classes = grade_sets(
        hidden_cause.kind, effects, verdict, hidden_cause.equivalents
    )
    if outcome != "wrong" or hidden_cause.kind == "foreign":
        return outcome, members, classes
    if hidden_cause.kind == "family" and {names[0] for names in sets} <= set(hidden_cause.effects):
        return "member", 0, 0
    return _nearness(effects, sets), 0, 0


def _numerics_outcome(verdict, sets):
    """Grade the answer to too coarse numerics; only causes named first count."""
    hits = [names[0] for names in sets if names[0].startswith("numerics.")]
    alone = {**verdict, "causes": [{**c, "alternatives": []} for c in verdict["causes"]]}
    outcome, *_ = grade_sets("single", hits[:1] or ["numerics"], alone, lambda name: {name})
    return ("right" if hits and len(hits) == len(sets) else outcome), int(bool(hits)), 0


def _nearness(effects, sets):
    """Return the outcome for an effect at another place, or another effect at the place."""
    named = [name.partition("@") for names in sets for name in names]
    hidden = [name.partition("@") for name in effects]
    if any(n[0] == h[0] for n in named for h in hidden):
        return "place"
    joints = {joint_of(h[2]) for h in hidden if h[2]}
    return "effect" if any(joint_of(n[2]) in joints for n in named if n[2]) else "wrong"


def joint_of(place):
    """Return the joint to which a place belongs, as far as its name shows."""
    for prefix in ("m_", "q.", "qd.", "tau."):
        place = place.removeprefix(prefix)
    return place.removesuffix("_link")


def covered_intervals(effects, verdict):
    """Return whether the intervals of the causes named first hold the hidden coefficients."""
    covered = {}
    for cause in verdict["causes"]:
        effect, _, place = cause["effect"].partition("@")
        if cause["effect"] in effects:
            pairs = zip(cause["coefficients"].items(), effects[cause["effect"]], strict=False)
        else:
            values = {
                key: effects.get(f"{effect}@{key.partition('@')[2]}", (None,))[0]
                for key in (cause["coefficients"] if place == "*" else ())
            }
            pairs = [((k, cause["coefficients"][k]), v) for k, v in values.items() if v is not None]
        for (key, estimate), value in pairs:
            covered[f"{cause['effect']} {key}"] = contains_value(estimate, value)
    return covered


def _is_number_right(hidden_cause, verdict):
    """Return whether the first coefficient is within 5 % or in its interval; None without one."""
    ((effect, coefficients),) = hidden_cause.effects.items()
    estimates = [c["coefficients"] for c in verdict["causes"] if c["effect"] == effect]
    if not estimates:
        return None
    estimate = next(iter(estimates[0].values()))
    is_near = abs(estimate["value"] - coefficients[0]) <= 0.05 * abs(coefficients[0])
    return bool(is_near or contains_value(estimate, coefficients[0]))
