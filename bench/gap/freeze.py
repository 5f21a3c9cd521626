"""Freeze free numbers of a robot that the recording cannot identify.

A number that cannot be identified together with the others could take any value and would change
all other numbers. Numbers are frozen step by step, those with the largest standard error relative
to their range first, because a confounded number may then become identifiable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from bench.gap.causes.name import unfixed
from bench.gap.causes.search import Search
from bench.gap.model.base_fit import LAST_STEPS, Base
from bench.gap.model.fit import Fitter
from bench.gap.model.noise import Noise
from bench.gap.model.world import World

AGAIN = 4
"""Maximum number of refits with more frozen numbers; the last one freezes all remaining ones."""


def frozen(world: World, noise: Noise, base: Base, searching: Callable[[Base], Search]) -> Base:
    """Freeze at the nominal value all free numbers that the data cannot identify.

    Args:
        world: Run evaluator of the runs.
        noise: Noise of each channel.
        base: Fitted base model.
        searching: Function that begins a search from a base model, which gives its covariance.

    Returns:
        The base model, fitted without these numbers.
    """
    for turn in range(AGAIN):
        search = searching(base)
        wide = unfixed(search, search.base)
        places = [i for i in world.base.tolist() if world.parameters[i].name in wide]
        if not places:
            break
        # `wide` is sorted by the width of the intervals.
        places.sort(key=lambda i: wide.index(world.parameters[i].name))
        some = places if turn == AGAIN - 1 else places[: (len(places) + 1) // 2]
        theta = base.fit.theta.copy()
        theta[some] = world.nominal()[some]
        base = replace(base, vague=base.vague | frozenset(some))
        start = replace(base.fit.start(), theta=theta)
        base = replace(base, fit=Fitter(world, noise, base.frozen).fit([start], LAST_STEPS)[0])
    return base
