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
        self._cached: dict[bytes, Array] = {}
        self._bytes = 0

    def missing(self, keys: Sequence[bytes]) -> list[int]:
        """Return the indices of elements that are not cached; of equal ones only the first."""
        # In reversed order, the first of equal elements is the one that stays.
        first_indices = {key: index for index, key in reversed(list(enumerate(keys)))}
        return sorted(index for key, index in first_indices.items() if key not in self._cached)

    def fill(
        self, keys: Sequence[bytes], missing_indices: Sequence[int], results: Array, out: Array
    ) -> None:
        """Store new results, and write those of all elements, new and cached, to an output array.

        The oldest results are removed if the memory limit `CACHE_BYTES` is exceeded.

        Shapes: L batch elements, N of them simulated now, T samples, C channels.

        Args:
            keys: (L,) keys of all elements, as passed to `missing`.
            missing_indices: indices of the elements that `missing` returned.
            results: (N, T, C) results of these elements.
            out: (L, T, C) output array for the results of all elements, changed in place.
        """
        new_results = {
            keys[index]: result for index, result in zip(missing_indices, results, strict=True)
        }
        for index, key in enumerate(keys):
            out[index] = new_results[key] if key in new_results else self._cached[key]
        for key, result in new_results.items():
            # Store a copy: a view would keep the results of a whole call in memory.
            self._cached[key] = result.copy()
            self._bytes += result.nbytes
        # The oldest entry of a dictionary comes first.
        while self._bytes > CACHE_BYTES:
            self._bytes -= self._cached.pop(next(iter(self._cached))).nbytes
