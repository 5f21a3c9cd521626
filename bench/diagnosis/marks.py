"""Marks an answer: what `explain` concluded (DESIGN §6, as a dictionary) against what was hidden.

| outcome | of | when |
|---|---|---|
| right | all | clean: adequate; single, double: all causes, no other; foreign: unknown or partial |
| set | single, double | the cause stands in a set that the data are said not to tell apart |
| class | single, double | an effect is named that is equivalent in any data (`items.EQUIVALENT`) |
| one | double | one of the two is named (alone or in a set), the other is not |
| wrong | single, double, foreign | something else is named; foreign: anything is, as all there is |
| extra | single | the cause is named, and another beside it |
| unnamed | single, double | a gap is seen, no cause named |
| missed | single, double, foreign | nothing is seen |
| alarm | clean | something is seen |
| undecided | all | said to be unidentifiable |
| failed | all | there is no answer: it crashed or took too long |
| skipped | all | it cannot be asked about such simulators; counts nowhere |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.diagnosis.worlds.item import Item
from bench.diagnosis.worlds.questions import coefficients_of, same_class

Sets = list[tuple[str, ...]]
Judged = tuple[str, int, int]
Holds = Callable[[str, tuple[str, ...]], bool]
MOST = 2  # a cause counts as found within a set of at most so many


@dataclass(frozen=True)
class Mark:
    """What an answer is worth.

    Attributes:
        outcome: see this module.
        set_size: effects in the set that holds the truth (the larger of two); 0 where none does.
        class_size: the same, with effects that are equivalent in any data counted as one.
        named: what was named, alternatives behind a bar: ``drag.linear|wind + force.bias``.
        covered: by coefficient or parameter of what was answered rightly: whether the 95 % interval
            holds the truth; None where the interval is open.
    """

    outcome: str
    set_size: int
    class_size: int
    named: str
    covered: dict[str, bool | None]

    @property
    def found(self) -> bool:
        """Whether it counts, by names."""
        return self.outcome == "right" or (self.outcome == "set" and self.set_size <= MOST)

    @property
    def found_class(self) -> bool:
        """Whether it counts, equivalent effects being one."""
        return self.outcome == "right" or (
            self.outcome in ("set", "class") and self.class_size <= MOST
        )


def marked(item: Item, verdict: Mapping[str, Any] | None) -> Mark:
    """Mark one answer; a verdict of None is no answer."""
    if verdict is None:
        return Mark("failed", 0, 0, "", {})
    sets = [(cause["effect"], *cause["alternatives"]) for cause in verdict["causes"]]
    outcome, strict, loose = OUTCOMES[item.kind](item, verdict["verdict"], sets)
    if verdict["verdict"] == "unidentifiable":
        outcome = "undecided"
    covered = (
        _covered(item, verdict, sets)
        if outcome in ("right", "set") and item.kind != "foreign"
        else {}
    )
    return Mark(outcome, strict, loose, " + ".join("|".join(names) for names in sets), covered)


def _clean(item: Item, verdict: str, sets: Sets) -> Judged:
    return "right" if verdict == "adequate" else "alarm", 0, 0


def _foreign(item: Item, verdict: str, sets: Sets) -> Judged:
    if verdict == "adequate":
        return "missed", 0, 0
    return "right" if verdict in ("unknown", "partial") else "wrong", 0, 0


def _library(item: Item, verdict: str, sets: Sets) -> Judged:
    """One or two effects of the library: every one in a set of its own, and no set without one."""
    if verdict == "adequate":
        return "missed", 0, 0
    if not sets or verdict == "unknown":  # what it lists then are no answers
        return "unnamed", 0, 0
    strict = _matched(item.effects, sets, lambda effect, names: effect in names)
    loose = _matched(
        item.effects, sets, lambda effect, names: bool(_same(item, effect) & set(names))
    )
    if len(loose) < len(item.effects):
        return "one" if loose else "wrong", 0, 0
    sizes = max(len(sets[place]) for place in loose.values())
    classes = max(_classes(item, sets[place]) for place in loose.values())
    if len(sets) > len(item.effects):
        return "extra", sizes, classes
    if len(strict) < len(item.effects):
        return "class", 0, classes  # only something equivalent is named
    sizes = max(len(sets[place]) for place in strict.values())
    return "right" if sizes == 1 else "set", sizes, classes


def _matched(effects: Iterable[str], sets: Sets, holds: Holds) -> dict[str, int]:
    """Which set holds which effect, no set two: the fullest of the assignments, of two effects at
    most.
    """
    best: dict[str, int] = {}
    for order in (list(effects), list(effects)[::-1]):
        for reverse in (False, True):
            found: dict[str, int] = {}
            for effect in order:
                places = [
                    i
                    for i, names in enumerate(sets)
                    if holds(effect, names) and i not in found.values()
                ]
                if places:
                    found[effect] = places[-1 if reverse else 0]
            best = max(best, found, key=len)
    return best


def _same(item: Item, effect: str) -> frozenset[str]:
    return same_class(item, effect)


def _classes(item: Item, names: Sequence[str]) -> int:
    """Names of a set, equivalent ones as one; a robot's family adds nothing to one of its places
    that stands beside it.
    """
    placed = {name.partition("@")[0] for name in names if not name.endswith("@*")}
    counted = [n for n in names if not n.endswith("@*") or n.partition("@")[0] not in placed]
    return len({min(_same(item, name)) for name in counted})


OUTCOMES = {"clean": _clean, "foreign": _foreign, "single": _library, "double": _library}


def _covered(item: Item, verdict: Mapping[str, Any], sets: Sets) -> dict[str, bool | None]:
    """Intervals of base parameters and of the coefficients of what leads its set."""
    truth, said = dict(item.parameters), dict(verdict["parameters"])
    led = {names[0] for names in sets}
    for cause in verdict["causes"]:
        if cause["effect"] in item.effects:
            names = coefficients_of(item.system, cause["effect"])
            for name, value in zip(names, item.effects[cause["effect"]], strict=False):
                truth[f"{cause['effect']}.{name}"] = value
                said[f"{cause['effect']}.{name}"] = cause["coefficients"].get(name)
    if not set(item.effects) <= led:
        return {}  # the parameters that go with something else are others
    return {name: _holds(said[name], value) for name, value in truth.items() if said.get(name)}


def _holds(estimate: Mapping[str, float | None], value: float) -> bool | None:
    low, high = estimate["low"], estimate["high"]
    if low is None or high is None:
        return None
    return bool(low <= value <= high)
