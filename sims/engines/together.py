"""Choose which batch elements an engine integrates together, and which one by one.

Both give the same results, bit for bit. Integration together is faster for enough elements.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from sims.engines.external import ApartError, Lane, Path, in_turn

_STEPS = 2_000_000
"""Maximum number of steps of all elements of a batch; each needs a few dozen bytes of memory."""


class Company(Protocol):
    """Integrator of several batch elements together."""

    @property
    def fewest(self) -> Mapping[str, int]:
        """Minimum number of elements, by kind, for which integration together is faster.

        A kind that is missing is never faster together.
        """
        ...

    @property
    def most(self) -> int:
        """Maximum number of elements for which integration together is faster."""
        ...

    @property
    def alike(self) -> bool:
        """Whether elements can be integrated together only if their steps are equal."""
        ...

    def kind(self, lane: Lane) -> str:
        """Return the kind of an element; elements of one kind can be integrated together."""
        ...

    def rollouts(self, lanes: Sequence[Lane]) -> list[Path | None]:
        """Integrate elements of equal constants and kind, each with at least one step.

        Returns:
            The trajectory of each; None where it must be integrated by itself.

        Raises:
            ApartError: all of them must be integrated one by one.
        """
        ...


def rollouts(
    alone: Callable[[Lane], Path],
    company: Company,
    discard: Callable[[], None],
    lanes: Sequence[Lane],
) -> Iterator[Path]:
    """Integrate all batch elements and yield their trajectories in order.

    Args:
        alone: integrates one element.
        company: integrates several elements together.
        discard: called after an element that failed when integrated by itself.
        lanes: batch elements to integrate.
    """
    paths: dict[int, Path] = {}
    for group in _groups(lanes, company):
        with contextlib.suppress(ApartError):
            found = company.rollouts([lanes[i] for i in group])
            paths.update(
                (i, path) for i, path in zip(group, found, strict=True) if path is not None
            )
    rest = [lane for i, lane in enumerate(lanes) if i not in paths]
    left = in_turn(alone, discard, rest)
    for i in range(len(lanes)):
        yield paths[i] if i in paths else next(left)


def _groups(lanes: Sequence[Lane], company: Company) -> list[list[int]]:
    """Return groups of indices of the elements that are integrated together."""
    groups: dict[tuple[object, str], list[int]] = {}
    for i, lane in enumerate(lanes):
        if lane.steps.size:
            steps = lane.steps.tobytes() if company.alike else b""
            key = (*lane.numbers.items(), steps), company.kind(lane)
            groups.setdefault(key, []).append(i)
    parts = []
    for (_, kind), group in groups.items():
        if len(group) >= company.fewest.get(kind, math.inf):
            longest = max(lanes[i].steps.size for i in group)
            count = -(-len(group) // max(min(company.most, _STEPS // longest), 1))
            # The parts differ in size by at most one element.
            parts += [group[k::count] for k in range(count)]
    return parts
