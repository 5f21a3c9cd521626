"""One question: a recipe for a recording in which a cause is hidden, and its truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from bench.diagnosis.worlds.settings import ANY, Circumstances

KINDS = ("clean", "single", "double", "foreign")
"""Nothing is hidden, an effect, two, or a cause that the library does not have."""


@dataclass(frozen=True)
class Item:
    """One question.

    Attributes:
        name: says kind, system, what was asked for, and seed.
        system, kind: see `bench.diagnosis.worlds.questions.SYSTEMS`, and `KINDS`.
        effects: coefficients of what is hidden, by name; of a foreign cause its own numbers.
        size: RMS of the gap that base parameters and initial states, refitted, leave in the runs
            for fitting, in units of the noise; of two effects that of each by itself.
        noise: white, ar1 or quantised.
        stated: whether the recording states the noise.
        rate, seconds, runs: sampling in Hz, a run's length, how many.
        source: who made it: scipy, mujoco, or own equations.
        driven: whether there is an input.
        channels: what is recorded.
        seed: what it was drawn from.
        parameters: the base parameters.
        beyond: what is left of the gap, in units of the noise, with the best other answer: of a
            foreign cause the best effect of the library, of two effects one of them, of an effect
            that has a simpler form that.
        asked: circumstances that were asked for.
    """

    name: str
    system: str
    kind: str
    effects: dict[str, tuple[float, ...]]
    size: float
    noise: str
    stated: bool
    rate: int
    seconds: float
    runs: int
    source: str
    driven: bool
    channels: tuple[str, ...]
    seed: int
    parameters: dict[str, float] = field(default_factory=dict)
    beyond: float | None = None
    asked: Circumstances = ANY

    def json(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Item:
        """An item from its JSON."""
        effects = {name: tuple(c) for name, c in document["effects"].items()}
        given = {**document, "effects": effects, "channels": tuple(document["channels"])}
        return cls(**{**given, "asked": Circumstances(*document.get("asked", ()))})
