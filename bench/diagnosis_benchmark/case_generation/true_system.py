"""True system of a case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

EffectCoefficients = Mapping[str, Sequence[float]]
"""Coefficients of effects, by the name of the effect."""


@dataclass(frozen=True)
class TrueSystem:
    """True system of a case, with hidden causes.

    Attributes:
        system: name of the system.
        parameters: values of the base parameters, by name.
        constants: values of the constants, by name.
        effects: coefficients of effects of the library, in the order in which a signal passes them.
        foreign: numbers of causes that the library does not contain.
    """

    system: str
    parameters: Mapping[str, float]
    constants: Mapping[str, float]
    effects: EffectCoefficients = field(default_factory=dict)
    foreign: EffectCoefficients = field(default_factory=dict)
