"""The range of each coefficient of an effect: where one expects it, and where a fit may move it.

Times and frequencies follow the time scale of the recording (`bench.gap.model.time_scale`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from bench.gap.model.time_scale import is_instant
from bench.gap.model.world import World
from sims.base import Array, Parameter
from sims.system import Coefficient, Effect, Friction

BEYOND = 20.0
"""A coefficient of a system in equations may be this many times as large as its plausible range."""
BEYOND_MODEL = 1000.0
"""The same of a number that a robot's model file states. Its total has physical limits (`least` and
`most` of the coefficient), and its plausible range is a guess from the robot's weight: damping of
60 N m s on a link of 1 N m is unusual, and possible.
"""
DRY = 4.0
"""The same for dry friction: what is stronger only sticks, and sticking divides the engine's steps.
"""
PER_FORCE = ("1/N", "1/(N")
"""Units of what grows faster than a force."""
CYCLES = 1.0
"""What comes and goes must do so about once in the longest run, else any slow change would be
called periodic.
"""
AT_BOUND = 1e-6
"""A fitted number is at a bound if it is nearer to it than this share of its range. A bound of zero
is met exactly or not at all, since ranges are wide against small coefficients.
"""
NEAR = 1e-3
"""It is also nearer to the bound than this share of the bound itself."""

Bound = Literal["low", "high"]
"""Which end of its range a number lies at."""


def coefficient_bounds(world: World, name: str) -> list[tuple[float, float]]:
    """The range in which a fit may move each coefficient of an effect.

    A plausible range orders causes and is reported where a value exceeds it; it does not overrule
    the data. A fit ends at what is physically possible (`Coefficient.least` and `most`: no total of
    friction, damping, inertia or mass is negative), or far beyond the plausible range. What is zero
    or positive by its meaning stays so, and what shapes an effect stays in its range.
    """
    effect = world.effects[name]
    pairs = zip(world.parameters[world.slots[name]], effect.coefficients, strict=False)
    return [
        _within(_bounds(parameter, coefficient, effect, world), coefficient)
        for parameter, coefficient in pairs
    ]


def clip_coefficients(world: World, name: str, c: Array) -> Array:
    """Limit the coefficients (k,) of an effect to the range in which a fit may move them."""
    limited: Array = np.clip(c, *np.array(coefficient_bounds(world, name)).T)
    return limited


def is_unusual(value: float, low: float, high: float) -> bool:
    """Whether a fitted number lies outside its plausible range, by more than rounding."""
    near = AT_BOUND * (high - low)
    return not low - near <= value <= high + near


def bound_of(value: float, low: float, high: float) -> Bound | None:
    """Which end of its range a fitted number lies at; None if it lies inside."""
    near = AT_BOUND * (high - low)
    # A range may be a thousand times as wide as a bound is far from zero.
    if value <= low + min(near, NEAR * abs(low)):
        return "low"
    return "high" if value >= high - min(near, NEAR * abs(high)) else None


def _within(bounds: tuple[float, float], coefficient: Coefficient) -> tuple[float, float]:
    """A range cut to what is physically possible."""
    low, high = bounds
    if coefficient.least is not None:
        low = max(low, coefficient.least)
    if coefficient.most is not None:
        high = min(high, coefficient.most)
    return low, high


def _bounds(
    parameter: Parameter, coefficient: Coefficient, effect: Effect, world: World
) -> tuple[float, float]:
    """The range of one coefficient without its physical limits."""
    low, high = parameter.bounds
    longest = world.longest
    if is_instant(parameter):
        return world.clock
    if parameter.unit == "Hz":
        # no higher than half of the range, so that there is one left
        low = min(max(low, CYCLES / longest), high / 2.0)
    # a shape: how often, how fast, how sharp
    if low > 0:
        return low, high
    if parameter.unit == "s":
        # what takes longer than a run is a constant in it
        return max(BEYOND * low, -longest), min(BEYOND * high, longest)
    # a part that grows with the square of a force sticks nowhere by itself
    dry = isinstance(effect, Friction) and not parameter.unit.startswith(PER_FORCE)
    beyond = DRY if dry else BEYOND
    # of a robot these limits are of what its file states
    if world.kind.has_model and coefficient.least is not None:
        beyond = BEYOND_MODEL
    # a size whose sign is part of what the effect is has a low end of zero
    return beyond * low, beyond * high
