"""Marks an answer about a robot: what `explain` concluded against what was hidden, effect and
place.

| outcome | of | when |
|---|---|---|
| right | clean, foreign | clean: adequate; foreign: unknown or partial |
| right | all others | each cause by itself and no other; of numerics the step or the integrator |
| set | single, family, double | a cause stands in a set, said to be alike in these data |
| member | family | causes of the family are named, place by place |
| place | single, double | the effect is named, at another place |
| effect | single, double | another effect is named, at the place |
| one | double | one of the two is found, the other is not |
| extra | single, family, numerics | the cause is named, and another beside it |
| wrong | all but clean | something else is named |
| unnamed | all but clean, foreign | a gap is seen, no cause named |
| missed | all but clean | nothing is seen |
| alarm | clean | something is seen |
| undecided | all | said to be unidentifiable |
| failed | all | there is no answer: it crashed or took too long |
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

FEW = 4  # members of a set that still tells something
SAME = 1.05  # held-out errors whose ratio is below this are equal


@dataclass(frozen=True)
class Mark:
    """What an answer is worth.

    Attributes:
        outcome: see this module.
        members: causes in the set that holds the truth (the largest of them); 0 where none does.
        named: what was named, alternatives behind a bar, several causes with a plus.
        covered: by coefficient: whether the 95 % interval holds the truth; None where it is open.
        equal: by member of the set that holds the truth, without the truth: how its held-out
            error, refitted in the world that made the data, compares with the truth's; None where
            that was not measured.
    """

    outcome: str
    members: int = 0
    named: str = ""
    covered: dict[str, bool | None] = field(default_factory=dict)
    equal: dict[str, float | None] = field(default_factory=dict)

    @property
    def strict(self):
        """Named alone."""
        return self.outcome == "right"

    @property
    def few(self):
        """Named, or in a set of at most `FEW`."""
        return self.strict or (self.outcome == "set" and self.members <= FEW)

    @property
    def any(self):
        """Named, or in any set."""
        return self.outcome in ("right", "set")

    @property
    def fair(self):
        """Named, or in a set of which all other members do as well on runs held out."""
        ratios = self.equal.values()
        alike = bool(ratios) and all(ratio is not None and ratio < SAME for ratio in ratios)
        return self.strict or (self.outcome == "set" and alike)

    def json(self):
        kinds = {name: getattr(self, name) for name in ("strict", "few", "any", "fair")}
        return asdict(self) | kinds


def marked(item, verdict):
    """Mark one answer; a verdict of None is no answer."""
    if verdict is None:
        return Mark("failed")
    sets = sets_of(verdict)
    outcome, members = OUTCOMES[item.kind](item, verdict["verdict"], sets)
    if verdict["verdict"] == "unidentifiable":
        outcome = "undecided"
    named = " + ".join("|".join(names) for names in sets)
    covered = _covered(item, verdict) if outcome in ("right", "set", "extra") else {}
    return Mark(outcome, members, named, covered)


def sets_of(verdict):
    """Every cause with its alternatives."""
    return [(cause["effect"], *cause["alternatives"]) for cause in verdict["causes"]]


def _clean(item, verdict, sets):
    return ("right" if verdict == "adequate" else "alarm"), 0


def _foreign(item, verdict, sets):
    if verdict == "adequate":
        return "missed", 0
    return ("right" if verdict in ("unknown", "partial") else "wrong"), 0


def _numerics(item, verdict, sets):
    names = [name for names in sets for name in names[:1]]
    hits = [name for name in names if name.startswith("numerics.")]
    if not hits:
        return _nothing(verdict, sets) or "wrong", 0
    return ("right" if len(hits) == len(names) else "extra"), 1


def _single(item, verdict, sets):
    return _nothing(verdict, sets, True) or _found(list(item.effects), sets)


def _family(item, verdict, sets):
    (effect,) = {name.partition("@")[0] for name in item.effects}
    outcome = _nothing(verdict, sets, True)
    if outcome:
        return outcome
    found = _found([f"{effect}@*"], sets)
    members = [names[0] for names in sets]
    if found[0] in ("wrong", "effect", "place") and set(members) <= set(item.effects):
        return "member", 0
    return found


def _nothing(verdict, sets, both=False):
    """The outcome where nothing is named."""
    outcome = None
    if verdict == "adequate":
        outcome = "missed"
    elif not sets or verdict == "unknown":  # what it lists then are no answers
        outcome = "unnamed"
    return (outcome, 0) if outcome and both else outcome


def _found(truth, sets):
    """Causes in sets of their own, and no set without one: (outcome, members)."""
    places = {}
    for name in truth:
        free = [i for i, names in enumerate(sets) if name in names and i not in places.values()]
        if free:
            places[name] = min(free, key=lambda i: len(sets[i]))
    if not places:
        return _near(truth, sets), 0
    members = max(len(sets[i]) for i in places.values())
    if len(places) < len(truth):
        return "one", members
    if len(sets) > len(truth):
        return "extra", members
    return ("right" if members == 1 else "set"), members


def _near(truth, sets):
    """Whether the effect is named elsewhere, or another effect there."""
    named = [name.partition("@") for names in sets for name in names]
    wanted = [name.partition("@") for name in truth]
    if any(n[0] == w[0] for n in named for w in wanted):
        return "place"
    joints = {joint_of(w[2]) for w in wanted if w[2]}
    return "effect" if any(joint_of(n[2]) in joints for n in named if n[2]) else "wrong"


def joint_of(place):
    """The joint that a place of the questions belongs to, as far as its name tells."""
    for prefix in ("m_", "q.", "qd.", "tau."):
        place = place.removeprefix(prefix)
    return place.removesuffix("_link")


OUTCOMES = {
    "clean": _clean,
    "foreign": _foreign,
    "numerics": _numerics,
    "single": _single,
    "double": _single,
    "family": _family,
}


def _covered(item, verdict):
    """Whether intervals of what is named first hold what was hidden."""
    covered = {}
    for cause in verdict["causes"]:
        for key, said, value in _pairs(item, cause):
            low, high = said["low"], said["high"]
            held = None if low is None or high is None else bool(low <= value <= high)
            covered[f"{cause['effect']} {key}"] = held
    return covered


def _pairs(item, cause):
    """(name, estimate, truth) of every coefficient of a cause that was hidden."""
    effect, _, place = cause["effect"].partition("@")
    if cause["effect"] in item.effects:
        truth = item.effects[cause["effect"]]
        for (key, said), value in zip(cause["coefficients"].items(), truth, strict=False):
            yield key, said, value
    elif place == "*":
        for key, said in cause["coefficients"].items():
            name = f"{effect}@{key.partition('@')[2]}"
            if name in item.effects:
                yield key, said, item.effects[name][0]
