"""The project's own engine: many lanes of a small system at once, in numpy.

Each lane's motion is computed from that lane alone, so it does not depend, bit for bit, on what
else is in the call, and an effect that is off in a lane changes nothing there. Lanes on which only
a constant force acts fly in closed form (`parabola`); the others are stepped (`stepping`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sims.base import InputError
from sims.engines.batch.field import Field, acts
from sims.engines.batch.pace import TURN, divisions
from sims.engines.batch.parabola import fly
from sims.engines.batch.parts import joined, take
from sims.engines.batch.stepping import Stepping
from sims.engines.ground import Ground, Indices, Mask
from sims.limits import cut, is_number
from sims.system import Force, Friction, Lanes, Motion, System

if TYPE_CHECKING:
    from sims.engines.compiled.machine import Machine

REQUIRES: tuple[str, ...] = ()
TIME_STEP = 5e-3
"""Longest step in seconds where the user sets none."""
FEW = 3
"""Lanes whose steps are divided into more parts are stepped apart from the others."""


class Batch:
    """Integrates lanes of any system.

    Args:
        time_step: longest step in seconds; steps are shorter where a lane's motion is too fast for
            it.
        turn: radians by which an oscillation may turn in a step; see `sims.engines.batch.pace`.
        patience: a lane is given up, and NaN, that needs so many times the planned steps; so a
            search through forces that bend sharply at every reversal never waits for what is no
            answer. Without a limit by default.
        compiled: whether lanes are stepped by machine code (`sims.engines.compiled`) where there is
            a compiler and what acts on them compiles; else in numpy, to the same numbers but for
            rounding.
        jobs: threads on which machine code steps many lanes; the numbers do not depend on it.

    Raises:
        InputError: a setting that is not a positive number.
    """

    name = "batch"
    requires = REQUIRES

    def __init__(
        self,
        time_step: float = TIME_STEP,
        turn: float = TURN,
        patience: float = np.inf,
        compiled: bool = True,
        jobs: int = 1,
    ) -> None:
        if not (is_number(time_step) and time_step > 0):
            raise InputError(
                "engine batch: time_step must be a positive number of seconds, found"
                f" {cut(str(time_step))}"
            )
        for name, value in (("turn", turn), ("patience", patience)):
            if value != np.inf and not (is_number(value) and value > 0):
                raise InputError(
                    f"engine batch: {name} must be a positive number, found {cut(str(value))}"
                )
        if not (isinstance(jobs, int) and jobs >= 1):
            raise InputError(
                f"engine batch: jobs must be a number of threads, found {cut(str(jobs))}"
            )
        self.largest_step = float(time_step)
        self._turn = float(turn)
        self._patience = float(patience)
        self._compiled = compiled
        self._jobs = jobs

    def integrate(self, lanes: Lanes) -> Motion:
        """Integrate every lane over its steps; a lane whose numbers overflow is NaN throughout."""
        with np.errstate(all="ignore"):
            moved, order = _sorted(lanes, self._machine(lanes) is None)
            if not moved.any():
                motion = self._moved(lanes)
            else:
                # Lanes in free flight apart from the others: in closed form they take no steps.
                kinds = moved[order]
                flown = order[~kinds]
                stepped = order[kinds]
                motions = [(stepped, self._stepped(take(lanes, stepped)))]
                if flown.size:
                    motions.insert(0, (flown, self._moved(take(lanes, flown))))
                motion = joined(motions, lanes)
        # What is not finite stays so, so the last state tells of the whole run.
        there = np.isfinite(motion.x[:, -1])
        moving = np.isfinite(motion.v[:, -1])
        lost = ~(there & moving).all(axis=1)
        if lost.any():
            for values in (motion.x, motion.v, motion.a):
                values[lost] = np.nan
        return motion

    def _stepped(self, lanes: Lanes) -> Motion:
        """The motion of lanes that are all stepped, sorted by what acts in them."""
        made = self._machine(lanes)
        if made is None:
            return self._moved(lanes)
        from sims.engines.compiled.run import step

        motion, left = step(lanes, self._turn, self._patience, made, self._jobs)
        if left.size:
            # What does not compile is stepped here, beside what does.
            part = self._moved(take(lanes, left))
            for whole, values in ((motion.x, part.x), (motion.v, part.v), (motion.a, part.a)):
                whole[left] = values
        return motion

    def _machine(self, lanes: Lanes) -> Machine | None:
        """The machine code that steps lanes; None where numpy does."""
        if not (self._compiled and lanes.steps.shape[1]):
            return None
        # Loaded when something is stepped: the compiler's package is not for free.
        from sims.engines.compiled import machine

        return machine.machine()

    def _moved(self, lanes: Lanes) -> Motion:
        """The motion of lanes that are all stepped or all in free flight."""
        field = Field(lanes)
        ground = Ground(lanes) if lanes.system.bounces else None
        if field.free:
            start = np.zeros((len(lanes.x), 1))
            a = field.force(start, lanes.x, lanes.v) / field.mass
            return fly(lanes, a, ground)
        spans = np.max(lanes.steps, axis=1, keepdims=True, initial=0.0)
        parts = divisions(lanes, field, spans, self._turn)
        slow = (parts > FEW)[:, 0]
        # Few lanes in many short steps would keep the others waiting in every one.
        if slow.any() and not slow.all():
            groups = np.flatnonzero(~slow), np.flatnonzero(slow)
            motions = [(group, self._moved(take(lanes, group))) for group in groups]
            return joined(motions, lanes)
        return Stepping(lanes, field, ground, spans, parts).run(self._patience)

    def refuses(self, system: type[System]) -> str:  # noqa: ARG002
        """Nothing: it carries every system."""
        return ""

    def close(self) -> None:
        """It holds nothing."""


def engine(
    system: type[System],  # noqa: ARG001
    *,
    time_step: float = TIME_STEP,
    turn: float = TURN,
    patience: float = np.inf,
    compiled: bool = True,
    jobs: int = 1,
) -> Batch:
    """A new engine; see `Batch`."""
    return Batch(time_step, turn, patience, compiled, jobs)


def _sorted(lanes: Lanes, for_numpy: bool) -> tuple[Mask, Indices]:
    """(L,) whether more than a constant force acts in a lane; lanes in the order of what acts in
    them where numpy steps them.
    """
    forces = [acts(c) for effect, c in lanes.effects if isinstance(effect, (Force, Friction))]
    steps = not lanes.system.uniform
    own = np.arange(len(lanes.x))
    if not forces:
        return np.full(len(own), steps), own
    moved: Mask = np.any(forces, axis=0) | steps
    # In numpy lanes with the same effects lie together, so that each effect is asked for a short
    # span; machine code groups lanes itself, and in their own order none has to be copied.
    return moved, np.lexsort(forces) if for_numpy else own
