"""Results of lanes that have been simulated, so that no lane is simulated twice."""

from __future__ import annotations

from collections.abc import Sequence

from sims.base import Array

CACHE_BYTES = 64 << 20
"""Memory that the results of one world may take; the oldest are dropped beyond it."""


class LaneCache:
    """Observations (T, C) of lanes by what determines them, within a limit of memory.

    A fit simulates a trial, accepts it, and then asks for it once more among the finite differences
    about it; starts are compared before they are fitted. A third of a robot's lanes are such.

    Args:
        limit: bytes of the results that are held.
    """

    def __init__(self, limit: int = CACHE_BYTES) -> None:
        self._limit = limit
        self._held: dict[bytes, Array] = {}
        self._bytes = 0

    def missing(self, keys: Sequence[bytes]) -> list[int]:
        """List the places of lanes whose result is not held; of equal ones the first alone."""
        first = {key: place for place, key in reversed(list(enumerate(keys)))}
        return sorted(place for key, place in first.items() if key not in self._held)

    def fill(
        self, keys: Sequence[bytes], places: Sequence[int], results: Array, out: Array
    ) -> None:
        """Hold new results, and write those of all lanes.

        Args:
            keys: of all lanes, as given to `missing`.
            places: of the lanes that `missing` listed.
            results: (N, T, C) theirs.
            out: (L, T, C) where the results of all lanes are written.
        """
        new = {keys[place]: row for place, row in zip(places, results, strict=True)}
        for place, key in enumerate(keys):
            out[place] = new[key] if key in new else self._held[key]
        for key, row in new.items():
            # A copy: a view would keep the results of a whole call alive.
            self._held[key] = row.copy()
            self._bytes += row.nbytes
        while self._bytes > self._limit:
            self._bytes -= self._held.pop(next(iter(self._held))).nbytes
