"""The batches of one robot, shared by all its simulators, within a limit of memory.

Worlds of the same recording, their pieces and their finer steps have simulators of their own, whose
batches would be equal. Each candidate that puts joints in series needs a model and batches of its
own, and most candidates are asked for once.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

from sims.robot.lanes import Bench
from sims.robot.model import Robot, kept_with_robot
from sims.robot.quiet import one_line
from sims.robot.series import Added, in_series
from sims.robot.simulation_model import strip_assets

CACHE_BYTES = 96 << 20
"""Memory that the models with joints in series may take, in bytes; the ones that have not been
asked for longest are dropped beyond it. The robot's own model does not count.
"""


class RefusedModelError(Exception):
    """MuJoCo does not compile a model with joints in series: names the effects and its reason."""


@dataclass
class _Variant:
    """A robot with joints in series, and its batches by the options, the kind and the size."""

    robot: Robot
    benches: dict[tuple[object, ...], Bench] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Bytes that it takes: models, and what each lane has of its own."""
        # The model that the robot has compiled, and about as much again in its spec.
        size = 2 * int(self.robot.compiled.nbuffer)
        return size + sum(bench.nbytes for bench in self.benches.values())


class BenchCache:
    """Batches by what acts in series, the options of the model, and the number of lanes.

    Args:
        robot: that was read.
        limit: bytes, see `CACHE_BYTES`.
    """

    def __init__(self, robot: Robot, limit: int = CACHE_BYTES) -> None:
        self._limit = limit
        self._own = _Variant(strip_assets(robot))
        self._series: dict[Added, _Variant] = {}
        self._refused: dict[Added, str] = {}

    @property
    def benches(self) -> list[Bench]:
        """All that are held."""
        variants = [self._own, *self._series.values()]
        return [bench for variant in variants for bench in variant.benches.values()]

    def bench(
        self, series: Added, derived: bool, count: int, settings: Mapping[str, float]
    ) -> Bench:
        """Look up a batch, or make it.

        Args:
            series: what acts in series with joints.
            derived: whether masses or armatures change.
            count: number of lanes.
            settings: options of the model, as `sims.robot.lanes.Bench` takes them.

        Raises:
            RefusedModelError: MuJoCo refuses the model with these joints in series.
        """
        if series in self._refused:
            raise RefusedModelError(self._refused[series])
        key = (derived, count, *settings.values())
        try:
            variant = self._variant(series)
            if key not in variant.benches:
                variant.benches[key] = Bench(variant.robot, derived, settings, count)
                self._trim()
            return variant.benches[key]
        except ValueError as error:
            if not series:
                raise
            effects = ", ".join(
                f"{effect}@{place}" if place else effect for place, effect in series
            )
            said = f"{effects}: MuJoCo does not compile the model: {one_line(error)}"
            self._refused[series] = said
            sys.stderr.write(f"simgap: not simulated: {said}\n")
            raise RefusedModelError(said) from None

    def _variant(self, series: Added) -> _Variant:
        if not series:
            return self._own
        variant = self._series.pop(series, None) or _Variant(in_series(self._own.robot, series))
        self._series[series] = variant  # the last one asked for
        return variant

    def _trim(self) -> None:
        """Drop variants, but for the last one, while they take too much."""
        sizes = {series: variant.nbytes for series, variant in self._series.items()}
        for series in list(sizes)[:-1]:
            if sum(sizes.values()) <= self._limit:
                break
            del self._series[series], sizes[series]


@kept_with_robot
def bench_cache(robot: Robot) -> BenchCache:
    """The batches of a robot, which go with it."""
    return BenchCache(robot)
