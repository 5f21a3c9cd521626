"""Numbers of a robot that a user left free and that a recording cannot fix: they are frozen, not
fitted.

What cannot be fixed beside the others would take any value, and every other number with it. One is
frozen after another, the widest against its range first, since a second one that was mixed up with
it may be fixed then.
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
"""Times a fit is made again with more numbers frozen; the last time all of them at once."""


def frozen(world: World, noise: Noise, base: Base, searching: Callable[[Base], Search]) -> Base:
    """The base model with every free number at its nominal value that the data cannot fix.

    Args:
        world: the runs.
        noise: of each channel.
        base: the fitted base model.
        searching: a search from a base model, which knows its covariance.
    """
    for turn in range(AGAIN):
        search = searching(base)
        wide = unfixed(search, search.base)
        places = [i for i in world.base.tolist() if world.parameters[i].name in wide]
        if not places:
            break
        # They come in the order of how wide they are.
        places.sort(key=lambda i: wide.index(world.parameters[i].name))
        some = places if turn == AGAIN - 1 else places[: (len(places) + 1) // 2]
        theta = base.fit.theta.copy()
        theta[some] = world.nominal()[some]
        base = replace(base, vague=base.vague | frozenset(some))
        start = replace(base.fit.start(), theta=theta)
        base = replace(base, fit=Fitter(world, noise, base.frozen).fit([start], LAST_STEPS)[0])
    return base
