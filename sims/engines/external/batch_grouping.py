"""Choose which batch elements an engine integrates together, and which one by one.

Both give the same results, bit for bit. Integration together is faster for enough elements.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from sims.engines.external.external_engine import (
    ElementWork,
    NotBatchableError,
    Trajectory,
    integrate_one_by_one,
)

_MAX_BATCH_STEPS = 2_000_000
"""Maximum number of steps of all elements of a batch; each needs a few dozen bytes of memory."""


class BatchIntegrator(Protocol):
    """Integrator of several batch elements together."""

    @property
    def min_batch_size(self) -> Mapping[str, int]:
        """Minimum number of elements, by kind, for which integration together is faster.

        A kind that is missing is never faster together.
        """
        ...

    @property
    def max_batch_size(self) -> int:
        """Maximum number of elements for which integration together is faster."""
        ...

    @property
    def requires_equal_steps(self) -> bool:
        """Whether elements can be integrated together only if their steps are equal."""
        ...

    def get_batch_kind(self, lane: ElementWork) -> str:
        """Return the kind of an element; elements of one kind can be integrated together."""
        ...

    def integrate(self, lanes: Sequence[ElementWork]) -> list[Trajectory | None]:
        """Integrate elements of equal constants and kind, each with at least one step.

        Returns:
            The trajectory of each; None where it must be integrated by itself.

        Raises:
            NotBatchableError: all of them must be integrated one by one.
        """
        ...


def integrate_grouped(
    alone: Callable[[ElementWork], Trajectory],
    company: BatchIntegrator,
    discard: Callable[[], None],
    lanes: Sequence[ElementWork],
) -> Iterator[Trajectory]:
    """Integrate all batch elements and yield their trajectories in order.

    Args:
        alone: integrates one element.
        company: integrates several elements together.
        discard: called after an element that failed when integrated by itself.
        lanes: batch elements to integrate.
    """
    paths: dict[int, Trajectory] = {}
    for group in _groups(lanes, company):
        with contextlib.suppress(NotBatchableError):
            found = company.integrate([lanes[i] for i in group])
            paths.update(
                (i, path) for i, path in zip(group, found, strict=True) if path is not None
            )
    rest = [lane for i, lane in enumerate(lanes) if i not in paths]
    left = integrate_one_by_one(alone, discard, rest)
    for i in range(len(lanes)):
        yield paths[i] if i in paths else next(left)


def _groups(lanes: Sequence[ElementWork], company: BatchIntegrator) -> list[list[int]]:
    """Return groups of indices of the elements that are integrated together."""
    groups: dict[tuple[object, str], list[int]] = {}
    for i, lane in enumerate(lanes):
        if lane.steps.size:
            steps = lane.steps.tobytes() if company.requires_equal_steps else b""
            key = (*lane.plain_constants.items(), steps), company.get_batch_kind(lane)
            groups.setdefault(key, []).append(i)
    parts = []
    for (_, kind), group in groups.items():
        if len(group) >= company.min_batch_size.get(kind, math.inf):
            longest = max(lanes[i].steps.size for i in group)
            count = -(
                -len(group) // max(min(company.max_batch_size, _MAX_BATCH_STEPS // longest), 1)
            )
            # The parts differ in size by at most one element.
            parts += [group[k::count] for k in range(count)]
    return parts
