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

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.acting import is_asked, natives
from sims.robot.floating import Afloat
from sims.robot.forces import LOADED, exerted, is_in_drive, moment_of
from sims.robot.lanes import Addresses, Bench
from sims.robot.midway import Mask, Places
from sims.robot.moment import RobotMoment
from sims.robot.remembered import advanced, along
from sims.robot.system import RobotSystem
from sims.system import Acting, Effect, Force, Friction, Hidden, State

HELD = 0.004
"""Seconds over which quotients are held: a pose changes little within."""
POSITION, VELOCITY, CONTROL, SHARE = 1e-6, 1e-5, 1e-5, 1e-3
"""Differences of a position (rad or m), a velocity, a control, and a force as a share of its
size."""
SLOW = 1e-3
"""rad/s or m/s over which dry friction turns its sign along the motion."""
SIDES = ("qfrc_actuator", "qfrc_bias")
"""What presses on a joint's transmission from either side, in MuJoCo's data."""
TOGETHER = 64
"""Changes that go through time side by side; of more, what is held for them leaves the cache."""


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
        carried: (2, S, D) what transmissions carry, from either side.
        afloat: (S + 1, P) poses and (S + 1, F) velocities of what floats.
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
    afloat: Afloat
    step: float

    @property
    def rates(self) -> Array:
        """(S + 1, D + F) all velocities."""
        return np.concatenate([self.v, self.afloat.rate], axis=1)


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
        bench: lanes of the robot, as many as instants are looked at side by side.
        system: the robot's.
        motion: about which.
        acting: effects that act in it, with coefficients (K, 1, 1).
        places: addresses of the joints.
        outputs: names of MuJoCo's data and their columns that are read, beside the state.
        sizes: (E,) typical forces.
        drives: of each output the number of the joint of which it is what drives exert; -1 of
            others.
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
        drives: Sequence[int] = (),
    ) -> None:
        self._drives = tuple(drives) or (-1,) * len(outputs)
        self._exerted = np.zeros((0, 0))
        self._bench, self._system, self._motion = bench, system, motion
        self._acting = acting
        self._outputs = tuple(outputs)
        self._sizes = sizes
        self._places = places
        self._floating = bench.floating
        self._dofs = np.append(places.velocities, self._floating.velocities)
        self._steps = len(motion.controls)
        self._looks, self._of = looks, of = _looks(motion)
        every = max(round(HELD / motion.step), 1)
        numbers = np.arange(self._steps)
        self._share: Array = (numbers - looks[of]) / every
        self._earlier, self._later = _neighbours(looks, every)[:, of]
        # What is bound after a call is not there before the next one.
        for name in ("qacc", *SIDES, *dict(outputs)):
            bench.batch.bind(name)
        self.looks = 0
        self._asked = [(e, c) for e, c in acting if is_asked(e)]
        bench.load(_repeated(acting, bench.count))
        self._stiffness = bench.stiffness(places)[:1]
        self._states = [self._gone(effect, c) for effect, c in self._asked]
        self._after: dict[int, State] = {}
        bench.batch.reset(stage=0)
        self._fresh = bench.batch.state.copy()
        self._base, self._read = self._advanced({}, acting)
        self.quotients = self._quotients()
        # Accelerations and readings of the motion itself.
        self._still = self._accelerated(acting)

    @property
    def size(self) -> int:
        """Numbers of a state: positions, velocities, activations, what effects remember, moves and
        velocities of what floats.
        """
        return int(self._base.shape[1])

    # -- one step from every instant that is looked at

    def _advanced(
        self, moved: Mapping[str, tuple[int, float]], acting: Acting
    ) -> tuple[Array, Array]:
        """States (N, Z) and readings (N, O) after a step from each instant, with one column of the
        state moved.
        """
        states, readings = [], []
        bind, places, floating = self._bench.batch.bind, self._places, self._floating
        begin = 0
        for n, ids in self._placed(moved, acting):
            self._bench.batch.step(ids)
            parts = [bind("qpos")[:n, places.positions], bind("qvel")[:n, places.velocities]]
            if self._motion.act.shape[1]:
                parts.append(bind("act")[:n])
            parts += [state.v for state in self._after.values()]
            if floating:
                reached = self._motion.afloat.pose[self._looks[begin : begin + n] + 1]
                parts.append(floating.apart(bind("qpos")[:n, floating.positions], reached))
                parts.append(bind("qvel")[:n, floating.velocities])
            begin += n
            states.append(np.concatenate(parts, axis=1))
            readings.append(self._readings(n))
        return np.concatenate(states), np.concatenate(readings)

    def _accelerated(self, acting: Acting, more: Array | None = None) -> tuple[Array, Array]:
        """Accelerations (N, E) at each instant, and readings (N, O); with more forces (N, E)."""
        accelerations, readings = [], []
        applied = self._bench.batch.bind("qfrc_applied")
        dofs, begin = self._dofs, 0
        for n, ids in self._placed({}, acting):
            if more is not None:
                applied[:n, dofs] += more[begin : begin + n]
                begin += n
            self._bench.batch.forward(ids)
            accelerations.append(self._bench.batch.bind("qacc")[:n, dofs].copy())
            readings.append(self._readings(n))
        return np.concatenate(accelerations), np.concatenate(readings)

    def _readings(self, n: int) -> Array:
        """(n, O) of the lanes, as they are now."""
        bind = self._bench.batch.bind
        rows = [bind(name)[:n, column, None] for name, column in self._outputs]
        if not rows:
            return np.zeros((n, 0))
        read = np.concatenate(rows, axis=1)
        if self._exerted.size:
            of = np.array(self._drives)
            read[:, of >= 0] += self._exerted[:, of[of >= 0]]
        return read

    def _placed(
        self, moved: Mapping[str, tuple[int, float]], acting: Acting
    ) -> Iterator[tuple[int, Places | None]]:
        """Put the lanes at the instants, batch after batch: how many there are, and which."""
        motion, places, floating = self._motion, self._places, self._floating
        count = self._bench.count
        self.looks += self._looks.size
        self._bench.load(_repeated(acting, count))
        batch = self._bench.batch
        bind = batch.bind
        qpos, qvel, ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        applied = bind("qfrc_applied")
        na = motion.act.shape[1]
        targets = {
            "q": lambda k: qpos[:, places.positions[k]],
            "v": lambda k: qvel[:, places.velocities[k]],
            "f": lambda k: applied[:, self._dofs[k]],
            "u": lambda k: ctrl[:, k],
            "a": lambda k: bind("act")[:, k],
            "r": lambda k: qvel[:, floating.velocities[k]],
        }
        for begin in range(0, self._looks.size, count):
            at = self._looks[begin : begin + count]
            n = at.size
            batch.state[:] = self._fresh
            qpos[:n, places.positions] = motion.x[at]
            qvel[:n, places.velocities] = motion.v[at]
            qpos[:n, floating.positions] = motion.afloat.pose[at]
            qvel[:n, floating.velocities] = motion.afloat.rate[at]
            ctrl[:n] = motion.controls[at]
            applied[:n] = motion.forces[at]
            if na:
                bind("act")[:n] = motion.act[at]
            for name, (k, size) in moved.items():
                if name == "p":
                    poses = floating.moved(motion.afloat.pose[at], k, size)
                    qpos[:n, floating.positions] = poses
                elif name != "w":
                    targets[name](k)[:n] += size
            self._ask(at, n, dict([moved["w"]]) if "w" in moved else {})
            yield n, None if n == count else np.arange(n)

    def _ask(self, at: Places, n: int, remembered: Mapping[int, float]) -> None:
        """Add the forces of effects that hang on where the robot is, at the lanes' own states; what
        some of them remember is moved, by their numbers.
        """
        if not self._asked:
            return
        bind, places = self._bench.batch.bind, self._places
        motion = self._motion
        x = bind("qpos")[:n, places.positions]
        v = bind("qvel")[:n, places.velocities]
        inputs = {name: u[at][:, None] for name, u in motion.inputs.items()}
        t: Array = motion.step * at[:, None].astype(np.float64)
        carried = motion.carried[:, at]
        if any(effect.of in LOADED for effect, _ in self._asked):
            # A servo's drive moves with the state as it does in the simulation.
            self._bench.batch.forward(None if n == self._bench.count else np.arange(n))
            carried = np.stack([bind(name)[:n, places.velocities] for name in SIDES])
        moment = moment_of(self._system, t, x, v, inputs, carried, self._stiff(n))
        self._exerted = np.zeros_like(x)
        for k, (effect, c) in enumerate(self._asked):
            own = np.repeat(c, n, axis=1)
            if isinstance(effect, Hidden):
                known = self._states[k]
                state = State(known.x[at], known.v[at] + remembered.get(k, 0.0))
                ahead = advanced(effect, own, moment, state, 0.5 * motion.step)
                self._after[k] = advanced(effect, own, moment, state, motion.step)
                force, _ = effect.act(own, moment, ahead)
                bind("qfrc_applied")[:n, places.velocities] += force
            elif isinstance(effect, Friction):
                assert effect.coordinate is not None
                limit = np.maximum(effect.limit(own, moment)[:, 0], 0.0)
                self._bench.rub(n, int(places.velocities[effect.coordinate]), limit)
            elif isinstance(effect, Force):
                force = effect.force(own, moment)
                bind("qfrc_applied")[:n, places.velocities] += force
                if is_in_drive(effect):
                    self._exerted += force

    def _stiff(self, count: int) -> Array:
        """(count, D) of the servos, at so many instants."""
        return np.repeat(self._stiffness, count, axis=0)

    def _quotients(self) -> Quotients:
        size, afloat = self._motion.x.shape[1], self._floating.velocities.size
        na, nu = self._motion.act.shape[1], self._motion.controls.shape[1]
        # What effects remember stands behind the activations.
        remembered = list(self._after)
        moves: dict[str, list[tuple[str, int, float]]] = {
            "z": [("q", j, POSITION) for j in range(size)]
            + [("v", j, VELOCITY) for j in range(size)]
            + [("a", j, CONTROL) for j in range(na)]
            + [("w", k, CONTROL) for k in remembered]
            + [("p", j, POSITION) for j in range(afloat)]
            + [("r", j, VELOCITY) for j in range(afloat)],
            "f": [("f", j, SHARE * float(self._sizes[j])) for j in range(size + afloat)],
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
                np.stack(states, axis=2) if states else np.zeros((rows, self.size, 0)),
                np.stack(readings, axis=2) if readings else np.zeros((rows, len(self._outputs), 0)),
            )
        return Quotients(*(found[k][i] for i in range(2) for k in ("z", "f", "u")))

    # -- changes

    def by_numbers(self, owner: int, acting: Acting, change: float, bench: Bench) -> Change:
        """The change that other numbers of the model make, as (2) has it, per `change`; `bench` has
        the elements that they are of.
        """
        meant = self._meant
        with self._on(bench):
            accelerations, readings = self._accelerated(acting, meant)
            # What drives exert no force from outside changes at once.
            if min(self._drives, default=0) < 0:
                _, readings = self._accelerated(acting)
        # What accelerates the robot by so much more is a force, and acts as one.
        apart = (accelerations - self.accelerations[self._looks]) / change
        force = np.einsum("nij,nj->ni", self._inertias, apart)
        return Change(owner, forces=force, readings=(readings - self._still[1]) / change)

    @contextmanager
    def _on(self, bench: Bench) -> Iterator[None]:
        """Look at the instants in other lanes, of the same coordinates."""
        own = self._bench, self._fresh
        if bench is not self._bench:
            for name in ("qacc", *SIDES, *dict(self._outputs)):
                bench.batch.bind(name)
            bench.batch.reset(stage=0)
            self._bench, self._fresh = bench, bench.batch.state.copy()
        try:
            yield
        finally:
            self._bench, self._fresh = own

    @cached_property
    def _meant(self) -> Array:
        """(N, E) forces with which the acceleration at each instant is that over its step, which
        an implicit integrator has damped, and in which the others have gone on.
        """
        apart = self.accelerations[self._looks] - self._still[0]
        forces: Array = np.einsum("nij,nj->ni", self._inertias, apart)
        return forces

    @cached_property
    def _inertias(self) -> Array:
        """(N, E, E) of all that moves at each instant that is looked at."""
        import mujoco

        self._bench.load(_repeated(self._acting, self._bench.count))
        model = self._bench.batch.get_model(0)
        data = mujoco.MjData(model)
        places = self._places
        whole = np.zeros((model.nv, model.nv))
        found = []
        poses = self._motion.afloat.pose[self._looks]
        for x, pose in zip(self._motion.x[self._looks], poses, strict=True):
            data.qpos[places.positions] = x
            data.qpos[self._floating.positions] = pose
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_crb(model, data)
            mujoco.mj_fullM(model, data, whole)
            found.append(whole[np.ix_(self._dofs, self._dofs)])
        return np.array(found)

    def by_force(self, owner: int, effect: Effect, c: Array) -> list[Change]:
        """The changes that an effect's force makes, one for each joint that it acts on."""
        own = np.repeat(c, self._steps, axis=1)
        if isinstance(effect, Hidden):
            state = self._gone(effect, c)
            ahead = State(*(0.5 * (u[1:] + u[:-1]) for u in (state.x, state.v)))
            force, _ = effect.act(own, self.moment, ahead)
        else:
            force = _force(effect, own, self.moment)
        joints = np.flatnonzero(np.abs(force).max(axis=0) > 0)
        changes = [Change(owner, joint=int(j), series=force[:, j]) for j in joints]
        if is_in_drive(effect) and max(self._drives, default=-1) >= 0:
            changes.append(Change(owner, readings=self._shown(effect, c)))
        return changes

    def _shown(self, effect: Effect, c: Array) -> Array:
        """(N, O) what an effect in a drive changes about readings of the drives at each instant."""
        motion, at = self._motion, self._looks
        of = np.array(self._drives, dtype=np.intp)
        # Of drives that are read it is known when the step begins, and not somewhere within.
        carried = motion.carried[:, at].copy()
        carried[0][:, of[of >= 0]] = self._read[:, of >= 0]
        inputs = {name: u[at, None] for name, u in motion.inputs.items()}
        t: Array = motion.step * at[:, None].astype(np.float64)
        x, v, stiff = motion.x[at], motion.v[at], self._stiff(at.size)
        moment = moment_of(self._system, t, x, v, inputs, carried, stiff)
        force = exerted(((effect, np.repeat(c, at.size, axis=1)),), moment)
        result: Array = np.where(of >= 0, force[:, of], 0.0)
        return result

    def _gone(self, effect: Effect, c: Array) -> State:
        """States (S + 1, 1) of an effect along the motion, where it has any."""
        if not isinstance(effect, Hidden):
            return State(np.zeros((0, 1)), np.zeros((0, 1)))
        return along(effect, c, self.moment, self._motion.step)

    @cached_property
    def moment(self) -> RobotMoment:
        """All instants of the motion as one moment of S lanes, in the middle of each step."""
        motion, steps = self._motion, self._steps
        t: Array = motion.step * (np.arange(float(steps)) + 0.5)
        inputs = {name: u[:, None] for name, u in motion.inputs.items()}
        x = 0.5 * (motion.x[:-1] + motion.x[1:])[:steps]
        v = 0.5 * (motion.v[:-1] + motion.v[1:])[:steps]
        return moment_of(self._system, t[:, None], x, v, inputs, motion.carried, self._stiff(steps))

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
        size, joints = q.forces.shape[1:]
        steps, actuators = self._steps, q.controls.shape[2]
        # An owner's series lie together while they are added up.
        pushed = np.zeros((joints + actuators, count, steps))
        at_once = np.zeros((actuators, count, steps)) if self._outputs else pushed[joints:]
        read = np.zeros((steps, len(self._outputs), count))
        for change in changes:
            owner = change.owner
            if change.joint >= 0 and change.series is not None:
                pushed[change.joint, owner] += change.series
            if change.actuator >= 0 and change.series is not None:
                pushed[joints + change.actuator, owner] += change.series
                instant = change.series if change.instant is None else change.instant
                if self._outputs:
                    at_once[change.actuator, owner] += instant
            if change.forces is not None:
                pushed[:joints, owner] += self._between(change.forces).T
            if change.readings is not None:
                read[:, :, owner] += self._between(change.readings)
        # States, forces and controls below each other, so that a step is one product.
        whole = np.zeros((steps + 1, size + joints + actuators, count))
        whole[:-1, size:] = pushed.transpose(2, 0, 1)
        step = list(np.concatenate([q.states, q.forces, q.controls], axis=2))
        rows = list(whole)
        for t, look in enumerate(self._of.tolist()):
            np.matmul(step[look], rows[t], out=rows[t + 1][:size])  # (2)
        if self._outputs:
            # What numbers of the model change about readings is in them already.
            whole[:, size : size + joints, self._numbered(changes, count)] = 0.0
            seen = np.concatenate([q.read_states, q.read_forces], axis=2)
            read += np.matmul(seen[self._of], whole[:-1, : size + joints])
            instants = np.ascontiguousarray(at_once.transpose(2, 0, 1))
            read += np.matmul(q.read_controls[self._of], instants)
        states = whole[:, :size]
        return np.moveaxis(states, 2, 0), np.moveaxis(read, 2, 0)

    def _between(self, values: Array) -> Array:
        """(S, k) of values (N, k) at the instants that are looked at, linear from one to the next
        while a command holds, and beyond the last one as before it.
        """
        slope = values[self._later] - values[self._earlier]
        result: Array = values[self._of] + self._share[:, None] * slope
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
        readings = np.zeros((self._steps, len(self._outputs), size))
        states[0, :size] = np.eye(size)
        for t in range(self._steps):
            readings[t] = q.read_states[self._of[t]] @ states[t]
            states[t + 1] = q.states[self._of[t]] @ states[t]
        return np.moveaxis(states, 2, 0), np.moveaxis(readings, 2, 0)


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
    return np.flatnonzero(looked), np.cumsum(looked) - 1


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
    return tuple((e, np.repeat(c, count, axis=1)) for e, c in natives(acting))
