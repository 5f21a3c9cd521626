"""Which lanes an engine integrates together, and which by themselves.

Both come to the same, bit for bit; together costs less where there are lanes enough.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from sims.engines import joint, joints
from sims.engines.external import Lane, Path, in_turn
from sims.engines.joint import Joint, Way, way_of

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
    for group in _groups(lanes, many):
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


def _groups(lanes: Sequence[Lane], many: joints.Joints) -> list[list[int]]:
    """Numbers of lanes that are to be integrated together."""
    groups: dict[tuple[object, str], list[int]] = {}
    for i, lane in enumerate(lanes):
        if lane.steps.size:
            kind = _kind(lane, way_of(lane, many.open_loop))
            steps = lane.steps.tobytes() if many.alike else b""
            groups.setdefault(((*lane.numbers.items(), steps), kind), []).append(i)
    parts = []
    for (_, kind), group in groups.items():
        if len(group) >= many.fewest.get(kind, math.inf):
            longest = max(lanes[i].steps.size for i in group)
            count = -(-len(group) // max(min(many.most, _STEPS // longest), 1))
            # As many in each part, or one less.
            parts += [group[k::count] for k in range(count)]
    return parts


def _kind(lane: Lane, way: Way) -> str:
    """Of the integration; see `joints.Joints`."""
    if way.damping is not None:
        even = bool((lane.steps == lane.steps[0]).all())
        return "open" if even else "stretches"
    return "asked" if way.opposing is None else "known"
