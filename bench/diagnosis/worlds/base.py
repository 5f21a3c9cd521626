"""What there really is in a question."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

Effects = Mapping[str, Sequence[float]]
"""Coefficients by name."""


@dataclass(frozen=True)
class World:
    """What there really is.

    Attributes:
        system: its name.
        parameters, constants: numbers by name.
        effects: coefficients of effects of the library, in the order in which a signal passes them.
        foreign: numbers of causes that the library does not have.
    """

    system: str
    parameters: Mapping[str, float]
    constants: Mapping[str, float]
    effects: Effects = field(default_factory=dict)
    foreign: Effects = field(default_factory=dict)
