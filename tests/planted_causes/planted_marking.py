"""Marks an answer of ``simgap explain`` on an item.

| outcome | when |
|---|---|
| right | the planted cause is named alone, and its number is right |
| number | the planted cause is named alone with a wrong number |
| set | the planted cause is in a set that is said to explain the data equally well |
| partial | the planted cause is the only one, but the verdict is `partial` |
| extra | the planted cause is named, and another cause in addition |
| place | the effect is named at another place |
| wrong | something else is named |
| unnamed | a gap is seen, and no cause is named |
| missed | the verdict is `adequate` |
| none | there is no answer: an error, or the limit of processor time |
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

MAX_SET = 4  # causes in a set that still tells something
EQUAL_RATIO = 1.05  # held-out errors whose ratio is at most this are equal
TOLERANCE = 0.05  # relative error of a right number


@dataclass(frozen=True)
class Mark:
    """What an answer is worth.

    Attributes:
        outcome: see this module.
        causes: of the answer, alternatives joined by "|".
        number: coefficient of the planted cause; None where the answer states none.
        is_number_right: whether it is within 5 % or its 95 % interval holds the truth; None
            where there is no number.
        members: causes of the set that holds the planted cause.
        ratios: of a set, by other member: its held-out error, refitted with plain MuJoCo, as a
            multiple of the error of the planted cause; None where plain MuJoCo cannot express it.
    """

    outcome: str
    causes: tuple[str, ...] = ()
    number: float | None = None
    is_number_right: bool | None = None
    members: int = 0
    ratios: dict[str, float | None] = field(default_factory=dict)

    @property
    def strict(self):
        """Named alone with the right number."""
        return self.outcome == "right"

    @property
    def fair(self):
        """Named alone, or in a set of at most `MAX_SET` whose other members are as good."""
        if self.strict:
            return True
        equal = all(ratio is not None and ratio <= EQUAL_RATIO for ratio in self.ratios.values())
        return (
            self.outcome == "set"
            and self.members <= MAX_SET
            and len(self.ratios) == self.members - 1
            and equal
            and self.is_number_right is not False
        )

    def json(self):
        return asdict(self) | {"strict": self.strict, "fair": self.fair}


def mark(effect, size, verdict, held_out_ratios=None):
    """Mark one answer.

    Args:
        effect: planted, as effect@place.
        size: planted coefficient in the effect's definition.
        verdict: document of verdict.json; None for no answer.
        held_out_ratios: called with the other members of a set, returns `Mark.ratios`.
    """
    if verdict is None:
        return Mark("none")
    sets = [(cause["effect"], *cause["alternatives"]) for cause in verdict["causes"]]
    causes = tuple("|".join(names) for names in sets)
    name = verdict["verdict"]
    if name == "adequate":
        return Mark("missed", causes)
    if name in ("unknown", "unidentifiable") or not sets:
        return Mark("unnamed", causes)
    index = next((i for i, names in enumerate(sets) if effect in names), None)
    if index is None:
        kind = effect.partition("@")[0]
        same = any(other.partition("@")[0] == kind for names in sets for other in names)
        return Mark("place" if same else "wrong", causes)
    number, is_right = _number(verdict["causes"][index], effect, size)
    members = len(set(sets[index]))
    ratios = {}
    if len(sets) > 1:
        outcome = "extra"
    elif name == "partial":
        outcome = "partial"
    elif members > 1:
        outcome = "set"
        if held_out_ratios is not None and members <= MAX_SET:
            ratios = held_out_ratios([other for other in sets[index] if other != effect])
    else:
        outcome = "right" if is_right else "number"
    return Mark(outcome, causes, number, is_right, members, ratios)


def _number(cause, effect, size):
    """(coefficient of the planted cause, whether it is right), None where none is stated."""
    if cause["effect"] != effect:
        return None, None
    estimate = next(iter(cause["coefficients"].values()))
    value, low, high = estimate["value"], estimate["low"], estimate["high"]
    is_near = abs(value - size) <= TOLERANCE * abs(size)
    is_inside = low is not None and high is not None and low <= size <= high
    return value, bool(is_near or is_inside)
