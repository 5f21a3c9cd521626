"""The range in which fits may move the coefficients of effects."""

from __future__ import annotations

from bench.gap.model.world import World
from sims.simulated import effect_parameters
from sims.system import Friction

BEYOND, DRY = 20.0, 4.0
"""The second for dry friction: what is stronger only sticks."""
CYCLES = 1.0
"""What comes and goes must do so about once in the longest run, else any slow change would be
called periodic.
"""


def coefficient_bounds(world: World, name: str) -> list[tuple[float, float]]:
    """The range in which a fit may move each coefficient of an effect.

    A plausible range orders causes; it does not overrule the data: what may have either sign may be
    twenty times larger. What is zero or positive by its meaning stays so, and what shapes an effect
    stays in its range.
    """
    bounds = []
    for parameter in effect_parameters(world.effects[name], world.simulator.system, world.channels):
        low, high = parameter.bounds
        if parameter.unit == "Hz":
            low = min(max(low, CYCLES / world.longest), high / 2.0)
        beyond = DRY if isinstance(world.effects[name], Friction) else BEYOND
        bounds.append(
            (low, high) if low > 0 else (0.0 if low == 0 else beyond * low, beyond * high)
        )
    return bounds
