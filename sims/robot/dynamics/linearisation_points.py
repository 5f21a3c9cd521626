"""Robot states along one motion, for finite-difference linearisation.

Each state is placed in another element of a batch. Computed are the states after a step,
accelerations, and effect forces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sims.core.effect import ActiveEffects, Effect, Force, Friction, HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import is_evaluated_per_step, select_model_field_effects
from sims.robot.dynamics.disabled_drives import ForceRanges, Mask, working_servos
from sims.robot.dynamics.effect_forces import (
    LOAD_DEPENDENT_EFFECTS,
    compute_drive_effect_forces,
    is_in_drive,
    make_snapshot,
)
from sims.robot.dynamics.hidden_state_integration import advance_state, integrate_state
from sims.robot.dynamics.midpoint_state import Places
from sims.robot.dynamics.mujoco_batch import JointAddresses, MujocoBatch
from sims.robot.floating_joints import FloatingState
from sims.robot.model_field_effects import FRICTION_SOLIMP, get_friction_solref
from sims.robot.robot_model import RobotModel
from sims.robot.robot_system import RobotSystem
from sims.robot.state_snapshots import RobotSnapshot

LINEARISATION_INTERVAL_SECONDS = 0.004
"""Interval of the linearisation in seconds; a pose changes little within it."""
TRANSMISSION_FORCE_FIELDS = ("qfrc_actuator", "qfrc_bias")
"""Fields of MuJoCo's data with the forces on both sides of a joint's transmission."""


@dataclass(frozen=True)
class RobotMotion:
    """One motion of a robot, with all its inputs.

    Attributes:
        x: (S + 1, D) positions at the beginnings of steps, and at the end.
        v: (S + 1, D) velocities at the beginnings of steps, and at the end.
        act: (S, na) activations at the beginnings of steps.
        controls: (S, nu) mean controls over each step.
        instant: (S, nu) controls at the beginning of each step.
        forces: (S, nv) precomputed generalised forces.
        inputs: (S,) applied inputs by name.
        carried: (2, S, D) forces on both sides of the transmissions.
        afloat: (S + 1, P) poses and (S + 1, F) velocities of floating bodies.
        step: step length in seconds.
        off: (S, K) whether each actuator is switched off.
    """

    x: Array
    v: Array
    act: Array
    controls: Array
    instant: Array
    forces: Array
    inputs: Mapping[str, Array]
    carried: Array
    afloat: FloatingState
    step: float
    off: Mask

    @property
    def velocities(self) -> Array:
        """All velocities (S + 1, D + F)."""
        return np.concatenate([self.v, self.afloat.rate], axis=1)


class LinearisationPoints:
    """Linearisation points of one motion.

    Args:
        mujoco_batch: batch of the robot; its size is the number of points evaluated together.
        system: system of the robot.
        motion: the motion.
        acting: effects active in it, with coefficients (K, 1, 1).
        outputs: fields of MuJoCo's data and their columns that are read, in addition to the state.
        places: addresses of the joints.
        drives: for each output, the number of the joint whose drive force it is; -1 for other
            outputs.
        held: interval of the linearisation in seconds.

    Attributes:
        motion: the given motion.
        acting: the given effects.
        numbers: (N,) steps that begin at the points.
        of: (S,) index of the point that applies to each step.
        every: number of steps between two points while no command changes.
        seen: number of batch elements that have been placed so far.
        remembering: numbers of the effects with hidden states, in the order of their state columns.
    """

    def __init__(
        self,
        mujoco_batch: MujocoBatch,
        system: RobotSystem,
        motion: RobotMotion,
        acting: ActiveEffects,
        outputs: Sequence[tuple[str, int]],
        places: JointAddresses,
        drives: Sequence[int] = (),
        held: float = LINEARISATION_INTERVAL_SECONDS,
    ) -> None:
        """Choose the points of the motion, and prepare the batch (fields, effects, state).

        Also integrate the hidden states of the effects along the motion, since each point
        needs them.
        """
        self.motion, self.acting = motion, acting
        self._mujoco_batch, self._system = mujoco_batch, system
        self._outputs = tuple(outputs)
        self._places = places
        self._drives = np.array(tuple(drives) or (-1,) * len(self._outputs), dtype=np.intp)
        self._exerted = np.zeros((0, 0))
        self._floating = mujoco_batch.floating
        self._dofs = np.append(places.velocities, self._floating.velocities)
        self.every = max(round(held / motion.step), 1)
        self.numbers, self.of = _looked_at(motion, self.every)
        # Fields must be bound before MuJoCo's first call, since later ones are not updated before
        # the next call.
        self._bind_fields(mujoco_batch)
        self.seen = 0
        self._asked = [(e, c) for e, c in acting if is_evaluated_per_step(e)]
        mujoco_batch.write_effects(_repeat_coefficients(acting, mujoco_batch.count))
        self._stiffness = mujoco_batch.get_servo_stiffness(places)[:1]
        self._working = working_servos(mujoco_batch.robot, places.velocities, motion.off)
        self._states = [self.integrate_hidden_state(effect, c) for effect, c in self._asked]
        self.remembering = [
            k for k, (e, _) in enumerate(self._asked) if isinstance(e, HiddenStateEffect)
        ]
        self._after: dict[int, HiddenState] = {}
        mujoco_batch.batch.reset(stage=0)
        self._fresh = mujoco_batch.batch.state.copy()

    def _bind_fields(self, mujoco_batch: MujocoBatch) -> None:
        """Bind the fields of MuJoCo's data that are read, before MuJoCo's first call."""
        for name in ("qacc", *TRANSMISSION_FORCE_FIELDS, *dict(self._outputs)):
            mujoco_batch.batch.bind(name)

    @property
    def reads_drives(self) -> bool:
        """True if any output is a drive force."""
        return bool((self._drives >= 0).any())

    @property
    def reads_others(self) -> bool:
        """True if any output is not a drive force."""
        return bool((self._drives < 0).any())

    def step_displaced(
        self, moved: Mapping[str, tuple[int, float]], acting: ActiveEffects, steps: int = 1
    ) -> tuple[Array, Array]:
        """Compute states (N, Z) and readings (N, O) after a step from each point.

        Args:
            moved: perturbed column of the initial state or inputs, and the size of the
                perturbation, by kind: ``q``, ``v``, ``a``, ``p``, ``r``, ``w``, ``f`` or ``u``.
            acting: effects whose elements are in the model.
            steps: number of steps, for a batch with shorter ones.
        """
        states, readings = [], []
        bind, places, floating = self._mujoco_batch.batch.bind, self._places, self._floating
        begin = 0
        for n, ids in self._place_points(moved, acting):
            for _ in range(steps):
                self._mujoco_batch.batch.step(ids)
            parts = [bind("qpos")[:n, places.positions], bind("qvel")[:n, places.velocities]]
            if self.motion.act.shape[1]:
                parts.append(bind("act")[:n])
            parts += [state.v for state in self._after.values()]
            if floating:
                reached = self.motion.afloat.pose[self.numbers[begin : begin + n] + 1]
                parts.append(
                    floating.compute_displacement(bind("qpos")[:n, floating.positions], reached)
                )
                parts.append(bind("qvel")[:n, floating.velocities])
            begin += n
            states.append(np.concatenate(parts, axis=1))
            readings.append(self._read_outputs(n))
        return np.concatenate(states), np.concatenate(readings)

    def compute_accelerations(
        self, acting: ActiveEffects, more: Array | None = None
    ) -> tuple[Array, Array]:
        """Compute accelerations (N, E) and readings (N, O) at each point.

        E are all joints and floating bodies, and O the outputs that are read. No step is
        made, so that the accelerations are those at the state itself.

        Args:
            acting: effects whose elements are in the model.
            more: (N, E) additional forces; none by default.
        """
        accelerations, readings = [], []
        applied = self._mujoco_batch.batch.bind("qfrc_applied")
        dofs, begin = self._dofs, 0
        for n, ids in self._place_points({}, acting):
            if more is not None:
                applied[:n, dofs] += more[begin : begin + n]
                begin += n
            self._mujoco_batch.batch.forward(ids)
            accelerations.append(self._mujoco_batch.batch.bind("qacc")[:n, dofs].copy())
            readings.append(self._read_outputs(n))
        return np.concatenate(accelerations), np.concatenate(readings)

    def _read_outputs(self, n: int) -> Array:
        """Read the O outputs from the first n elements of the batch, (n, O).

        To readings of drive forces, the forces that effects exert in the drive are added.
        """
        bind = self._mujoco_batch.batch.bind
        rows = [bind(name)[:n, column, None] for name, column in self._outputs]
        if not rows:
            return np.zeros((n, 0))
        read = np.concatenate(rows, axis=1)
        if self._exerted.size:
            of = self._drives
            read[:, of >= 0] += self._exerted[:, of[of >= 0]]
        return read

    def _place_points(
        self, moved: Mapping[str, tuple[int, float]], acting: ActiveEffects
    ) -> Iterator[tuple[int, Places | None]]:
        """Place the points in the elements of the batch, as many at a time as it has elements.

        Args:
            moved: displacements for a difference quotient, index and size by quantity: q position,
                v velocity, a activation, w hidden state, p and r displacement and velocity of
                floating bodies, f force, u control.
            acting: active effects.

        Yields:
            Number n of elements in use, and their indices (None if all are in use).
        """
        motion, places, floating = self.motion, self._places, self._floating
        count = self._mujoco_batch.count
        self.seen += self.numbers.size
        self._mujoco_batch.write_effects(_repeat_coefficients(acting, count))
        batch = self._mujoco_batch.batch
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
        ranges: ForceRanges | None = None
        if motion.off[self.numbers].any():
            ranges = self._mujoco_batch.force_ranges()
        for begin in range(0, self.numbers.size, count):
            at = self.numbers[begin : begin + count]
            n = at.size
            if ranges is not None:
                ranges.write(motion.off[at])
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
                    poses = floating.displace(motion.afloat.pose[at], k, size)
                    qpos[:n, floating.positions] = poses
                elif name != "w":
                    targets[name](k)[:n] += size
            self._add_effect_forces(at, n, dict([moved["w"]]) if "w" in moved else {})
            yield n, None if n == count else np.arange(n)

    def _add_effect_forces(self, at: Places, n: int, remembered: Mapping[int, float]) -> None:
        """Add state-dependent effect forces at the states of the batch elements.

        Args:
            at: steps of the points.
            n: number of batch elements in use.
            remembered: perturbations of hidden states, by number of the effect.
        """
        if not self._asked:
            return
        bind, places = self._mujoco_batch.batch.bind, self._places
        motion = self.motion
        x = bind("qpos")[:n, places.positions]
        v = bind("qvel")[:n, places.velocities]
        inputs = {name: u[at][:, None] for name, u in motion.inputs.items()}
        t: Array = motion.step * at[:, None].astype(np.float64)
        carried = motion.carried[:, at]
        if any(effect.of in LOAD_DEPENDENT_EFFECTS for effect, _ in self._asked):
            # As in the simulation, a servo's force must follow the perturbed state.
            self._mujoco_batch.batch.forward(
                None if n == self._mujoco_batch.count else np.arange(n)
            )
            carried = np.stack(
                [bind(name)[:n, places.velocities] for name in TRANSMISSION_FORCE_FIELDS]
            )
        moment = make_snapshot(self._system, t, x, v, inputs, carried, self.get_servo_stiffness(at))
        self._exerted = np.zeros_like(x)
        limits: dict[int, Array] = {}
        for k, (effect, c) in enumerate(self._asked):
            own = np.repeat(c, n, axis=1)
            if isinstance(effect, HiddenStateEffect):
                known = self._states[k]
                state = HiddenState(known.x[at], known.v[at] + remembered.get(k, 0.0))
                ahead = advance_state(effect, own, moment, state, 0.5 * motion.step)
                self._after[k] = advance_state(effect, own, moment, state, motion.step)
                force, _ = effect.act(own, moment, ahead)
                bind("qfrc_applied")[:n, places.velocities] += force
            elif isinstance(effect, Friction):
                assert effect.coordinate is not None
                limit = effect.limit(own, moment)[:, 0]
                limits[effect.coordinate] = limits.get(effect.coordinate, 0.0) + limit
            elif isinstance(effect, Force):
                force = effect.force(own, moment)
                bind("qfrc_applied")[:n, places.velocities] += force
                if is_in_drive(effect):
                    self._exerted += force
        for joint, limit in limits.items():
            self._mujoco_batch.set_dry_friction(
                n, int(places.velocities[joint]), np.maximum(limit, 0.0)
            )

    def get_servo_stiffness(self, at: Places) -> Array:
        """Return the stiffness (n, D) of the position servos, in some steps."""
        stiffness: Array = self._stiffness * self._working[at]
        return stiffness

    @contextmanager
    def with_batch(self, mujoco_batch: MujocoBatch) -> Iterator[None]:
        """Use another batch of the robot within a `with` block, such as one with other masses.

        Its coordinates must be the same as those of the own batch.
        """
        own = self._mujoco_batch, self._fresh
        if mujoco_batch is not self._mujoco_batch:
            self._bind_fields(mujoco_batch)
            mujoco_batch.batch.reset(stage=0)
            self._mujoco_batch, self._fresh = mujoco_batch, mujoco_batch.batch.state.copy()
        try:
            yield
        finally:
            self._mujoco_batch, self._fresh = own

    @contextmanager
    def every_step(self) -> Iterator[None]:
        """Evaluate every step, instead of the linearisation points only."""
        own = self.numbers
        self.numbers = np.arange(len(self.motion.controls))
        try:
            yield
        finally:
            self.numbers = own

    @contextmanager
    def limited_forces(self) -> Iterator[None]:
        """Read the limited forces of stiff servos within a `with` block, not the outputs.

        They show at which points a force limit is reached, where the linear model is not
        valid.
        """
        own = self._outputs, self._drives
        self._outputs = self._mujoco_batch.force_limits.outputs
        self._drives = np.full(len(self._outputs), -1)
        self._bind_fields(self._mujoco_batch)
        try:
            yield
        finally:
            self._outputs, self._drives = own

    def compute_mass_matrices(self) -> Array:
        """Compute the inertia matrix (N, E, E) at each point, by MuJoCo's composite-body algorithm.

        The E rows are those of the joints and of the floating bodies.
        """
        import mujoco

        self._mujoco_batch.write_effects(
            _repeat_coefficients(self.acting, self._mujoco_batch.count)
        )
        model = self._mujoco_batch.batch.get_model(0)
        data = mujoco.MjData(model)
        places = self._places
        whole = np.zeros((model.nv, model.nv))
        found = []
        poses = self.motion.afloat.pose[self.numbers]
        for x, pose in zip(self.motion.x[self.numbers], poses, strict=True):
            data.qpos[places.positions] = x
            data.qpos[self._floating.positions] = pose
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_crb(model, data)
            mujoco.mj_fullM(model, data, whole)
            found.append(whole[np.ix_(self._dofs, self._dofs)])
        return np.array(found)

    def compute_drive_reading_changes(self, effect: Effect, c: Array, read: Array) -> Array:
        """Compute the changes of drive readings (N, O) by an effect in a drive.

        Such an effect is a force at an actuator, for example that of a supply that sags. A sensor
        of the drive force shows it at once, before the motion changes.

        Args:
            effect: effect in a drive.
            c: coefficients (K, 1, 1).
            read: (N, O) readings without the effect.
        """
        motion, at, of = self.motion, self.numbers, self._drives
        # Drive forces that are read are known at the beginning of the step, so they replace the
        # midpoint forces.
        carried = motion.carried[:, at].copy()
        carried[0][:, of[of >= 0]] = read[:, of >= 0]
        inputs = {name: u[at, None] for name, u in motion.inputs.items()}
        t: Array = motion.step * at[:, None].astype(np.float64)
        x, v, stiff = motion.x[at], motion.v[at], self.get_servo_stiffness(at)
        moment = make_snapshot(self._system, t, x, v, inputs, carried, stiff)
        force = compute_drive_effect_forces(((effect, np.repeat(c, at.size, axis=1)),), moment)
        result: Array = np.where(of >= 0, force[:, of], 0.0)
        return result

    def compute_effect_force(self, effect: Effect, c: Array) -> Array:
        """Compute the forces (S, D) of an effect in the middle of each step.

        The effect is evaluated along the unperturbed motion, at all steps at once. Dry
        friction is the force within its limit that the motion determines.

        Args:
            effect: effect with a force, a friction or a hidden state.
            c: coefficients (K, 1, 1).
        """
        own = np.repeat(c, len(self.motion.controls), axis=1)
        if isinstance(effect, HiddenStateEffect):
            state = self.integrate_hidden_state(effect, c)
            ahead = HiddenState(*(0.5 * (u[1:] + u[:-1]) for u in (state.x, state.v)))
            return effect.act(own, self.snapshot, ahead)[0]
        if isinstance(effect, Force):
            return effect.force(own, self.snapshot)
        assert isinstance(effect, Friction)
        assert effect.coordinate is not None
        limit = effect.limit(own, self.snapshot)[:, 0]
        result = np.zeros_like(self.snapshot.x)
        result[:, effect.coordinate] = self._friction_force(effect.coordinate, limit)
        return result

    def _friction_force(self, joint: int, limit: Array) -> Array:
        """Return the force that dry friction of at most `limit` (S,) adds in each step, (S,).

        It is that of MuJoCo's constraint for friction loss
        (https://mujoco.readthedocs.io/en/stable/computation/index.html, "Friction loss"). The
        constraint has the reference acceleration -b v with b = 2 / (d_max timeconst), and the
        regularisation R = A (1 - d) / d, with its impedance d and the inverse inertia A of the
        joint. With the velocity v at the beginning of a step, the acceleration a over it, and the
        acceleration A f by f itself, the force is

            f = -clip((a + b v + A f) / R, -limit, limit) = -clip(d (a + b v) / A, -limit, limit)

        So f changes its sign about 1 / b before v does: 9.5 ms with MuJoCo's defaults, and up to a
        step in the stiff form.
        """
        motion, robot = self.motion, self._mujoco_batch.robot
        dof, steps = int(self._places.velocities[joint]), len(motion.controls)
        a = np.diff(motion.v[:, joint])[:steps] / motion.step
        b, d = friction_damping(robot, dof)
        load = d * (a + b * motion.v[:steps, joint]) / float(robot.compiled.dof_invweight0[dof])
        force: Array = -np.clip(load, -limit, limit)
        return force

    def integrate_hidden_state(self, effect: Effect, c: Array) -> HiddenState:
        """Integrate an effect's hidden state (S + 1, 1) along the motion; empty if it has none."""
        if not isinstance(effect, HiddenStateEffect):
            return HiddenState(np.zeros((0, 1)), np.zeros((0, 1)))
        return integrate_state(effect, c, self.snapshot, self.motion.step)

    @cached_property
    def snapshot(self) -> RobotSnapshot:
        """The whole motion as a snapshot of S batch elements, at the middle of each step."""
        motion = self.motion
        steps = len(motion.controls)
        t: Array = motion.step * (np.arange(float(steps)) + 0.5)
        inputs = {name: u[:, None] for name, u in motion.inputs.items()}
        x = 0.5 * (motion.x[:-1] + motion.x[1:])[:steps]
        v = 0.5 * (motion.v[:-1] + motion.v[1:])[:steps]
        stiffness = self.get_servo_stiffness(np.arange(steps))
        return make_snapshot(self._system, t[:, None], x, v, inputs, motion.carried, stiffness)


def friction_damping(robot: RobotModel, dof: int) -> tuple[float, float]:
    """Return damping b (1/s) and impedance d of MuJoCo's constraint for friction loss.

    They are those of the form in which effects add friction to the robot
    (`LinearisationPoints._friction_force`).

    Args:
        robot: robot with the time step and the integrator in use.
        dof: index of the joint's velocity.
    """
    import mujoco

    model = robot.compiled
    solref, solimp = model.dof_solref[dof], model.dof_solimp[dof]
    if robot.friction_form == "stiff":
        solref, solimp = (
            get_friction_solref(float(model.opt.timestep), int(model.opt.integrator)),
            FRICTION_SOLIMP,
        )
    timeconst, ratio = (float(value) for value in solref)
    limits = np.clip(solimp[:2], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    (at_rest, largest), width = limits.tolist(), float(solimp[2])
    # Friction has no constraint violation. For a constant impedance, MuJoCo takes the mean.
    d = at_rest if width > mujoco.mjMINVAL else 0.5 * (at_rest + largest)
    if timeconst <= 0:
        return -ratio / largest, d
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE):
        timeconst = max(timeconst, 2.0 * float(model.opt.timestep))
    return 2.0 / (largest * timeconst), d


def _looked_at(motion: RobotMotion, every: int) -> tuple[Places, Places]:
    """Choose the steps at which the model is linearised, one after every `every` steps.

    The count begins again where a piecewise constant command jumps or an actuator is switched.

    Args:
        motion: the motion.
        every: regular number of steps between two points.

    Returns:
        Steps of the points (N,), and for each step the index of the point that applies (S,).
    """
    steps = len(motion.controls)
    changes = np.ones(steps, dtype=bool)
    changes[1:] = (np.diff(motion.controls, axis=0) != 0).any(axis=1)
    # A new point begins when a piecewise constant command changes. A command that changes in almost
    # every step is as smooth as the motion and needs no extra points.
    if changes.mean() > 1.0 / every:
        changes[1:] = False
    changes[1:] |= (motion.off[1:] != motion.off[:-1]).any(axis=1)
    numbers = np.arange(steps)
    begins = np.maximum.accumulate(np.where(changes, numbers, 0))
    looked = (numbers - begins) % every == 0
    return np.flatnonzero(looked), np.cumsum(looked) - 1


def _repeat_coefficients(acting: ActiveEffects, count: int) -> ActiveEffects:
    """Repeat the coefficients of model-field effects for all elements of a batch."""
    return tuple((e, np.repeat(c, count, axis=1)) for e, c in select_model_field_effects(acting))
