"""Which lanes an engine integrates together, and which by themselves.

Both come to the same, bit for bit; together costs less where there are lanes enough.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from sims.engines.external import ApartError, Lane, Path, in_turn

_STEPS = 2_000_000
"""Steps of all lanes together: what is held for them takes some dozens of bytes each."""


class Company(Protocol):
    """Integrates lanes together."""

    @property
    def fewest(self) -> Mapping[str, int]:
        """Lanes of a kind from which on together is quicker; it never is where none is said."""
        ...

    @property
    def most(self) -> int:
        """Lanes of which together no more are quicker."""
        ...

    @property
    def alike(self) -> bool:
        """Whether lanes can be together only if they make the same steps."""
        ...

    def kind(self, lane: Lane) -> str:
        """Lanes of one kind can be together."""
        ...

    def rollouts(self, lanes: Sequence[Lane]) -> list[Path | None]:
        """Integrate lanes of the same constants and kind, each of at least one step.

        Returns:
            The motion of each; None where it must be integrated by itself.

        Raises:
            ApartError: all of them must.
        """
        ...


def rollouts(
    alone: Callable[[Lane], Path],
    company: Company,
    discard: Callable[[], None],
    lanes: Sequence[Lane],
) -> Iterator[Path]:
    """Each lane's motion, in their order.

    Args:
        alone: integrates one.
        company: integrates several.
        discard: called behind a lane that failed by itself.
        lanes: the work.
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
    """Numbers of lanes that are to be integrated together."""
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
            # As many in each part, or one less.
            parts += [group[k::count] for k in range(count)]
    return parts
