"""Batch engine of the project: many simulations of a small system together, in machine code.

The trajectory of each batch element depends on that element alone, bit for bit, and an effect that
is inactive on an element changes nothing there. Elements are stepped by
`compiled.element_stepping`.
"""

from __future__ import annotations

import numpy as np

from sims.core.argument_checks import check_positive
from sims.core.engine import IntegrationBatch, Trajectories, make_unsupported_error
from sims.core.simulator import InputError
from sims.core.system import System
from sims.core.user_messages import truncate_text
from sims.engines.compiled.batch_runner import integrate_batch
from sims.engines.compiled.data_layout import MAX_COORDINATES
from sims.engines.compiled.step_size import MAX_PHASE_PER_STEP

REQUIRED_PACKAGES: tuple[str, ...] = ()
DEFAULT_TIME_STEP = 5e-3
"""Default longest step in seconds."""


class BatchEngine:
    """Engine that integrates batches of any system.

    Args:
        time_step: longest step in seconds; steps are shorter where the motion of an element is too
            fast for it.
        turn: maximum phase in radians of an oscillation per step; see `compiled.step_size`.
        patience: maximum number of steps of an element, as a multiple of the planned ones; beyond
            it, the element becomes NaN. It bounds the time of a search through forces that are
            strongly nonlinear at every reversal. The default is no limit.
        jobs: number of threads on which many elements are stepped; the results do not depend on it.

    Raises:
        InputError: a setting is not a positive number.
    """

    name = "batch"

    def __init__(
        self,
        time_step: float = DEFAULT_TIME_STEP,
        turn: float = MAX_PHASE_PER_STEP,
        patience: float = np.inf,
        jobs: int = 1,
    ) -> None:
        """Check the settings; an infinite `turn` or `patience` means no limit.

        Args:
            time_step: Largest step in s.
            turn: Largest phase of the fastest oscillation per step, in rad; smaller steps are used
                for stiff systems.
            patience: Largest number of steps per planned step, after which an element fails.
            jobs: Number of threads.

        Raises:
            InputError: A setting is not positive, or `jobs` is not a whole number.
        """
        self.largest_step = check_positive("engine batch: time_step", time_step)
        for name, value in (("turn", turn), ("patience", patience)):
            if value != np.inf:
                check_positive(f"engine batch: {name}", value, "a positive number")
        if not (isinstance(jobs, int) and jobs >= 1):
            raise InputError(
                f"engine batch: jobs must be a number of threads, found {truncate_text(str(jobs))}"
            )
        self._max_phase = float(turn)
        self._patience = float(patience)
        self._jobs = jobs

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Integrate every element over its steps; an element that overflows is NaN throughout.

        Args:
            batch: Systems, initial states, inputs and effects of all elements.

        Returns:
            Positions, velocities and accelerations at the initial state and after each
            `batch.steps_per_sample` steps.
        """
        trajectories = integrate_batch(batch, self._max_phase, self._patience, self._jobs)
        # A value that overflows stays infinite or NaN until the end; therefore the last state shows
        # whether the whole run is finite.
        is_finite = np.isfinite(trajectories.x[:, -1]) & np.isfinite(trajectories.v[:, -1])
        failed = ~is_finite.all(axis=1)
        if failed.any():
            for values in (trajectories.x, trajectories.v, trajectories.a):
                values[failed] = np.nan
        return trajectories

    def close(self) -> None:
        """Do nothing: the engine holds no resources."""


def make_engine(
    system: type[System],
    *,
    time_step: float = DEFAULT_TIME_STEP,
    turn: float = MAX_PHASE_PER_STEP,
    patience: float = np.inf,
    jobs: int = 1,
) -> BatchEngine:
    """Make a new batch engine.

    Args:
        system: system that the engine will integrate.
        time_step: longest step in seconds.
        turn: maximum phase in radians of an oscillation per step.
        patience: maximum number of steps of an element, as a multiple of the planned ones.
        jobs: number of threads.

    Returns:
        The engine; see `BatchEngine`.

    Raises:
        InputError: a setting is not valid, or the system has too many coordinates.
    """
    count = len(system.coordinates)
    if count > MAX_COORDINATES:
        reason = f"it has {count} coordinates, and the engine at most {MAX_COORDINATES}"
        raise make_unsupported_error("batch", system, reason)
    return BatchEngine(time_step, turn, patience, jobs)
