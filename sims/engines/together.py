"""Which lanes an engine integrates together, and which by themselves.

Both come to the same, bit for bit; together costs less where there are lanes enough.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from sims.engines import joint, joints
from sims.engines.external import Lane, Path, in_turn
from sims.engines.joint import Joint, Way, way_of

FEWEST = {"open": 1, "stretches": 16, "known": 24, "asked": 5}
"""Lanes from which on together is quicker: where the engine runs on its own over all of the run, or
over stretches between changes of the step; where forces are written out; where they are asked."""
_MOST = 256
"""Lanes together: of more, what is held for them leaves the processor's cache."""
_STEPS = 2_000_000
"""Steps of all lanes together: what is held for them takes some dozens of bytes each."""


def rollouts(
    alone: Joint, many: joints.Joints, discard: Callable[[], None], lanes: Sequence[Lane]
) -> Iterator[Path]:
    """Each lane's motion, in their order.

    Args:
        alone: integrates one.
        many: integrates several of the same constants.
        discard: called behind a lane that failed by itself.
        lanes: the work.
    """
    paths: dict[int, Path] = {}
    for group in _groups(lanes, many.open_loop):
        chosen = [lanes[i] for i in group]
        # Lanes that cannot share a world are integrated by themselves.
        with contextlib.suppress(joints.ApartError):
            found = joints.rollouts(many, chosen, [way_of(lane, many.open_loop) for lane in chosen])
            paths.update(
                (i, path) for i, path in zip(group, found, strict=True) if path is not None
            )
    left = in_turn(
        partial(joint.rollout, alone),
        discard,
        [lane for i, lane in enumerate(lanes) if i not in paths],
    )
    for i in range(len(lanes)):
        yield paths[i] if i in paths else next(left)


def _groups(lanes: Sequence[Lane], open_loop: bool) -> list[list[int]]:
    """Numbers of lanes that are to be integrated together."""
    groups: dict[tuple[object, str], list[int]] = {}
    for i, lane in enumerate(lanes):
        if lane.steps.size:
            way = way_of(lane, open_loop)
            key = (tuple(lane.numbers.items()), _kind(lane, way))
            groups.setdefault(key, []).append(i)
    parts = []
    for (_, kind), group in groups.items():
        if len(group) >= FEWEST[kind]:
            longest = max(lanes[i].steps.size for i in group)
            size = max(min(_MOST, _STEPS // longest), 1)
            parts += [group[k : k + size] for k in range(0, len(group), size)]
    return parts


def _kind(lane: Lane, way: Way) -> str:
    """Of the integration, as in `FEWEST`."""
    if way.damping is not None:
        even = bool((lane.steps == lane.steps[0]).all())
        return "open" if even else "stretches"
    return "asked" if way.opposing is None else "known"
