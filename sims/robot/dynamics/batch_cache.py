"""Memory-limited cache of the MuJoCo batches of one robot, shared by all its simulators.

Run evaluators of one recording, of its segments and with smaller time steps have separate
simulators, whose batches would be equal. Each candidate with joints in series needs its own model
and batches, and most candidates are requested only once.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

from sims.robot.dynamics.mujoco_batch import MujocoBatch
from sims.robot.dynamics.series_joints import SeriesJoints, add_series_joints
from sims.robot.mujoco_messages import format_mujoco_error
from sims.robot.reduced_model import strip_assets
from sims.robot.robot_model import RobotModel, cache_per_robot

CACHE_BYTES = 96 << 20
"""Maximum memory of models with joints in series, in bytes.

Beyond it the least recently used models are dropped. The robot's original model does not count.
"""


class RefusedModelError(Exception):
    """MuJoCo cannot compile a model with joints in series; states the effects and the reason."""


@dataclass
class _Variant:
    """A robot with joints in series, and its batches by options, kind and size."""

    robot: RobotModel
    benches: dict[tuple[object, ...], MujocoBatch] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Memory of the models and of the batch elements' own fields, in bytes."""
        # The compiled model of the robot counts twice, since its spec takes about as much memory.
        size = 2 * int(self.robot.compiled.nbuffer)
        return size + sum(bench.nbytes for bench in self.benches.values())


class BenchCache:
    """Cache of batches by the effects in series, the options of the model, and the batch size.

    Args:
        robot: robot as read from its model file.
        limit: maximum memory in bytes, see `CACHE_BYTES`.
    """

    def __init__(self, robot: RobotModel, limit: int = CACHE_BYTES) -> None:
        """Start with the robot's own model and no batch; batches are made on first request.

        Elements without influence on the motion are removed here, so that batches take less
        memory.
        """
        self._limit = limit
        self._own = _Variant(strip_assets(robot))
        self._series: dict[SeriesJoints, _Variant] = {}
        self._refused: dict[SeriesJoints, str] = {}

    @property
    def benches(self) -> list[MujocoBatch]:
        """All cached batches."""
        variants = [self._own, *self._series.values()]
        return [bench for variant in variants for bench in variant.benches.values()]

    def bench(
        self, series: SeriesJoints, derived: bool, count: int, settings: Mapping[str, float]
    ) -> MujocoBatch:
        """Return a batch from the cache, or create it.

        Creating a batch compiles the model, which takes much longer than a simulation. A model that
        MuJoCo rejects is stored with the reason, and is not compiled again.

        Args:
            series: effects in series with joints.
            derived: whether masses or armatures change.
            count: number of batch elements.
            settings: options of the model, as for `sims.robot.dynamics.mujoco_batch.MujocoBatch`.

        Raises:
            RefusedModelError: MuJoCo cannot compile the model with these joints in series.
        """
        if series in self._refused:
            raise RefusedModelError(self._refused[series])
        key = (derived, count, *settings.values())
        try:
            variant = self._get_variant(series)
            if key not in variant.benches:
                variant.benches[key] = MujocoBatch(variant.robot, derived, settings, count)
                self._drop_least_recent()
            return variant.benches[key]
        except ValueError as error:
            if not series:
                raise
            effects = ", ".join(
                f"{effect}@{place}" if place else effect for place, effect in series
            )
            said = f"{effects}: MuJoCo does not compile the model: {format_mujoco_error(error)}"
            self._refused[series] = said
            sys.stderr.write(f"simgap: not simulated: {said}\n")
            raise RefusedModelError(said) from None

    def _get_variant(self, series: SeriesJoints) -> _Variant:
        """Return the model with these joints in series, and mark it as most recently used.

        Without joints in series, this is the robot's own model, which is never dropped from
        the cache.
        """
        if not series:
            return self._own
        variant = self._series.pop(series, None) or _Variant(
            add_series_joints(self._own.robot, series)
        )
        # The dictionary is ordered by last use, so the variant goes to the end.
        self._series[series] = variant
        return variant

    def _drop_least_recent(self) -> None:
        """Drop the least recently used variants, except the last one, until the limit is met."""
        sizes = {series: variant.nbytes for series, variant in self._series.items()}
        for series in list(sizes)[:-1]:
            if sum(sizes.values()) <= self._limit:
                break
            del self._series[series], sizes[series]


@cache_per_robot
def bench_cache(robot: RobotModel) -> BenchCache:
    """Return the batch cache of a robot, which is stored with the robot."""
    return BenchCache(robot)
