"""What small changes make of a robot's motion, to first order: of hundreds of effects at the cost
of a few dozen simulations.

With z = (q, v, a) the state, u the controls and f generalised forces, a step of MuJoCo is the map
z_{t+1} = F(z_t, u_t, f_t; p) with p the numbers of the model. About one motion

    A_t = dF/dz,   B_t = dF/df,   C_t = dF/du                                                  (1)

are difference quotients, taken in all steps at once: a step of every lane of a batch, each lane at
another instant. A change with forces df, controls du or numbers p + dp then moves the motion by

    dz_{t+1} = A_t dz_t + B_t df_t + C_t du_t
               + F(z_t, u_t, f_t; p + dp) - F(z_t, u_t, f_t; p)                                (2)

(the tangent or variational equations; J. Guckenheimer, P. Holmes, Nonlinear Oscillations, 1983,
section 1.3). What effects exert is asked along the motion, all instants at once. Readings move
likewise, with their own quotients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.forces import moment_of
from sims.robot.lanes import Addresses, Bench, Places
from sims.robot.moment import RobotMoment
from sims.robot.native import FIELDS
from sims.robot.system import RobotSystem
from sims.system import Acting, Effect, Force, Friction

HELD = 0.004
"""Seconds over which quotients are held: a pose changes little within."""
POSITION, VELOCITY, CONTROL, SHARE = 1e-6, 1e-5, 1e-5, 1e-3
"""Differences of a position (rad or m), a velocity, a control, and a force as a share of its
size."""
SLOW = 1e-3
"""rad/s or m/s over which dry friction turns its sign along the motion."""
TOGETHER = 256
"""Changes that go through time side by side."""


@dataclass(frozen=True)
class Motion:
    """One motion of a robot, and all that it was made with.

    Attributes:
        x, v: (S + 1, D) positions and velocities at the beginnings of steps, and at the end.
        act: (S, na) activations at the beginnings.
        controls: (S, nu).
        instant: (S, nu) the same when each step begins.
        forces: (S, nv) generalised, known beforehand.
        inputs: (S,) what is felt of each input, by name.
        carried: (S, D) what transmissions carry.
        step: seconds.
    """

    x: Array
    v: Array
    act: Array
    controls: Array
    instant: Array
    forces: Array
    inputs: Mapping[str, Array]
    carried: Array
    step: float


class Quotients(NamedTuple):
    """The quotients of (1) and those of readings, in every step; Z states, O readings.

    Attributes:
        states: A (S, Z, Z).
        forces: B (S, Z, D).
        controls: C (S, Z, nu).
        read_states: (S, O, Z).
        read_forces: (S, O, D).
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
        states: (S, Z) what these do to a step.
        readings: (S, O) and to readings.
    """

    owner: int
    joint: int = -1
    actuator: int = -1
    series: Array | None = None
    instant: Array | None = None
    states: Array | None = None
    readings: Array | None = None


class Tangent:
    """The neighbourhood of one motion.

    Args:
        bench: lanes of the robot, as many as instants are looked at side by side.
        system: the robot's.
        motion: about which.
        acting: effects that act in it, with coefficients (K, 1, 1).
        places: addresses of the joints.
        outputs: names of MuJoCo's data and their columns that are read, beside the state.
        sizes: (D,) typical forces.
    """

    def __init__(
        self,
        bench: Bench,
        system: RobotSystem,
        motion: Motion,
        acting: Acting,
        outputs: Sequence[tuple[str, int]],
        sizes: Array,
        places: Addresses,
    ) -> None:
        self._bench, self._system, self._motion = bench, system, motion
        self._acting = acting
        self._outputs = tuple(outputs)
        self._sizes = sizes
        self._places = places
        self._steps = len(motion.controls)
        self._looks, self._of = _looks(motion)
        self.looks = 0
        bench.batch.reset(stage=0)
        self._fresh = bench.batch.state.copy()
        self._base, self._read = self._advanced({}, acting)
        self.quotients = self._quotients()

    @property
    def size(self) -> int:
        """Numbers of a state: positions, velocities, activations."""
        return int(self._base.shape[1])

    # -- one step from every instant that is looked at

    def _advanced(
        self, moved: Mapping[str, tuple[int, float]], acting: Acting
    ) -> tuple[Array, Array]:
        """States (N, Z) and readings (N, O) after a step from each instant, with one column of the
        state moved, or with other numbers of the model.
        """
        motion, places = self._motion, self._places
        count = self._bench.count
        self.looks += self._looks.size
        self._bench.load(_repeated(acting, count))
        batch = self._bench.batch
        bind = batch.bind
        qpos, qvel, ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        applied = bind("qfrc_applied")
        read = {name: bind(name) for name, _ in self._outputs}
        na = motion.act.shape[1]
        states, readings = [], []
        for begin in range(0, self._looks.size, count):
            at = self._looks[begin : begin + count]
            n = at.size
            batch.state[:] = self._fresh
            qpos[:n, places.positions] = motion.x[at]
            qvel[:n, places.velocities] = motion.v[at]
            ctrl[:n] = motion.controls[at]
            applied[:n] = motion.forces[at]
            if na:
                bind("act")[:n] = motion.act[at]
            targets = {
                "q": qpos[:, places.positions[moved["q"][0]]] if "q" in moved else None,
                "v": qvel[:, places.velocities[moved["v"][0]]] if "v" in moved else None,
                "f": applied[:, places.velocities[moved["f"][0]]] if "f" in moved else None,
                "u": ctrl[:, moved["u"][0]] if "u" in moved else None,
                "a": bind("act")[:, moved["a"][0]] if "a" in moved else None,
            }
            for name, (_, size) in moved.items():
                column = targets[name]
                assert column is not None
                column[:n] += size
            self._ask(at, n)
            batch.step(None if n == count else np.arange(n))
            parts = [qpos[:n, places.positions], qvel[:n, places.velocities]]
            if na:
                parts.append(bind("act")[:n])
            states.append(np.concatenate(parts, axis=1))
            rows = [read[name][:n, column, None] for name, column in self._outputs]
            readings.append(np.concatenate(rows, axis=1) if rows else np.zeros((n, 0)))
        return np.concatenate(states), np.concatenate(readings)

    def _ask(self, at: Places, n: int) -> None:
        """Add the forces of effects that hang on where the robot is, at the lanes' own states."""
        asked = [(e, c) for e, c in self._acting if _is_asked(e)]
        if not asked:
            return
        bind, places = self._bench.batch.bind, self._places
        motion = self._motion
        x = bind("qpos")[:n, places.positions]
        v = bind("qvel")[:n, places.velocities]
        inputs = {name: u[at][:, None] for name, u in motion.inputs.items()}
        t: Array = motion.step * at[:, None].astype(np.float64)
        moment = moment_of(self._system, t, x, v, inputs, motion.carried[at])
        for effect, c in asked:
            own = np.repeat(c, n, axis=1)
            bind("qfrc_applied")[:n, places.velocities] += _force(effect, own, moment)

    def _quotients(self) -> Quotients:
        size = self._motion.x.shape[1]
        na, nu = self._motion.act.shape[1], self._motion.controls.shape[1]
        moves: dict[str, list[tuple[str, int, float]]] = {
            "z": [("q", j, POSITION) for j in range(size)]
            + [("v", j, VELOCITY) for j in range(size)]
            + [("a", j, CONTROL) for j in range(na)],
            "f": [("f", j, SHARE * float(self._sizes[j])) for j in range(size)],
            "u": [("u", j, CONTROL) for j in range(nu)],
        }
        found: dict[str, tuple[Array, Array]] = {}
        for kind, columns in moves.items():
            states, readings = [], []
            for name, j, by in columns:
                state, reading = self._advanced({name: (j, by)}, self._acting)
                states.append((state - self._base) / by)
                readings.append((reading - self._read) / by)
            rows = self._looks.size
            found[kind] = (
                np.stack(states, axis=2) if states else np.zeros((rows, 2 * size + na, 0)),
                np.stack(readings, axis=2) if readings else np.zeros((rows, len(self._outputs), 0)),
            )
        return Quotients(*(found[k][i] for i in range(2) for k in ("z", "f", "u")))

    # -- changes

    def by_numbers(self, owner: int, acting: Acting, change: float) -> Change:
        """The change that other numbers of the model make, as (2) has it, per `change`."""
        states, readings = self._advanced({}, acting)
        return Change(
            owner,
            states=(states - self._base) / change,
            readings=(readings - self._read) / change,
        )

    def by_force(self, owner: int, effect: Effect, c: Array) -> list[Change]:
        """The changes that an effect's force makes, one for each joint that it acts on."""
        force = _force(effect, np.repeat(c, self._steps, axis=1), self.moment)
        joints = np.flatnonzero(np.abs(force).max(axis=0) > 0)
        return [Change(owner, joint=int(j), series=force[:, j]) for j in joints]

    @property
    def moment(self) -> RobotMoment:
        """All instants of the motion as one moment of S lanes, in the middle of each step."""
        motion, steps = self._motion, self._steps
        t: Array = motion.step * (np.arange(float(steps)) + 0.5)
        inputs = {name: u[:, None] for name, u in motion.inputs.items()}
        x = 0.5 * (motion.x[:-1] + motion.x[1:])[:steps]
        v = 0.5 * (motion.v[:-1] + motion.v[1:])[:steps]
        return moment_of(self._system, t[:, None], x, v, inputs, motion.carried)

    @property
    def accelerations(self) -> Array:
        """(S, D) over each step."""
        motion = self._motion
        result: Array = np.diff(motion.v, axis=0)[: self._steps] / motion.step
        return result

    # -- through time

    def follow(self, changes: Sequence[Change], count: int) -> tuple[Array, Array]:
        """Changes of states (n, S + 1, Z) and of readings (n, S, O), those of one owner together.

        Args:
            changes: with owners from 0 to `count` - 1.
            count: n.
        """
        q = self.quotients
        moved = np.zeros((self._steps, self._base.shape[1], count))
        read = np.zeros((self._steps, len(self._outputs), count))
        for layer in map(list, _layers(changes)):
            self._add(moved, layer, q.forces, q.controls, "states")
            self._add(read, layer, q.read_forces, q.read_controls, "readings")
        states = np.zeros((self._steps + 1, *moved.shape[1:]))
        for t in range(self._steps):
            np.matmul(q.states[self._of[t]], states[t], out=states[t + 1])  # (2)
            states[t + 1] += moved[t]
        if self._outputs:
            for t in range(self._steps):
                read[t] += q.read_states[self._of[t]] @ states[t]
        return np.moveaxis(states, 2, 0), np.moveaxis(read, 2, 0)

    def _add(
        self, to: Array, layer: Sequence[Change], by_force: Array, by_control: Array, numbers: str
    ) -> None:
        """Add what changes of different owners do in each step to (S, Z, n)."""
        kinds = (("joint", by_force), ("actuator", by_control))
        for kind, quotients in kinds:
            some = [c for c in layer if getattr(c, kind) >= 0]
            if some:
                series = np.stack([_series(c, numbers) for c in some], axis=1)
                columns = quotients[:, :, [getattr(c, kind) for c in some]][self._of]
                columns *= series[:, None, :]
                to[:, :, [c.owner for c in some]] += columns
        for change in layer:
            values = getattr(change, numbers)
            if values is not None:
                to[:, :, change.owner] += values[self._of]

    def begun(self) -> tuple[Array, Array]:
        """Changes by the initial state, (2 D, S + 1, Z) and (2 D, S, O): one for each position and
        velocity.
        """
        size = 2 * self._motion.x.shape[1]
        q = self.quotients
        states = np.zeros((self._steps + 1, self._base.shape[1], size))
        readings = np.zeros((self._steps, len(self._outputs), size))
        states[0, :size] = np.eye(size)
        for t in range(self._steps):
            readings[t] = q.read_states[self._of[t]] @ states[t]
            states[t + 1] = q.states[self._of[t]] @ states[t]
        return np.moveaxis(states, 2, 0), np.moveaxis(readings, 2, 0)


def _series(change: Change, numbers: str) -> Array:
    """What acts over each step, or on readings at its beginning."""
    at_once = numbers == "readings" and change.instant is not None
    series = change.instant if at_once else change.series
    assert series is not None
    return series


def _looks(motion: Motion) -> tuple[Places, Places]:
    """Steps in which quotients are taken (N,), and for each step which of them hold there (S,)."""
    steps = len(motion.controls)
    every = max(round(HELD / motion.step), 1)
    changes = np.ones(steps, dtype=bool)
    changes[1:] = (np.diff(motion.controls, axis=0) != 0).any(axis=1)
    # A command that holds for a while is looked at anew when it changes; one that never holds is
    # as smooth as the motion.
    if changes.mean() > 1.0 / every:
        changes[1:] = False
    numbers = np.arange(steps)
    begins = np.maximum.accumulate(np.where(changes, numbers, 0))
    looked = (numbers - begins) % every == 0
    looks = np.flatnonzero(looked)
    return looks, np.cumsum(looked) - 1


def _layers(changes: Sequence[Change]) -> list[list[Change]]:
    """Changes in groups in which every owner has one at most."""
    layers: list[list[Change]] = []
    depth: dict[int, int] = {}
    for change in changes:
        place = depth.get(change.owner, 0)
        depth[change.owner] = place + 1
        if place == len(layers):
            layers.append([])
        layers[place].append(change)
    return layers


def _is_asked(effect: Effect) -> bool:
    from sims.robot.forces import OVER_TIME

    return effect.hook == "force" and effect.of not in OVER_TIME and effect.of not in FIELDS


def _force(effect: Effect, c: Array, moment: RobotMoment) -> Array:
    """(S, D) what an effect exerts along a motion."""
    if isinstance(effect, Force):
        return effect.force(c, moment)
    assert isinstance(effect, Friction)
    assert effect.coordinate is not None
    limit = effect.limit(c, moment)[:, 0]
    v = moment.v[:, effect.coordinate]
    result = np.zeros_like(moment.x)
    result[:, effect.coordinate] = -limit * v / (np.abs(v) + SLOW)
    return result


def _repeated(acting: Acting, count: int) -> Acting:
    """One lane's coefficients for all lanes of a batch; of native effects alone."""
    return tuple(
        (e, np.repeat(c, count, axis=1))
        for e, c in acting
        if (e.of or e.name) in FIELDS and e.hook in ("value", "force")
    )
