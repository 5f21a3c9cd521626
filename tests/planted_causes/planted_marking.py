"""Grade an answer of ``simgap explain`` on a case.

| outcome | condition |
|---|---|
| right | the planted cause is named alone, and its number is right |
| number | the planted cause is named alone with a wrong number |
| set | the planted cause is in a set of causes reported as equivalent |
| partial | the planted cause is the only one, but the verdict is `partial` |
| extra | the planted cause is named, and another cause in addition |
| place | the effect is named at another place |
| wrong | another cause is named |
| unnamed | a discrepancy is detected, and no cause is named |
| missed | the verdict is `adequate` |
| none | there is no answer: an error, or the limit of processor time |
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

MAX_SET = 4  # Maximum size of a set that is still informative.
EQUAL_RATIO = 1.05  # Held-out errors are equal if their ratio is at most this value.
TOLERANCE = 0.05  # Relative error of a right number.


@dataclass(frozen=True)
class Mark:
    """Grade of an answer.

    Attributes:
        outcome: see the table of this module.
        causes: causes of the answer, alternatives joined by "|".
        number: coefficient of the planted cause; None if the answer contains none.
        is_number_right: whether it is within 5 % or its 95 % interval holds the truth; None if
            there is no number.
        members: count of causes in the set that holds the planted cause.
        ratios: by other member of a set, its held-out error, refitted with plain MuJoCo, divided by
            the error of the planted cause; None if plain MuJoCo cannot express it.
    """

    outcome: str
    causes: tuple[str, ...] = ()
    number: float | None = None
    is_number_right: bool | None = None
    members: int = 0
    ratios: dict[str, float | None] = field(default_factory=dict)

    @property
    def strict(self):
        """True if the cause is named alone with the right number."""
        return self.outcome == "right"

    @property
    def fair(self):
        """True if the cause is named alone, or in a set of at most `MAX_SET` equal members."""
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
    """Grade one answer.

    Args:
        effect: planted cause as effect@place.
        size: planted coefficient in the effect's definition.
        verdict: document of verdict.json; None if there is no answer.
        held_out_ratios: function from the other members of a set to `Mark.ratios`.
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
    """Return (coefficient of the planted cause, whether it is right), or (None, None)."""
    if cause["effect"] != effect:
        return None, None
    estimate = next(iter(cause["coefficients"].values()))
    value, low, high = estimate["value"], estimate["low"], estimate["high"]
    is_near = abs(value - size) <= TOLERANCE * abs(size)
    is_inside = low is not None and high is not None and low <= size <= high
    return value, bool(is_near or is_inside)
