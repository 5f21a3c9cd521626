"""Grade a diagnosis of a robot recording by effect and place.

| outcome | kinds | condition |
|---|---|---|
| right | clean, foreign | clean: adequate; foreign: unknown or partial |
| right | all others | exactly the true causes, each alone; numerics: the step or the integrator |
| set | single, family, double | a true cause is in a set of equivalent causes |
| member | family | causes of the family are named place by place |
| place | single, double | the effect is named at another place |
| effect | single, double | another effect is named at the place |
| one | double | one of the two causes is found, the other is not |
| extra | single, family, numerics | the cause is named, and another one in addition |
| wrong | all but clean | another cause is named |
| unnamed | all but clean, foreign | a discrepancy is detected, no cause is named |
| missed | all but clean | no discrepancy is detected |
| alarm | clean | a discrepancy is detected |
| undecided | all | the verdict is unidentifiable |
| failed | all | there is no answer because of a crash or a timeout |
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

FEW = 4  # Maximum size of a set that is still informative.
SAME = 1.05  # Held-out errors are equal if their ratio is below this value.


@dataclass(frozen=True)
class Mark:
    """Grade of an answer.

    Attributes:
        outcome: see the table of this module.
        members: causes in the largest set that holds the truth; 0 if there is none.
        named: diagnosed causes; alternatives are joined by "|", several causes by " + ".
        covered: by coefficient, whether the 95 % interval holds the truth; None for an open
            interval.
        equal: by other member of the set that holds the truth, its held-out error, refitted in the
            reference world, divided by the error of the truth; None if it was not measured.
    """

    outcome: str
    members: int = 0
    named: str = ""
    covered: dict[str, bool | None] = field(default_factory=dict)
    equal: dict[str, float | None] = field(default_factory=dict)

    @property
    def strict(self):
        """True if the causes are named alone."""
        return self.outcome == "right"

    @property
    def few(self):
        """True if the causes are named alone, or in a set of at most `FEW`."""
        return self.strict or (self.outcome == "set" and self.members <= FEW)

    @property
    def any(self):
        """True if the causes are named alone, or in any set."""
        return self.outcome in ("right", "set")

    @property
    def fair(self):
        """True if the causes are named alone, or all other members have an equal held-out error."""
        ratios = self.equal.values()
        alike = bool(ratios) and all(ratio is not None and ratio < SAME for ratio in ratios)
        return self.strict or (self.outcome == "set" and alike)

    def json(self):
        kinds = {name: getattr(self, name) for name in ("strict", "few", "any", "fair")}
        return asdict(self) | kinds


def marked(item, verdict):
    """Grade one answer; a verdict of None means no answer."""
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
    """Return every cause with its alternatives."""
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
    """Return the outcome if no cause is named."""
    outcome = None
    if verdict == "adequate":
        outcome = "missed"
    # With the verdict "unknown", listed causes are not answers.
    elif not sets or verdict == "unknown":
        outcome = "unnamed"
    return (outcome, 0) if outcome and both else outcome


def _found(truth, sets):
    """Assign each true cause to its own set, and return (outcome, members)."""
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
    """Return the outcome for an effect at another place, or another effect at the place."""
    named = [name.partition("@") for names in sets for name in names]
    wanted = [name.partition("@") for name in truth]
    if any(n[0] == w[0] for n in named for w in wanted):
        return "place"
    joints = {joint_of(w[2]) for w in wanted if w[2]}
    return "effect" if any(joint_of(n[2]) in joints for n in named if n[2]) else "wrong"


def joint_of(place):
    """Return the joint to which a place belongs, as far as its name shows."""
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
    """Return whether the intervals of the causes named first hold the hidden coefficients."""
    covered = {}
    for cause in verdict["causes"]:
        for key, said, value in _pairs(item, cause):
            low, high = said["low"], said["high"]
            held = None if low is None or high is None else bool(low <= value <= high)
            covered[f"{cause['effect']} {key}"] = held
    return covered


def _pairs(item, cause):
    """Yield (name, estimate, truth) of every coefficient of a cause that was hidden."""
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
