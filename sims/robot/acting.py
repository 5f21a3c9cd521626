"""What acts on lanes of a robot: in its model, asked for in every step, or beforehand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sims.robot.forces import OVER_TIME
from sims.robot.midway import Mask, Places
from sims.robot.native import FIELDS
from sims.robot.series import is_series
from sims.system import Acting, Effect


def is_native(effect: Effect) -> bool:
    """Whether the engine writes it into the model."""
    return is_series(effect) or (
        (effect.of or effect.name) in FIELDS and effect.hook in ("value", "force")
    )


def derives(effect: Effect) -> bool:
    """Whether MuJoCo derives constants from what it changes."""
    return is_native(effect) and (is_series(effect) or FIELDS[effect.of or effect.name].derived)


def natives(acting: Acting) -> Acting:
    """What is written into the model."""
    return tuple((e, c) for e, c in acting if is_native(e))


def is_asked(effect: Effect) -> bool:
    """Whether its force is known only when the robot is there."""
    if effect.hook not in ("force", "hidden"):
        return False
    return not is_native(effect) and effect.of not in OVER_TIME


def lanes_with(acting: Acting, count: int, which: Callable[[Effect], bool]) -> Mask:
    """(L,) in which lanes an effect acts of those that `which` says."""
    there = np.zeros(count, dtype=bool)
    for effect, c in acting:
        if which(effect):
            there |= (c != 0).any(axis=0)[:, 0]
    return there


def part_of(acting: Acting, lanes: Places) -> Acting:
    """What acts on some of the lanes."""
    parts = tuple((e, c[:, lanes]) for e, c in acting)
    return tuple((e, c) for e, c in parts if c.any())


def filled(acting: Acting, n: int, count: int) -> Acting:
    """Coefficients for all lanes of a batch, zero behind the first n."""
    return tuple(
        (e, np.concatenate([c, np.zeros((len(c), count - n, 1))], axis=1)) for e, c in acting
    )
