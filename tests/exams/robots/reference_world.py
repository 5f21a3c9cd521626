"""Simulate one run of a robot with its hidden effects.

While a joint slides, friction is a force of known size against its motion. While it is at rest,
friction holds it, up to its limit. Accelerations and friction forces are then a linear
complementarity problem over the joints at rest, coupled by the inertia matrix.

Sources: Ph. Lötstedt, Mechanical systems of rigid bodies subject to unilateral constraints, SIAM J.
Appl. Math. 42 (1982), for accelerations; J. J. Moreau, Unilateral contact and dry friction in
finite freedom dynamics (1988), and D. Stewart and J. Trinkle, IJNME 39 (1996), for time stepping.
Solved by projected Gauss-Seidel (R. Cottle, J.-S. Pang, R. Stone, The Linear Complementarity
Problem, 1992, section 5.2).

Between events, the integrator is the classical Runge-Kutta method of fourth order with fixed steps
(E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations I, section II.1).
Events are: a command reaches its actuator, a joint comes to rest (the step ends there, found by
Brent's method), a held joint breaks away. A joint at rest has a velocity of exactly zero, therefore
it does not creep.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from tests.exams.robots.reference_plant import plant
from tests.exams.robots.robot_signals import Drives, compute_applied_signals

TIGHT = 1e-13  # Convergence threshold of the sweeps, as a fraction of the largest force.
SWEEPS = 10_000


def held(coupling, free, limits):
    """Return friction forces (S,) and accelerations (S,) of the joints at rest.

    With a = free + coupling f: |f| <= limits, a = 0 where |f| < limits, and a has the opposite sign
    of f where f is at its limit.

    Args:
        coupling: acceleration per force, symmetric and positive definite, (S, S).
        free: accelerations without these forces, (S,).
        limits: largest friction forces, (S,).
    """
    forces, scale = np.zeros(free.size), max(float(np.max(limits, initial=0.0)), 1e-300)
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(free.size):
            pull = free[i] + coupling[i] @ forces
            new = min(max(forces[i] - pull / coupling[i, i], -limits[i]), limits[i])
            change = max(change, abs(new - forces[i]))
            forces[i] = new
        if change <= TIGHT * scale:
            return forces, free + coupling @ forces
    raise RuntimeError("friction did not settle")


@dataclass(frozen=True)
class Run:
    """A run: time stamps (T,) that begin at 0, commands (T,) by actuator, and the initial state."""

    times: np.ndarray
    commands: dict[str, np.ndarray]
    q: np.ndarray
    v: np.ndarray


@dataclass(frozen=True)
class Motion:
    """Positions, velocities and actuator forces at given times, each (T, N).

    For an elastic joint, the position is that of the encoder.
    """

    times: np.ndarray
    q: np.ndarray
    v: np.ndarray
    force: np.ndarray


__all__ = ["Motion", "Run", "World"]
FINE, COARSE = 1e-3, 2e-3  # Maximum step in s for data, and for simulations that only choose sizes.
ZENO = 100  # Maximum number of events in a step.
LATER = 1e-9  # Smallest step after an event, as a fraction of the step.


class World:
    """A machine with its hidden effects.

    Args:
        machine: robot as its file describes it; it may have a floating base.
        effects: coefficients by effect@place, or numbers of an unmodelled cause by its name.
        step: maximum step, s.
    """

    def __init__(self, machine, effects=None, step=FINE):
        self.machine, self.effects, self.step = machine, dict(effects or {}), step
        self.plant = plant(machine, self.effects)
        self.drives = Drives.of(machine, self.effects)
        if soft := self.plant.elastic:
            self.step = min(step, 0.7 / soft.fastest)  # Runge-Kutta 4 is stable up to about 2.8.
        self.has_friction = self.plant.has_friction
        self.dry = bool(self.has_friction.any())

    def move(self, run, instants):
        """Return the motion at increasing times, (K,)."""
        course = _FloatingCourse if self.machine.floats else _Course
        return course(self, run).through(np.asarray(instants, dtype=float))


class _Course:
    """State of a run during its simulation.

    `sliding_direction` is -1 or 1 for a sliding joint with friction, and 0 for a joint that is held
    or has no friction. `stuck` is the mask of the held joints.
    """

    def __init__(self, world, run):
        self.world, self.plant, self.drives = world, world.plant, world.drives
        self.signals = compute_applied_signals(
            world.machine, run.times, run.commands, world.effects
        )
        self.count, self.joints = self.plant.size, world.machine.driven
        self.elastic, self.cogging = self.plant.elastic, self.plant.cogging
        self.state = np.concatenate([run.q, run.v])
        more = []
        if self.elastic:
            at = self.elastic.joint
            # Before the run, the motor was held and the link was in equilibrium.
            load = -self.plant.needed(run.q, run.v)[at]
            more = [run.q[at], run.v[at]]
            self.state[at] = run.q[at] + self.elastic.rests(load)
        # The state has positions, velocities, rotor states, hysteresis states, heat, in this order.
        self.memory = slice(2 * self.count + len(more), None)
        more += [0.0] * len(self.plant.memory)
        more += [0.0] if self.plant.heated else []
        self.has_hidden_states = bool(more)
        self.state = np.concatenate([self.state, more])
        self.tooth = run.q[self.cogging.joint] if self.cogging else 0.0
        self.target, self.lagged = self._arrived(0.0), self._arrived(0.0)
        self.begin = 0.0
        self.lags = np.zeros(self.count)
        for joint, drive in zip(self.joints, world.machine.drives, strict=True):
            self.lags[joint] = self.signals[drive.name].lag
        self.dull = bool(self.lags.any())
        self.sliding_direction, self.stuck = np.zeros(self.count), np.zeros(self.count, dtype=bool)

    def through(self, instants):
        changes = np.concatenate([s.begins for s in self.signals.values()] + [instants])
        marks = np.unique(np.round(changes[(changes > 0) & (changes <= instants[-1])], 12))
        marks = np.concatenate([[0.0], marks])
        rows, place = [], 0
        for begin, end in pairwise([*marks.tolist(), marks[-1] + 1.0]):
            self._enter(begin)
            while place < instants.size and instants[place] <= begin + 1e-10:
                rows.append(self._row())
                place += 1
            if place == instants.size:
                break
            self._advance(begin, end)
        q, v, force = (np.array(part) for part in zip(*rows, strict=True))
        return Motion(instants, q, v, force)

    def _row(self):
        q, v = (part.copy() for part in self._split_state(self.state))
        if self.elastic:
            q[self.elastic.joint], v[self.elastic.joint] = self._rotor(self.state)
        return q, v, self.drives.forces(self._commands(self.begin), q, v)

    def _split_state(self, state):
        """Return the positions and velocities of a state, each (N,)."""
        return state[: self.count], state[self.count : 2 * self.count]

    def _rotor(self, state):
        return state[2 * self.count : 2 * self.count + 2]

    def _arrived(self, t):
        values = np.zeros(self.count)
        for joint, drive in zip(self.joints, self.world.machine.drives, strict=True):
            values[joint] = self.signals[drive.name].at(t)
        return values

    def _enter(self, begin):
        """Begin a new interval, in which the command may differ."""
        self.lagged = self._commands(begin)
        self.target, self.begin = self._arrived(begin), begin
        if self.world.dry:
            self._decide(begin)

    def _commands(self, t):
        if not self.dull:
            return self.target
        left = np.exp(-(t - self.begin) / np.maximum(self.lags, 1e-12))
        return self.target + (self.lagged - self.target) * np.where(self.lags > 0, left, 0.0)

    def _advance(self, begin, end):
        steps = int(np.ceil((end - begin) / self.world.step - 1e-6))
        for now, after in pairwise(np.linspace(begin, end, steps + 1).tolist()):
            self._step(now, after)
            if self.cogging:
                self.tooth = self.cogging.caught(self.tooth, self.state)

    def _step(self, now, end):
        """Advance from `now` to `end` through all events between them."""
        if not self.world.dry:
            self.state = self._moved(now, end - now)
            return
        whole = end - now
        for _ in range(ZENO):
            if end - now <= LATER * whole:
                return
            tried = self._moved(now, end - now)
            event = self._first_event(now, end, tried)
            if event is None:
                self.state = tried
                return
            if event > now:
                self._decide(event)
            now = event
        raise RuntimeError("no solution: the joint stops too often")

    def _first_event(self, now, end, tried):
        """Return the time of the first event, and move the state there; None without an event."""
        span, n = end - now, self.count
        speeds = tried[n : 2 * n]
        turned = np.flatnonzero(self.sliding_direction * speeds < 0)
        loose = self._overloaded(end, tried)
        if not turned.size and loose <= 0:
            return None
        first, stops = span, None
        for joint in turned.tolist():

            def speed(h, joint=joint):
                return self.sliding_direction[joint] * self._moved(now, h)[n + joint]

            start = self._going(speed, span, self.state[n + joint])
            if start is None:
                self.sliding_direction[joint], self.stuck[joint] = 0.0, True
                return now
            when = brentq(speed, start, span, xtol=1e-12)
            if when < first:
                first, stops = when, joint
        if loose > 0:
            if self._overloaded(now, self.state) >= 0:
                when = min(1e-9, span)

            else:

                def excess(h):
                    return self._overloaded(now + h, self._moved(now, h))

                when = brentq(excess, 0.0, span, xtol=1e-10) + 1e-10
            if when < first:
                first, stops = when, None
        self.state = self._moved(now, first)
        if stops is not None:
            self.state[n + stops] = 0.0
            self.sliding_direction[stops] = 0.0
        return now + first

    @staticmethod
    def _going(speed, span, begins):
        """Return a time in a step at which a joint still moves forward; None if there is none.

        The joint moves backward at the end of the step.
        """
        if begins != 0.0:
            return 0.0
        return next((h for h in span * 0.5 ** np.arange(1, 20) if speed(h) > 0), None)

    def _overloaded(self, t, state):
        """Return the largest excess of needed over available friction; -1 if no joint is held."""
        if not self.stuck.any():
            return -1.0
        need = np.abs(self._holding(t, state)[0])
        limit = self._limit(t, state)[self.stuck]
        return float(np.max(need - limit * (1 + 1e-9)))

    def _limit(self, t, state):
        """Return the largest dry friction of every joint, (N,)."""
        q, v = self._split_state(state)
        if self.plant.heated:
            return self.plant.limit(t, q, v, heat=max(state[-1], 0.0))
        drive = self.drives.forces(self._commands(t), q, v) if self.plant.loads else None
        return self.plant.limit(t, q, v, drive)

    def _decide(self, t):
        """Decide which joints at rest are held, and the direction of the others."""
        q, v = self._split_state(self.state)
        has_friction = self.world.has_friction
        limit = self._limit(t, self.state)
        resting = has_friction & (v == 0.0)
        self.sliding_direction = np.where(has_friction & ~resting, np.sign(v), 0.0)
        self.stuck[:] = False
        if not resting.any():
            return
        force = self._force(t, self.state) - self.sliding_direction * limit
        free = self.plant.accelerations(q, v, force)[resting]
        coupling = np.linalg.inv(self.plant.inertia(q))[np.ix_(resting, resting)]
        forces, pull = held(coupling, free, limit[resting])
        inside = np.abs(forces) < limit[resting]
        places = np.flatnonzero(resting)
        self.stuck[places[inside]] = True
        goes = ~inside
        self.sliding_direction[places[goes]] = np.where(
            pull[goes] != 0, np.sign(pull[goes]), -np.sign(forces[goes])
        )

    def _force(self, t, state):
        """Return forces of actuators, damping, springs and biases, without dry friction, (N,)."""
        q, v = self._split_state(state)
        if self.elastic:
            return self._elastic_forces(t, state)[0]
        force = self.drives.forces(self._commands(t), q, v) + self.plant.passive(t, q, v)
        if self.cogging:
            force[self.cogging.joint] += self.cogging.push(self.tooth, q)
        for (joint, dry, _), w in zip(self.plant.memory, state[self.memory], strict=False):
            force[joint] -= dry * w
        return force

    def _elastic_forces(self, t, state):
        """Return the forces on arm and rotor; the damping of the file acts on the motor."""
        soft = self.elastic
        q, v = (part.copy() for part in self._split_state(state))
        link = q[soft.joint], v[soft.joint]
        q[soft.joint], v[soft.joint] = self._rotor(state)
        outer = self.drives.forces(self._commands(t), q, v) + self.plant.passive(t, q, v)
        through = soft.through(q[soft.joint] - link[0], v[soft.joint] - link[1])
        rotor = outer[soft.joint] - through
        outer[soft.joint] = through
        return outer, rotor

    def _holding(self, t, state):
        """Return friction of the held joints, (S,), and accelerations of all joints, (N,)."""
        q, v = self._split_state(state)
        force = self._force(t, state) - self.sliding_direction * self._limit(t, state)
        rest = force - self.plant.needed(q, v)
        mass, free = self.plant.inertia(q), ~self.stuck
        a = np.zeros(self.count)
        if free.any():
            a[free] = np.linalg.solve(mass[np.ix_(free, free)], rest[free])
        return mass[self.stuck] @ a - rest[self.stuck], a

    def _rate(self, t, state):
        q, v = self._split_state(state)
        if self.world.dry and self.stuck.any():
            a = self._holding(t, state)[1]
        else:
            force = self._force(t, state)
            if self.world.dry:
                force = force - self.sliding_direction * self._limit(t, state)
            a = self.plant.accelerations(q, v, force)
        if not self.has_hidden_states:
            return np.concatenate((v, a))
        more = []
        if self.elastic:
            more += [self._rotor(state)[1], self._elastic_forces(t, state)[1] / self.elastic.rotor]
        # Dahl model of hysteresis: w' = v / d - |v / d| w.
        for (joint, _, deflection), w in zip(self.plant.memory, state[self.memory], strict=False):
            more.append((v[joint] - abs(v[joint]) * w) / deflection)
        if hot := self.plant.heated:
            drive = self.drives.forces(self._commands(t), q, v)[hot.other]
            more.append(abs(drive * v[hot.other]) / hot.power - state[-1] / hot.time)
        return np.concatenate([v, a, more])

    def _moved(self, now, h):
        """Return the state after a Runge-Kutta 4 step; held joints do not move."""
        y = self.state
        k1 = self._rate(now, y)
        k2 = self._rate(now + h / 2, y + h / 2 * k1)
        k3 = self._rate(now + h / 2, y + h / 2 * k2)
        k4 = self._rate(now + h, y + h * k3)
        return y + h / 6 * (k1 + 2 * (k2 + k3) + k4)


class _FloatingCourse(_Course):
    """State of a run of a floating-base robot.

    Positions are q = (hinges, pose), velocities v = (hinges, velocity in the body's axes, 0). A
    pose (p, r) of a position and a unit quaternion with the velocity (u, w) follows

        p' = r u r*,    r' = r (0, w) / 2.                                                    (1)
    """

    def _rate(self, t, state):
        rate = super()._rate(t, state)
        n, first = self.count, self.plant.hinges
        pose, v = state[first:n], state[n + first : 2 * n - 1]
        vector, real, w = pose[-4:-1], pose[-1], v[-3:]
        if pose.size > 4:
            turned = np.cross(vector, v[:3])
            rate[first : first + 3] = v[:3] + 2 * (real * turned + np.cross(vector, turned))
        rate[n - 4 : n - 1] = 0.5 * (real * w + np.cross(vector, w))
        rate[n - 1] = -0.5 * vector @ w
        return rate

    def _moved(self, now, h):
        state = super()._moved(now, h)
        state[self.count - 4 : self.count] /= np.linalg.norm(state[self.count - 4 : self.count])
        return state
