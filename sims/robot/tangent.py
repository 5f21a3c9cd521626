"""What small changes make of a robot's motion, to first order: of hundreds of effects at the cost
of a few dozen simulations.

With z = (q, v, a) the state, u the controls and f generalised forces, a step of MuJoCo is the map
z_{t+1} = F(z_t, u_t, f_t; p) with p the numbers of the model. About one motion

    A_t = dF/dz,   B_t = dF/df,   C_t = dF/du                                                  (1)

are difference quotients, taken in all steps at once: a step of every lane of a batch, each lane at
another instant. A change with forces df, controls du or numbers p + dp then moves the motion by

    dz_{t+1} = A_t dz_t + B_t (df_t + M_t da_t) + C_t du_t                                     (2)

with da_t what other numbers change about the acceleration at the same state, and M_t the inertia

(the tangent or variational equations; J. Guckenheimer, P. Holmes, Nonlinear Oscillations, 1983,
section 1.3). What effects exert is asked along the motion, all instants at once. Readings move
likewise, with their own quotients.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.forces import is_in_drive
from sims.robot.instants import Instants
from sims.robot.lanes import Bench
from sims.robot.midway import Mask, Places
from sims.system import Acting, Effect

POSITION, VELOCITY, CONTROL, SHARE = 1e-6, 1e-5, 1e-5, 1e-3
"""Differences of a position (rad or m), a velocity, a control, and a force as a share of its
size."""
TOGETHER = 64
"""Changes that go through time side by side; of more, what is held for them leaves the cache."""


class Quotients(NamedTuple):
    """The quotients of (1) and those of readings, in every step; Z states, O readings, E = D + F
    forces.

    Attributes:
        states: A (S, Z, Z).
        forces: B (S, Z, E).
        controls: C (S, Z, nu).
        read_states: (S, O, Z).
        read_forces: (S, O, E).
        read_controls: (S, O, nu).
    """

    states: Array
    forces: Array
    controls: Array
    read_states: Array
    read_forces: Array
    read_controls: Array


class Change(NamedTuple):
    """A change to go through time: where it acts and how much, (S,); or in numbers of the model.

    Attributes:
        owner: number of the probe that it is of.
        joint: whose force it is; -1 if it is none.
        actuator: whose control it is; -1 if it is none.
        series: (S,) forces or controls; None if numbers of the model change.
        instant: (S,) controls as they are when each step begins.
        forces: (N, E) what these amount to, at each instant that is looked at.
        readings: (N, O) and what they do to readings.
    """

    owner: int
    joint: int = -1
    actuator: int = -1
    series: Array | None = None
    instant: Array | None = None
    forces: Array | None = None
    readings: Array | None = None


class Tangent:
    """The neighbourhood of one motion.

    Args:
        at: its instants.
        sizes: (E,) typical forces.
        quotients: those of another motion nearby; taken of this one where None.
    """

    def __init__(self, at: Instants, sizes: Array, quotients: Quotients | None = None) -> None:
        self._at, self._motion = at, at.motion
        self._sizes = sizes
        self._steps = len(at.motion.controls)
        numbers = np.arange(self._steps)
        self._share: Array = (numbers - at.numbers[at.of]) / at.every
        self._earlier, self._later = _neighbours(at.numbers, at.every)[:, at.of]
        self._base, self._read = at.reached({}, at.acting)
        # Where commands change at other times, quotients are taken at other instants.
        if quotients is None or quotients.states.shape[:2] != self._base.shape:
            quotients = self._quotients()
        self.quotients = quotients
        # Accelerations and readings of the motion itself.
        self._still = at.accelerated(at.acting)

    @property
    def looks(self) -> int:
        """Lanes that were placed so far."""
        return self._at.seen

    @property
    def size(self) -> int:
        """Numbers of a state: positions, velocities, activations, what effects remember, moves and
        velocities of what floats.
        """
        return int(self._base.shape[1])

    def _quotients(self) -> Quotients:
        size = self._motion.x.shape[1]
        afloat = self._sizes.size - size
        na, nu = self._motion.act.shape[1], self._motion.controls.shape[1]
        moves: dict[str, list[tuple[str, int, float]]] = {
            "z": [("q", j, POSITION) for j in range(size)]
            + [("v", j, VELOCITY) for j in range(size)]
            + [("a", j, CONTROL) for j in range(na)]
            + [("w", k, CONTROL) for k in self._at.remembering]
            + [("p", j, POSITION) for j in range(afloat)]
            + [("r", j, VELOCITY) for j in range(afloat)],
            "f": [("f", j, SHARE * float(self._sizes[j])) for j in range(size + afloat)],
            "u": [("u", j, CONTROL) for j in range(nu)],
        }
        found: dict[str, tuple[Array, Array]] = {}
        for kind, columns in moves.items():
            states, readings = [], []
            for name, j, by in columns:
                state, reading = self._at.reached({name: (j, by)}, self._at.acting)
                states.append((state - self._base) / by)
                readings.append((reading - self._read) / by)
            rows = self._at.numbers.size
            found[kind] = (
                np.stack(states, axis=2) if states else np.zeros((rows, self.size, 0)),
                np.stack(readings, axis=2) if readings else np.zeros((*self._read.shape, 0)),
            )
        return Quotients(*(found[k][i] for i in range(2) for k in ("z", "f", "u")))

    # -- changes

    def by_numbers(self, owner: int, acting: Acting, change: float, bench: Bench) -> Change:
        """The change that other numbers of the model make, as (2) has it, per `change`; `bench` has
        the elements that they are of.
        """
        meant = self._meant
        with self._at.on(bench):
            accelerations, readings = self._at.accelerated(acting, meant)
            # What drives exert no force from outside changes at once.
            if self._at.reads_others:
                _, readings = self._at.accelerated(acting)
        # What accelerates the robot by so much more is a force, and acts as one.
        apart = (accelerations - self.accelerations[self._at.numbers]) / change
        force = np.einsum("nij,nj->ni", self._inertias, apart)
        return Change(owner, forces=force, readings=(readings - self._still[1]) / change)

    @cached_property
    def _meant(self) -> Array:
        """(N, E) forces with which the acceleration at each instant is that over its step, which
        an implicit integrator has damped, and in which the others have gone on.
        """
        apart = self.accelerations[self._at.numbers] - self._still[0]
        forces: Array = np.einsum("nij,nj->ni", self._inertias, apart)
        return forces

    def by_force(self, owner: int, effect: Effect, c: Array) -> list[Change]:
        """The changes that an effect's force makes, one for each joint that it acts on."""
        force = self._at.force(effect, c)
        joints = np.flatnonzero(np.abs(force).max(axis=0) > 0)
        changes = [Change(owner, joint=int(j), series=force[:, j]) for j in joints]
        if is_in_drive(effect) and self._at.reads_drives:
            changes.append(Change(owner, readings=self._at.shown(effect, c, self._read)))
        return changes

    @cached_property
    def _inertias(self) -> Array:
        return self._at.inertias()

    @cached_property
    def accelerations(self) -> Array:
        """(S, E) over each step."""
        motion = self._motion
        result: Array = np.diff(motion.rates, axis=0)[: self._steps] / motion.step
        return result

    # -- through time

    def follow(self, changes: Sequence[Change], count: int) -> tuple[Array, Array]:
        """Changes of states (n, S + 1, Z) and of readings (n, S, O), those of one owner together.

        Args:
            changes: with owners from 0 to `count` - 1.
            count: n.
        """
        q = self.quotients
        size = q.forces.shape[1]
        steps = self._steps
        pushed, read = self.pushed(changes, count)
        # States, forces and controls below each other, so that a step is one product.
        whole = np.zeros((steps + 1, size + pushed.shape[1], count))
        whole[:-1, size:] = pushed
        step = list(np.concatenate([q.states, q.forces, q.controls], axis=2))
        rows = list(whole)
        for t, look in enumerate(self._at.of.tolist()):
            np.matmul(step[look], rows[t], out=rows[t + 1][:size])  # (2)
        if read.shape[1]:
            read += np.matmul(q.read_states[self._at.of], whole[:-1, :size])
        states = whole[:, :size]
        return np.moveaxis(states, 2, 0), np.moveaxis(read, 2, 0)

    def pushed(self, changes: Sequence[Change], count: int) -> tuple[Array, Array]:
        """Compute what changes add to forces and controls, and to readings directly.

        Args:
            changes: with owners from 0 to `count` - 1.
            count: number of owners n.

        Returns:
            Forces and controls (S, E + nu, n); readings (S, O, n) at unchanged states.
        """
        q = self.quotients
        joints = q.forces.shape[2]
        steps, actuators, outputs = self._steps, q.controls.shape[2], self._read.shape[1]
        # An owner's series lie together while they are added up.
        pushed = np.zeros((joints + actuators, count, steps))
        at_once = np.zeros((actuators, count, steps)) if outputs else pushed[joints:]
        read = np.zeros((steps, outputs, count))
        for change in changes:
            owner = change.owner
            if change.joint >= 0 and change.series is not None:
                pushed[change.joint, owner] += change.series
            if change.actuator >= 0 and change.series is not None:
                pushed[joints + change.actuator, owner] += change.series
                instant = change.series if change.instant is None else change.instant
                if outputs:
                    at_once[change.actuator, owner] += instant
            if change.forces is not None:
                pushed[:joints, owner] += self._between(change.forces).T
            if change.readings is not None:
                read[:, :, owner] += self._between(change.readings)
        whole = np.ascontiguousarray(pushed.transpose(2, 0, 1))
        if outputs:
            forces = whole[:, :joints].copy()
            # What numbers of the model change about readings is in them already.
            forces[:, :, self._numbered(changes, count)] = 0.0
            read += np.matmul(q.read_forces[self._at.of], forces)
            instants = np.ascontiguousarray(at_once.transpose(2, 0, 1))
            read += np.matmul(q.read_controls[self._at.of], instants)
        return whole, read

    @property
    def looked_at(self) -> Places:
        """(S,) for each step the number of the instant whose quotients hold there."""
        return self._at.of

    @property
    def looks_at(self) -> int:
        """Number N of instants at which quotients are taken."""
        return int(self._at.numbers.size)

    @property
    def remembering(self) -> Sequence[int]:
        """Numbers of the effects that have states of their own."""
        return self._at.remembering

    @property
    def motion_readings(self) -> Array:
        """(S, O) readings in the motion at the beginnings of steps, as the model gives them."""
        motion, of = self._motion, self._at.of
        with self._at.every_step():
            _, read = self._at.accelerated(self._at.acting)
        # A step has the mean of a command, which a sensor does not show.
        apart = motion.instant - motion.controls
        result: Array = read + np.einsum("sou,su->so", self.quotients.read_controls[of], apart)
        return result

    def step_errors(self, finer: Bench) -> Array:
        """Estimate what a step of the integrator misses, (N, Z), by Richardson's extrapolation.

        Two steps of half the length leave half the error of one step of a method of first order (L.
        F. Richardson, 1911, doi:10.1098/rsta.1911.0009).

        Args:
            finer: lanes with half the time step.
        """
        with self._at.on(finer):
            state, _ = self._at.reached({}, self._at.acting, steps=2)
        return 2.0 * (state - self._base)

    @cached_property
    def defects(self) -> Array:
        """(S, Z) by how much the motion misses the model's step from each of its states."""
        motion, joints = self._motion, self._motion.x.shape[1]
        base, _ = self._every_step
        result = np.zeros_like(base)
        result[:, :joints] = motion.x[1:] - base[:, :joints]
        result[:, joints : 2 * joints] = motion.v[1:] - base[:, joints : 2 * joints]
        moves = motion.afloat.rate.shape[1]
        if moves:
            # Moves are counted from the motion itself.
            result[:, -2 * moves : -moves] = -base[:, -2 * moves : -moves]
            result[:, -moves:] = motion.afloat.rate[1:] - base[:, -moves:]
        return result

    @property
    def limited_forces(self) -> Array:
        """(S, K) the forces that the limits of stiff servos limit, in each step."""
        return self._every_step[1]

    @cached_property
    def _every_step(self) -> tuple[Array, Array]:
        """States (S, Z) after each step, and the limited forces (S, K)."""
        with self._at.every_step(), self._at.limited_forces():
            return self._at.reached({}, self._at.acting)

    def _between(self, values: Array) -> Array:
        """(S, k) of values (N, k) at the instants that are looked at, linear from one to the next
        while a command holds, and beyond the last one as before it.
        """
        slope = values[self._later] - values[self._earlier]
        result: Array = values[self._at.of] + self._share[:, None] * slope
        return result

    @staticmethod
    def _numbered(changes: Sequence[Change], count: int) -> Mask:
        """(n,) which owners change numbers of the model."""
        numbered = np.zeros(count, dtype=bool)
        numbered[[change.owner for change in changes if change.forces is not None]] = True
        return numbered

    def begun(self) -> tuple[Array, Array]:
        """Changes by the initial state, (2 D, S + 1, Z) and (2 D, S, O): one for each position and
        velocity.
        """
        size = 2 * self._motion.x.shape[1]
        q = self.quotients
        states = np.zeros((self._steps + 1, self._base.shape[1], size))
        readings = np.zeros((self._steps, self._read.shape[1], size))
        states[0, :size] = np.eye(size)
        for t in range(self._steps):
            readings[t] = q.read_states[self._at.of[t]] @ states[t]
            states[t + 1] = q.states[self._at.of[t]] @ states[t]
        return np.moveaxis(states, 2, 0), np.moveaxis(readings, 2, 0)


def _neighbours(looks: Places, every: int) -> Places:
    """(2, N) for each instant two that are `every` steps apart, over which values are linear: it
    and the next one, or the one before and it where a command changes in between; itself twice
    where neither is.
    """
    numbers = np.arange(looks.size)
    after = np.append(np.diff(looks) == every, False)
    before = np.append(False, np.diff(looks) == every)
    earlier = np.where(after, numbers, np.where(before, numbers - 1, numbers))
    later = np.where(after, numbers + 1, numbers)
    return np.stack([earlier, later])
