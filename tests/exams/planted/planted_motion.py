"""Commands, and the motion that ``mujoco.mj_step`` alone makes from them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

RATE = 100  # Samples per second.
SECONDS = 3.0  # Duration of a run, s.
SAMPLES = round(RATE * SECONDS) + 1
RUNS = ("r1", "r2", "r3")
HELD_OUT = "r3"
SETTLE_SAMPLES = 300  # Samples before a run, in which the robot comes to rest.

BANDWIDTH = 2 * np.pi * 3.0  # Bandwidth of the position loop that computes motor torques, rad/s.
DAMPING_RATIO = 0.7  # Damping ratio of this position loop.


@dataclass(frozen=True)
class Change:
    """One number of a model that differs from its file.

    Attributes:
        kind: a key of `EFFECTS`.
        place: joint, body, actuator, geom or contact (GEOM/GEOM).
        size: for mass, kp, gear, length and radius a relative change; the mass of a payload, kg;
            the angle of a tilted axis, rad; otherwise the difference of the number.
    """

    kind: str
    place: str
    size: float

    @property
    def effect(self):
        """The change in simgap's notation, `effect@place`."""
        return f"{EFFECTS[self.kind]}@{self.place}"

    def apply(self, model):
        """Write the change into a compiled model, as a changed file would compile."""
        if self.kind in DOF_FIELDS:
            field = getattr(model, DOF_FIELDS[self.kind])
            field[model.joint(self.place).dofadr[0]] += self.size
        elif self.kind == "mass":
            body = model.body(self.place).id
            model.body_mass[body] *= 1 + self.size
            model.body_inertia[body] *= 1 + self.size
        elif self.kind == "payload":
            body = model.body(self.place).id  # As far behind the centre as that from the frame.
            add_point_mass(model, body, self.size, 2 * model.body_ipos[body])
        elif self.kind == "com":
            model.body_ipos[model.body(self.place).id, 0] += self.size
        elif self.kind == "zero":
            model.qpos0[model.joint(self.place).qposadr[0]] += self.size
        elif self.kind == "friction":
            model.geom(self.place.partition("/")[2]).friction[0] += self.size
        elif self.kind == "length":
            model.body_pos[model.body(self.place).id] *= 1 + self.size
        elif self.kind == "axis":
            # Tilt about the axis of the body's frame that is most across.
            rotation = np.zeros(3)
            rotation[np.argmin(np.abs(model.joint(self.place).axis))] = self.size
            turn_axis(model, self.place, rotation)
        elif self.kind == "gravcomp":
            model.body_gravcomp[model.body(self.place).id] += self.size
        elif self.kind == "radius":
            model.geom(self.place).size[0] *= 1 + self.size
        else:
            actuator = model.actuator(self.place).id
            model.actuator_gainprm[actuator, 0] *= 1 + self.size
            if self.kind == "kp":
                model.actuator_biasprm[actuator, 1] *= 1 + self.size
        if self.kind != "zero":  # Otherwise the bodies' places would follow qpos0.
            mujoco.mj_setConst(model, mujoco.MjData(model))


def turn_axis(model, joint, rotation):
    """Turn the axis of a joint by a rotation vector (3,), rad, in the frame of its body."""
    angle, turned = np.linalg.norm(rotation), np.zeros(3)
    turn = np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, rotation / max(angle, 1e-12), angle)
    axis = model.joint(joint).axis
    mujoco.mju_rotVecQuat(turned, axis.copy(), turn)
    axis[:] = turned


def add_point_mass(model, body, mass, place):
    """Add a point mass to a body of a compiled model.

    Args:
        model: compiled model.
        body: number of the body.
        mass: mass, kg.
        place: position (3,) in the frame of the body, m.
    """
    offset, total = place - model.body_ipos[body], model.body_mass[body] + mass
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    turn = turn.reshape(3, 3)
    tensor = turn @ np.diag(model.body_inertia[body]) @ turn.T
    reduced = model.body_mass[body] * mass / total
    tensor += reduced * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    values, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_inertia[body] = total, values
    model.body_ipos[body] += offset * mass / total
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())


EFFECTS = {
    "damping": "drag.linear",
    "frictionloss": "friction.coulomb",
    "mass": "mass.scale",
    "kp": "actuator.stiffness",
    "armature": "inertia.armature",
    "gear": "input.gain",
    "com": "mass.offset",
    "zero": "joint.zero",
    "payload": "payload",
    "friction": "contact.friction",
    "length": "link.length",
    "axis": "joint.axis",
    "gravcomp": "gravity.compensation",
    "radius": "geom.radius",
}
DOF_FIELDS = {
    "damping": "dof_damping",
    "frictionloss": "dof_frictionloss",
    "armature": "dof_armature",
}


@dataclass(frozen=True)
class Run:
    """Commands and initial state of a run.

    Attributes:
        commands: controls (SAMPLES, nu), held from one sample to the next.
        positions: initial qpos (nq,).
        velocities: initial qvel (nv,).
    """

    commands: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray


def reference(kind, count, rng):
    """Return reference positions (SAMPLES, count) between about -1 and 1 that start at 0.

    Args:
        kind: "multisine", "steps" (smooth ones) or "both".
        count: number of joints.
        rng: random generator for phases, frequencies and targets.
    """
    times = np.arange(SAMPLES) / RATE
    columns = []
    for _ in range(count):
        column = np.zeros(SAMPLES)
        if kind in ("multisine", "both"):
            frequencies = rng.uniform((0.3, 0.7, 1.3), (0.7, 1.3, 2.5))
            phases = rng.uniform(0, 2 * np.pi, 3)
            waves = np.sin(2 * np.pi * np.outer(times, frequencies) + phases)
            column += (waves * (0.5, 0.35, 0.2)).sum(1) * (1 - np.exp(-times / 0.25))
        if kind in ("steps", "both"):
            column += _smooth_steps(times, rng) * (0.5 if kind == "both" else 1.0)
        columns.append(column)
    return np.stack(columns, axis=1)


def _smooth_steps(times, rng):
    """Return minimum-jerk movements between random targets."""
    column, begin, level = np.zeros(times.size), rng.uniform(0.1, 0.3), 0.0
    while begin < times[-1]:
        target, duration = rng.uniform(-1, 1), rng.uniform(0.15, 0.4)
        phase = np.clip((times - begin) / duration, 0, 1)
        # Minimum-jerk polynomial (Flash & Hogan 1985).
        blend = phase**3 * (10 - 15 * phase + 6 * phase**2)
        column += (target - level) * blend
        begin, level = begin + duration + rng.uniform(0.1, 0.4), target
    return column


class Simulator:
    """A compiled model that is simulated with plain MuJoCo.

    Args:
        model: compiled model.
        watched: bodies whose contacts and joint limits set `touches`.
    """

    def __init__(self, model, watched):
        self.model, self.data = model, mujoco.MjData(model)
        self.geoms = np.isin(model.geom_bodyid, watched)
        self.joints = np.isin(model.jnt_bodyid, watched)
        self.steps = round(1 / RATE / model.opt.timestep)
        self.touches = False  # Whether a contact or a joint limit was active since `start`.
        self.records_torques = False  # Whether `simulate` appends the drives' torques to states.
        self.before_step = None  # Function that is called before each step, or None.
        if not np.isclose(self.steps * model.opt.timestep, 1 / RATE):
            raise ValueError(f"timestep {model.opt.timestep} s does not divide 1/{RATE} s")

    def start(self, positions, velocities):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = positions, velocities
        self.touches = False

    def settle_filters(self, command):
        """Give each filtered actuator the activation of a command (nu,) that was held for long."""
        filtered = self.model.actuator_actadr >= 0
        self.data.act[self.model.actuator_actadr[filtered]] = np.asarray(command)[filtered]

    def advance(self, command):
        """Advance by one sample with the controls held."""
        self.data.ctrl[:] = command
        if self.before_step is None:
            mujoco.mj_step(self.model, self.data, nstep=self.steps)
        else:
            for _ in range(self.steps):
                self.before_step()
                mujoco.mj_step(self.model, self.data)
        limited = self.data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
        contacts = self.data.contact.geom[: self.data.ncon]
        self.touches |= bool(self.geoms[contacts].any())
        self.touches |= bool(self.joints[self.data.efc_id[limited]].any())

    def simulate(self, run):
        """Return positions and velocities (SAMPLES, nq + nv) of a run, and the torques if recorded.

        The torques (SAMPLES, nv) are those of the drives at each joint, at the time of the sample
        and with its command.
        """
        self.start(run.positions, run.velocities)
        self.settle_filters(run.commands[0])
        states = []
        for command in run.commands:
            states.append(np.concatenate([self.data.qpos, self.data.qvel]))
            if self.records_torques:
                self.data.ctrl[:] = command
                mujoco.mj_forward(self.model, self.data)
                states[-1] = np.concatenate([states[-1], self.data.qfrc_actuator])
            if len(states) < len(run.commands):
                self.advance(command)
        return np.array(states)


class Operator:
    """Makes the robot follow reference positions.

    Servos receive the reference. Motors receive the torques of a position loop, as from a user's
    controller; the torques are part of the recording.

    Args:
        model: model with the numbers of the file, from which the gains of the loop are derived.
        is_servo: whether actuators are position servos.
        pose: qpos (nq,).
    """

    def __init__(self, model, is_servo, pose):
        self.is_servo = is_servo
        joints = model.actuator_trnid[:, 0]
        self.positions, self.dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self.gear = model.actuator_gear[:, 0].copy()
        self.range = command_range(model)
        # Use the inertia of a joint while the other joints are free. With the larger inertia of
        # locked joints the sampled loop would chatter.
        inertia = 1 / np.diag(np.linalg.inv(mass_matrix(model, pose)))[self.dofs]
        self.kp = BANDWIDTH**2 * inertia + 2 * model.jnt_stiffness[joints]
        self.kv = 2 * DAMPING_RATIO * np.sqrt(self.kp * inertia)

    def command(self, data, wanted):
        """Return controls (nu,) for the wanted positions of the driven joints."""
        if self.is_servo:
            return np.clip(wanted, *self.range)
        torque = self.kp * (wanted - data.qpos[self.positions]) - self.kv * data.qvel[self.dofs]
        command = np.clip(torque / self.gear, *self.range)
        return np.array([float(f"{value:.9g}") for value in command])  # Round as in the table.

    def drive(self, simulator, begin, references):
        """Let the robot settle at the first reference, then follow all, and return the run.

        Args:
            simulator: simulator of the changed robot.
            begin: qpos (nq,) before settling.
            references: positions of driven joints (SAMPLES, nu).
        """
        references = np.array([[float(f"{x:.9g}") for x in row] for row in references])
        simulator.start(begin, np.zeros(simulator.model.nv))
        for _ in range(SETTLE_SAMPLES):
            simulator.advance(self.command(simulator.data, references[0]))
        positions, velocities = simulator.data.qpos.copy(), simulator.data.qvel.copy()
        simulator.start(positions, velocities)
        simulator.settle_filters(self.command(simulator.data, references[0]))
        commands = []
        for wanted in references:
            commands.append(self.command(simulator.data, wanted))
            simulator.advance(commands[-1])
        return Run(np.array(commands), positions, velocities)


def command_range(model):
    """Return the lowest and the highest controls (nu,); infinite without a limit."""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


def mass_matrix(model, pose):
    """Return the mass matrix (nv, nv) at qpos."""
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return mass
