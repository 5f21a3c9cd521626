"""Where lanes are in the middle of a step, foretold at its beginning.

MuJoCo holds what is applied over a step. A force that is asked for at its beginning is half a step
late, an error of first order; asked for in its middle it gives the momentum that the force over the
step does, to second order (the midpoint rule: E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary
Differential Equations I, section II.1). With h the step, a the acceleration as MuJoCo last had it,
and d what a transmission carries, at the beginning of step k and at the end of step k - 1,

    v(h / 2) = v + h/2 a,    x(h / 2) = x + h/2 v + h²/8 a                                       (1)
    d(h / 2) = d_k + (d_{k-1, end} - d_{k-1}) / 2                                                (2)

In (2) both are of the same command: what jumps with a command jumps in d_k alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.base import Array
from sims.robot.native import RK4

Places = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Look(NamedTuple):
    """The joints of lanes at the beginning of a step, (L, D) each.

    Attributes:
        x: positions.
        v: velocities.
        a: accelerations, as MuJoCo last had them.
        drive: what actuators exert on them.
        bias: what comes of gravity and the motion of the other bodies.
        later_drive, later_bias: the same in the middle of the step.
    """

    x: Array
    v: Array
    a: Array
    drive: Array
    bias: Array
    later_drive: Array
    later_bias: Array

    @property
    def carried(self) -> tuple[Array, Array]:
        """What transmissions carry, from either side."""
        return self.drive, self.bias

    @property
    def later(self) -> tuple[Array, Array]:
        """The same in the middle of the step."""
        return self.later_drive, self.later_bias


def middle(x: Array, v: Array, a: Array, step: Array | float) -> tuple[Array, Array]:
    """Positions and velocities half a step later, (1)."""
    half = 0.5 * step
    later = v + half * a
    # That it turns round within half a step is not for a straight line to say.
    later = np.where(later * v < 0.0, v, later)
    return x + half * (v + (0.5 * half) * a), later


class Midway:
    """Looks at the first lanes of a batch at the beginning of every step in turn.

    Made before MuJoCo looks at the lanes for the first time: fields show nothing that they were
    not bound for.

    Attributes:
        of: where the joints stand among velocities.

    Args:
        batch: the mujoco.batch.Batch.
        positions, velocities: of the joints in MuJoCo's vectors.
        loaded: (L,) lanes in which it matters what transmissions carry; so many are looked at.
    """

    def __init__(self, batch: Any, positions: Places, velocities: Places, loaded: Mask) -> None:
        self._batch = batch
        self._ends = ends(batch.model)
        self._loaded, self._any = loaded, bool(loaded.any())
        self._first = True
        self.of = together(velocities)
        self._fields = [(batch.bind("qpos")[: len(loaded)], together(positions))]
        for name in ("qvel", "qacc", "qfrc_actuator", "qfrc_bias"):
            self._fields.append((batch.bind(name)[: len(loaded)], self.of))
        self._last = np.zeros((2, len(loaded), len(velocities)))
        # Of (2), where it matters.
        self._share = 0.5 * loaded[:, None]

    def look(self, anew: Mask) -> Look:
        """The lanes at the beginning of a step.

        Args:
            anew: (L,) in which commands have changed since the step before; they are written.
        """
        x, v, a, drive, bias = self._shown()
        # Without what is applied, which nothing was yet, the acceleration leads nowhere.
        first, self._first = self._first, False
        a = np.zeros_like(a) if first else a
        if not self._any:
            return Look(x, v, a, drive, bias, drive, bias)
        begun, later = self._sides(anew, first)
        return Look(x, v, a, *begun, *later)

    def _shown(self) -> list[Array]:
        """Fields as MuJoCo last had them, (L, D) each."""
        return [field[:, places] for field, places in self._fields]

    def _sides(self, anew: Mask, first: bool) -> tuple[Array, Array]:
        """(2, L, D) what transmissions carry at the beginning of a step and in its middle."""
        ended = self._carried()
        begun, last = ended, self._last
        asked = self._loaded & anew if self._ends else self._loaded
        # At the very beginning MuJoCo has just looked.
        if not first and asked.any():
            # Of no other lane, whose numbers shall not hang on its company.
            self._batch.forward(np.flatnonzero(asked))
            begun = self._carried()
        self._last = begun
        if first or not self._ends:
            return begun, begun
        return begun, begun + self._share * (ended - last)  # (2)

    def _carried(self) -> Array:
        """A copy of the last two fields, (2, L, D)."""
        (drive, of), (bias, _) = self._fields[3:]
        lanes, joints = len(self._loaded), self._last.shape[-1]
        result = np.empty((2, lanes, joints))
        result[0] = drive[:, of]
        result[1] = bias[:, of]
        return result


def ends(model: Any) -> bool:
    """Whether forces that MuJoCo leaves of a step are those of its end: Runge-Kutta looks there
    last, the other integrators at its beginning.
    """
    return bool(model.opt.integrator == RK4)


def midways(ended: Array, controls: Array) -> Array:
    """What transmissions carry in the middle of every step of a motion.

    Args:
        ended: (2, S, D) at the ends of the steps, each with its own command.
        controls: (S, nu) commands.
    """
    grown = np.diff(ended, axis=1, prepend=ended[:, :1])
    jumps: Mask = np.any(np.diff(controls, axis=0, prepend=np.nan) != 0, axis=1)
    # What jumps with a command has not grown over the step: as it grows over the next one.
    after = np.append(jumps[1:], True)
    grown[:, jumps & after] = 0.0
    then = np.flatnonzero(jumps & ~after)
    grown[:, then] = grown[:, then + 1]
    result: Array = ended - 0.5 * grown
    return result


def together(places: Places) -> Places | slice:
    """The same places as a slice where they lie side by side, of which numpy copies nothing."""
    first = int(places[0]) if places.size else 0
    alike = np.array_equal(places, np.arange(first, first + places.size))
    return slice(first, first + places.size) if alike else places
