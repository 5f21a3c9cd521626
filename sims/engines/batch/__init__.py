"""Batch engine of the project: many simulations of a small system together, in NumPy.

The trajectory of each batch element depends on that element alone, bit for bit, and an effect that
is inactive on an element changes nothing there. Elements on which only a constant force acts are
integrated in closed form (`ballistic_motion`); the others are stepped (`runge_kutta`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sims.core.simulator import InputError
from sims.core.system import Force, Friction, IntegrationBatch, System, Trajectories
from sims.core.value_limits import is_plausible_number, truncate_text
from sims.engines.batch.ballistic_motion import integrate_ballistic
from sims.engines.batch.batch_slicing import join_trajectories, slice_batch
from sims.engines.batch.force_field import ForceField, is_active
from sims.engines.batch.runge_kutta import RungeKuttaStepper
from sims.engines.batch.step_size import MAX_PHASE_PER_STEP, choose_step_divisions
from sims.engines.ground_contact import GroundContact, Indices, Mask

if TYPE_CHECKING:
    from sims.engines.compiled.kernel import CompiledKernel

REQUIRED_PACKAGES: tuple[str, ...] = ()
DEFAULT_TIME_STEP = 5e-3
"""Default longest step in seconds."""
MAX_SEPARATELY_STEPPED = 3
"""Maximum number of parts per step of elements that are stepped together.

Elements whose steps are divided into more parts are stepped separately.
"""


class BatchEngine:
    """Engine that integrates batches of any system.

    Args:
        time_step: longest step in seconds; steps are shorter where the motion of an element is too
            fast for it.
        turn: maximum phase in radians of an oscillation per step; see `batch.step_size`.
        patience: maximum number of steps of an element, as a multiple of the planned ones; beyond
            it, the element becomes NaN. It bounds the time of a search through forces that are
            strongly nonlinear at every reversal. The default is no limit.
        compiled: whether machine code (`sims.engines.compiled`) steps the elements if a compiler is
            available and the effects can be compiled; otherwise NumPy is used, with results equal
            up to rounding.
        jobs: number of threads on which machine code steps many elements; the results do not depend
            on it.

    Raises:
        InputError: a setting is not a positive number.
    """

    name = "batch"
    requires = REQUIRED_PACKAGES

    def __init__(
        self,
        time_step: float = DEFAULT_TIME_STEP,
        turn: float = MAX_PHASE_PER_STEP,
        patience: float = np.inf,
        compiled: bool = True,
        jobs: int = 1,
    ) -> None:
        if not (is_plausible_number(time_step) and time_step > 0):
            raise InputError(
                "engine batch: time_step must be a positive number of seconds, found"
                f" {truncate_text(str(time_step))}"
            )
        for name, value in (("turn", turn), ("patience", patience)):
            if value != np.inf and not (is_plausible_number(value) and value > 0):
                raise InputError(
                    f"engine batch: {name} must be a positive number, "
                    f"found {truncate_text(str(value))}"
                )
        if not (isinstance(jobs, int) and jobs >= 1):
            raise InputError(
                f"engine batch: jobs must be a number of threads, found {truncate_text(str(jobs))}"
            )
        self.largest_step = float(time_step)
        self._turn = float(turn)
        self._patience = float(patience)
        self._compiled = compiled
        self._jobs = jobs

    def integrate(self, lanes: IntegrationBatch) -> Trajectories:
        """Integrate every element over its steps; an element that overflows is NaN throughout."""
        with np.errstate(all="ignore"):
            moved, order = _sorted(lanes, self._machine(lanes) is None)
            if not moved.any():
                motion = self._moved(lanes)
            else:
                # Elements in free flight are separated, because they need no steps in closed form.
                kinds = moved[order]
                flown = order[~kinds]
                stepped = order[kinds]
                motions = [(stepped, self._stepped(slice_batch(lanes, stepped)))]
                if flown.size:
                    motions.insert(0, (flown, self._moved(slice_batch(lanes, flown))))
                motion = join_trajectories(motions, lanes)
        # Values that are not finite stay so; therefore the last state shows whether the whole run
        # is.
        there = np.isfinite(motion.x[:, -1])
        moving = np.isfinite(motion.v[:, -1])
        lost = ~(there & moving).all(axis=1)
        if lost.any():
            for values in (motion.x, motion.v, motion.a):
                values[lost] = np.nan
        return motion

    def _stepped(self, lanes: IntegrationBatch) -> Trajectories:
        """Return the trajectories of stepped elements, sorted by their active effects."""
        made = self._machine(lanes)
        if made is None:
            return self._moved(lanes)
        from sims.engines.compiled.batch_runner import step_batch

        motion, left = step_batch(lanes, self._turn, self._patience, made, self._jobs)
        if left.size:
            # Elements that cannot be compiled are stepped in NumPy.
            part = self._moved(slice_batch(lanes, left))
            for whole, values in ((motion.x, part.x), (motion.v, part.v), (motion.a, part.a)):
                whole[left] = values
        return motion

    def _machine(self, lanes: IntegrationBatch) -> CompiledKernel | None:
        """Return the compiled kernel that steps the elements; None where NumPy does."""
        if not (self._compiled and lanes.steps.shape[1]):
            return None
        # The module is imported on first use, because the compiler's package is slow to import.
        from sims.engines.compiled import kernel

        return kernel.get_kernel()

    def _moved(self, lanes: IntegrationBatch) -> Trajectories:
        """Return the trajectories of elements that are either all stepped or all in free flight."""
        field = ForceField(lanes)
        ground = GroundContact(lanes) if lanes.system.bounces else None
        if field.is_constant_force:
            start = np.zeros((len(lanes.x), 1))
            a = field.compute_force(start, lanes.x, lanes.v) / field.mass
            return integrate_ballistic(lanes, a, ground)
        spans = np.max(lanes.steps, axis=1, keepdims=True, initial=0.0)
        parts = choose_step_divisions(lanes, field, spans, self._turn)
        slow = (parts > MAX_SEPARATELY_STEPPED)[:, 0]
        # A few elements with many short steps would delay all others at every step.
        if slow.any() and not slow.all():
            groups = np.flatnonzero(~slow), np.flatnonzero(slow)
            motions = [(group, self._moved(slice_batch(lanes, group))) for group in groups]
            return join_trajectories(motions, lanes)
        return RungeKuttaStepper(lanes, field, ground, spans, parts).integrate(self._patience)

    def find_unsupported_reason(self, system: type[System]) -> str:  # noqa: ARG002
        """Return an empty text: the engine can integrate every system."""
        return ""

    def close(self) -> None:
        """Do nothing: the engine holds no resources."""


def make_engine(
    system: type[System],  # noqa: ARG001
    *,
    time_step: float = DEFAULT_TIME_STEP,
    turn: float = MAX_PHASE_PER_STEP,
    patience: float = np.inf,
    compiled: bool = True,
    jobs: int = 1,
) -> BatchEngine:
    """Make a new batch engine.

    Args:
        system: system that the engine will integrate.
        time_step: longest step in seconds.
        turn: maximum phase in radians of an oscillation per step.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
        compiled: whether to use machine code where possible.
        jobs: number of threads of the machine code.

    Returns:
        The engine; see `BatchEngine`.
    """
    return BatchEngine(time_step, turn, patience, compiled, jobs)


def _sorted(lanes: IntegrationBatch, for_numpy: bool) -> tuple[Mask, Indices]:
    """Return which elements (L,) need steps, and the order in which elements are integrated.

    An element needs steps if more than a constant force acts on it. If NumPy steps them, elements
    are ordered by their active effects.
    """
    forces = [is_active(c) for effect, c in lanes.effects if isinstance(effect, (Force, Friction))]
    steps = not lanes.system.uniform
    own = np.arange(len(lanes.x))
    if not forces:
        return np.full(len(own), steps), own
    moved: Mask = np.any(forces, axis=0) | steps
    # In NumPy, elements with the same effects are adjacent, so that each effect is evaluated on a
    # short span. Machine code groups elements itself, and without reordering none must be copied.
    return moved, np.lexsort(forces) if for_numpy else own
