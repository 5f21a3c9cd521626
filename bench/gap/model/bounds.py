"""The range of each coefficient of an effect: where one expects it, and where a fit may move it.

Times and frequencies follow the time scale of the recording (`bench.gap.model.time_scale`).
"""

from __future__ import annotations

from typing import Literal

from bench.gap.model.time_scale import is_instant
from bench.gap.model.world import World
from sims.base import Parameter
from sims.system import Effect, Friction

BEYOND = 20.0
"""A coefficient may be so many times as large as its plausible range has it."""
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

Bound = Literal["low", "high"]
"""Which end of its range a number lies at."""


def coefficient_bounds(world: World, name: str) -> list[tuple[float, float]]:
    """The range in which a fit may move each coefficient of an effect.

    A plausible range orders causes; it does not overrule the data: what may have either sign may be
    twenty times larger. What is zero or positive by its meaning stays so, and what shapes an effect
    stays in its range.
    """
    effect = world.effects[name]
    most = [c.most for c in effect.coefficients]
    return [
        _bounds(coefficient, effect, world, limit)
        for coefficient, limit in zip(world.parameters[world.slots[name]], most, strict=False)
    ]


def bound_of(value: float, low: float, high: float) -> Bound | None:
    """Which end of its range a fitted number lies at; None if it lies inside."""
    near = AT_BOUND * (high - low)
    if value <= low + near * (low != 0.0):
        return "low"
    return "high" if value >= high - near * (high != 0.0) else None


def _bounds(
    coefficient: Parameter, effect: Effect, world: World, most: float | None
) -> tuple[float, float]:
    """Of one coefficient."""
    low, high = coefficient.bounds
    longest = world.longest
    if is_instant(coefficient):
        return world.clock
    if coefficient.unit == "Hz":
        # no higher than half of the range, so that there is one left
        low = min(max(low, CYCLES / longest), high / 2.0)
    # a shape: how often, how fast, how sharp
    if low > 0:
        return low, high
    if coefficient.unit == "s":
        # what takes longer than a run is a constant in it
        return max(BEYOND * low, -longest), min(BEYOND * high, longest)
    # a part that grows with the square of a force sticks nowhere by itself
    dry = isinstance(effect, Friction) and not coefficient.unit.startswith(PER_FORCE)
    beyond = DRY if dry else BEYOND
    # a size whose sign is part of what the effect is
    if low == 0:
        return 0.0, most or beyond * high
    return beyond * low, beyond * high
