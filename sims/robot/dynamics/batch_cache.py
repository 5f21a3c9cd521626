"""Memory-limited cache of the MuJoCo batches of one robot, shared by all its simulators.

Run evaluators of one recording, of its segments and with smaller time steps have separate
simulators, whose batches would be equal. Each candidate with added elements needs its own model
and batches, and most candidates are requested only once.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

from sims.robot.dynamics.added_elements import AddedElements, add_elements
from sims.robot.dynamics.mujoco_batch import MujocoBatch
from sims.robot.mujoco_messages import format_mujoco_error
from sims.robot.reduced_model import strip_assets
from sims.robot.robot_model import RobotModel, cache_per_robot

CACHE_BYTES = 96 << 20
"""Maximum memory of models with added elements, in bytes.

Beyond it the least recently used models are dropped. The robot's original model does not count.
"""


class RefusedModelError(Exception):
    """MuJoCo cannot compile a model with added elements; states the effects and the reason."""


@dataclass
class _Variant:
    """A robot with added elements, and its batches by options, kind and size."""

    robot: RobotModel
    batches: dict[tuple[object, ...], MujocoBatch] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Memory of the models and of the batch elements' own fields, in bytes."""
        # The compiled model of the robot counts twice, since its spec takes about as much memory.
        size = 2 * int(self.robot.compiled.nbuffer)
        return size + sum(mujoco_batch.nbytes for mujoco_batch in self.batches.values())


class BatchCache:
    """Cache of batches by the added elements, the options of the model, and the batch size.

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
        self._extended: dict[AddedElements, _Variant] = {}
        self._refused: dict[AddedElements, str] = {}

    @property
    def batches(self) -> list[MujocoBatch]:
        """All cached batches."""
        variants = [self._own, *self._extended.values()]
        return [mujoco_batch for variant in variants for mujoco_batch in variant.batches.values()]

    def get_batch(
        self, added: AddedElements, derived: bool, count: int, settings: Mapping[str, float]
    ) -> MujocoBatch:
        """Return a batch from the cache, or create it.

        Creating a batch compiles the model, which takes much longer than a simulation. A model that
        MuJoCo rejects is stored with the reason, and is not compiled again.

        Args:
            added: elements that effects add to the model.
            derived: whether masses or armatures change.
            count: number of batch elements.
            settings: options of the model, as for `sims.robot.dynamics.mujoco_batch.MujocoBatch`.

        Raises:
            RefusedModelError: MuJoCo cannot compile the model with these added elements.
        """
        if added in self._refused:
            raise RefusedModelError(self._refused[added])
        key = (derived, count, *settings.values())
        try:
            variant = self._get_variant(added)
            if key not in variant.batches:
                variant.batches[key] = MujocoBatch(variant.robot, derived, settings, count)
                self._evict_unused_variants()
            return variant.batches[key]
        except ValueError as error:
            if not added:
                raise
            effects = ", ".join(f"{effect}@{place}" if place else effect for place, effect in added)
            said = f"{effects}: MuJoCo does not compile the model: {format_mujoco_error(error)}"
            self._refused[added] = said
            sys.stderr.write(f"simgap: not simulated: {said}\n")
            raise RefusedModelError(said) from None

    def _get_variant(self, added: AddedElements) -> _Variant:
        """Return the model with these added elements, and mark it as most recently used.

        Without added elements, this is the robot's own model, which is never dropped from
        the cache.
        """
        if not added:
            return self._own
        variant = self._extended.pop(added, None) or _Variant(add_elements(self._own.robot, added))
        # The dictionary is ordered by last use, so the variant goes to the end.
        self._extended[added] = variant
        return variant

    def _evict_unused_variants(self) -> None:
        """Drop the least recently used variants, except the last one, until the limit is met."""
        sizes = {added: variant.nbytes for added, variant in self._extended.items()}
        for added in list(sizes)[:-1]:
            if sum(sizes.values()) <= self._limit:
                break
            del self._extended[added], sizes[added]


@cache_per_robot
def get_batch_cache(robot: RobotModel) -> BatchCache:
    """Return the batch cache of a robot, which is stored with the robot."""
    return BatchCache(robot)
