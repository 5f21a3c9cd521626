"""Cache of the simulations of a robot, with a memory limit."""

from __future__ import annotations

from collections.abc import Sequence

from sims.core.simulator import Array

CACHE_BYTES = 64 << 20
"""Maximum memory in bytes for the cached results of one run evaluator; the oldest are dropped."""


class SimulationCache:
    """Observations (T, C) of batch elements, cached by their inputs, with a memory limit.

    A fit simulates a trial, accepts it, and then needs it again as the centre of finite
    differences; starts are compared before they are fitted. A third of the simulations of a robot
    are such repetitions.
    """

    def __init__(self) -> None:
        self._held: dict[bytes, Array] = {}
        self._bytes = 0

    def missing(self, keys: Sequence[bytes]) -> list[int]:
        """Return the indices of elements that are not cached; of equal ones only the first."""
        first = {key: place for place, key in reversed(list(enumerate(keys)))}
        return sorted(place for key, place in first.items() if key not in self._held)

    def fill(
        self, keys: Sequence[bytes], places: Sequence[int], results: Array, out: Array
    ) -> None:
        """Store new results, and write those of all elements, new and cached, to an output array.

        The oldest results are removed if the memory limit is exceeded.

        Shapes: T samples, C channels.

        Args:
            keys: keys of all elements, as passed to `missing`.
            places: indices of the elements that `missing` returned.
            results: (N, T, C) results of these elements.
            out: (L, T, C) output array for the results of all elements.
        """
        new_results = {keys[place]: row for place, row in zip(places, results, strict=True)}
        for place, key in enumerate(keys):
            out[place] = new_results[key] if key in new_results else self._held[key]
        for key, row in new_results.items():
            # Store a copy: a view would keep the results of a whole call in memory.
            self._held[key] = row.copy()
            self._bytes += row.nbytes
        while self._bytes > CACHE_BYTES:
            self._bytes -= self._held.pop(next(iter(self._held))).nbytes
