"""Exam of model files as people have them: three wrong numbers and a clean recording of each.

Plain MuJoCo makes the recordings. Number, place, size and motion are drawn from the seed.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from tests.exams.exam import Exam, Question, Target, UndrawableError, conditions_text
from tests.exams.planted.model_files import (
    MODELS,
    ROTOR_TORQUE,
    ROTORS,
    SYSTEMS,
)
from tests.exams.planted.planted_cases import (
    GAP,
    INVISIBLE,
    NUMBERS,
    Experiment,
    ObstructedMotionError,
    PlantedCase,
    PlantedQuestion,
    find_largest_change,
    find_size,
    position_unit,
)
from tests.exams.planted.planted_motion import (
    RATE,
    RUNS,
    SAMPLES,
    Change,
    Operator,
    Simulator,
    command_range,
    reference,
)
from tests.exams.planted.planted_robots import ROBOTS
from tests.exams.robot_files import signal_unit, write_robot_recording

QUATERNION_NOISE = 5e-4  # Standard deviation of each entry of a recorded quaternion.
MIN_GAP = 5.0  # Smallest discrepancy, in multiples of the noise.
MIN_GAP_WITH_TORQUES = 3.0  # The same if torques double the number of channels.
SWINGS = (1.0, 0.6, 0.35)  # Factors of the amplitude; the first one whose motion is free is used.
POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
# A flight without its controller is unstable, so the discrepancy does not determine the size.
FLIGHT_SHARES = 0.1, 0.3  # Sizes at a drone, as shares of the largest one.
TRIALS = 5  # Places at which a kind of number is tried.
PLACES = 3  # Wrong numbers of each model.
WHEELS = ("left_tyre", "right_tyre")
TORQUE_NOISE = 0.005  # Standard deviation of a recorded torque as a share of its RMS.
MIN_TORQUE_NOISE = 1e-3  # N m or N.


@dataclass(frozen=True)
class ModelQuestion(Question):
    """Specification of a case: model, and number of the draw; -1 is the clean recording."""

    system: str
    index: int

    @property
    def kind(self):
        return "clean" if self.index < 0 else "single"

    @property
    def name(self):
        return f"{self.system}/{'clean' if self.index < 0 else self.index}"

    effect = ""
    with_torques = False

    @property
    def numbers(self):
        """Kinds of the wrong number in the order of trial; each draw begins with another one."""
        if self.system in MODELS:
            numbers = MODELS[self.system].numbers
        else:
            is_servo = ROBOTS[self.system].drive == "servo"
            numbers = [n for n in NUMBERS if is_servo or n != "kp"]
            numbers = [n for n in numbers if (self.system, n) not in INVISIBLE]
        order = _make_generator(self.system).permutation(numbers)
        return [str(n) for n in np.roll(order, -self.index)]

    def draw(self, seed=0):
        """Draw the case; another seed gives another exam."""
        if self.system in MODELS:
            return draw_model_case(self, seed)
        number = "clean" if self.kind == "clean" else self.numbers[0]
        return PlantedQuestion(self.system, number, max(self.index, 0)).draw(seed)


def _make_generator(text):
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:4], "little"))


def questions(seed=0):
    """Return all questions."""
    return [ModelQuestion(system, index) for system in SYSTEMS for index in range(-1, PLACES)]


@dataclass(frozen=True)
class ModelCase(PlantedCase):
    """One recording of a model file of `MODELS`; `place` is empty if nothing is wrong."""

    with_torques = False  # Whether the torques of driven joints are channels.

    @cached_property
    def experiment(self):
        return ModelExperiment(self.robot, self.seed, self.swing, self.with_torques)

    def write(self, folder):
        experiment, file = self.experiment, MODELS[self.robot]
        model, inputs = experiment.model, {}
        for index in range(model.nu):
            name = f"u.{model.actuator(index).name}"
            inputs[name] = _input_unit(model, index, name)
        channels = {}
        for name, sigma in zip(experiment.channel_names, experiment.sigma.tolist(), strict=True):
            entry = name.rpartition(".")[2]
            if entry.startswith("q") and file.base == "recorded" and entry in POSE_NAMES:
                unit = "1"
            elif file.base == "recorded" and entry in POSE_NAMES:
                unit = "m"
            else:
                unit = signal_unit(name, position_unit(model.joint(name.partition(".")[2])))
            channels[name] = unit, sigma
        times, (runs, _) = np.arange(SAMPLES) / RATE, self.performance
        tables = {
            name: (name == RUNS[-1], times, runs[name].commands, values)
            for name, values in self.measured().items()
        }
        for name, text in file.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        more = {"engine": {"fix_base": True}} if file.base == "fixed" else {}
        return write_robot_recording(
            folder, "log", inputs, channels, tables, ("robot.xml", file.text), **more
        )

    def describe(self):
        return super().describe() | {"conditions": conditions_text(number=self.kind)}


def _input_unit(model, index, name):
    """Return the unit of the control of an actuator."""
    kind, target = model.actuator_trntype[index], model.actuator_trnid[index, 0]
    is_motor = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
    if kind == mujoco.mjtTrn.mjTRN_SITE:
        return "N"
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        return "rad"
    unit = position_unit(model.joint(target))
    if not is_motor and model.actuator_biasprm[index, 1] == 0:
        return f"{unit}/s"
    return signal_unit(name, unit, is_motor)


class ModelExperiment(Experiment):
    """A model file of `MODELS`, its motions and its sensors, without a change.

    Args:
        name: name of the model.
        seed: seed of the motion.
        swing: factor of the amplitude.
        with_torques: whether the torques of driven joints are channels.
    """

    def __init__(self, name, seed, swing=1.0, with_torques=False):
        self.robot, self.force_limits, self.with_velocities = MODELS[name], {}, False
        self.with_torques = with_torques
        model = self.model = self.robot.compile()
        self.pose = self.robot.about(model)
        self.is_flight = self.robot.drive == "rotors"
        self.operator = _Drives(model, self.robot, self.pose)
        rng = np.random.default_rng([seed, 0])
        amplitude = np.broadcast_to(self.robot.swing, model.nu) * swing
        self.references = {
            run: self.operator.centre + amplitude * reference(form, model.nu, rng)
            for run, form in zip(RUNS, ("multisine", "steps", "both"), strict=True)
        }
        is_hinge = np.isin(
            model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        )
        joints = [model.joint(j).name for j in np.flatnonzero(is_hinge)]
        self.places = joints
        self.joints = [name for name in joints if name not in self.robot.unmeasured]
        self.bodies = [b for b in range(1, model.nbody) if model.body_weldid[b]]
        self.channel_names = [f"q.{joint}" for joint in self.joints]
        self.columns = [int(model.joint(joint).qposadr[0]) for joint in self.joints]
        self.sigma = np.full(len(joints), self.robot.noise)[: len(self.joints)]
        if self.robot.base == "recorded":
            self.channel_names = [f"q.base.{entry}" for entry in POSE_NAMES] + self.channel_names
            self.columns = [*range(7), *self.columns]
            pose = np.repeat([self.robot.noise, QUATERNION_NOISE], [3, 4])
            self.sigma = np.concatenate([pose, self.sigma])
        if with_torques:
            self._add_torques()

    def _add_torques(self):
        """Add the torques of the joints with a drive to the channels."""
        model = self.model
        joints = [model.joint(j) for j in np.unique(model.actuator_trnid[:, 0])]
        columns = [model.nq + model.nv + int(joint.dofadr[0]) for joint in joints]
        self.channel_names += [f"tau.{joint.name}" for joint in joints]
        self.columns += columns
        _, states = self.performed(None)
        torques = np.concatenate([states[run][:, columns] for run in RUNS])
        noise = np.maximum(TORQUE_NOISE * np.sqrt(np.mean(torques**2, axis=0)), MIN_TORQUE_NOISE)
        rounded = [float(f"{sigma:.3g}") for sigma in noise]
        self.sigma = np.concatenate([self.sigma, rounded])

    def simulator(self, change=None):
        model = self.robot.compile()
        if change is not None:
            change.apply(model)
        simulator = Simulator(model, [] if self.robot.is_touching else self.bodies)
        simulator.records_torques = self.with_torques
        return simulator


class _Drives(Operator):
    """Makes the robot follow reference commands."""

    def __init__(self, model, robot, pose):
        self.drive_kind = robot.drive
        if robot.drive == "motor":
            super().__init__(model, False, pose)
            self.centre = pose[self.positions]
        else:
            data = mujoco.MjData(model)
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            is_position = model.actuator_biasprm[:, 1] != 0
            self.centre = np.where(is_position, data.actuator_length, 0.0)
        for name, value in robot.centre.items():
            self.centre[model.actuator(name).id] = value
        self.dofs = np.arange(model.nv)
        self.range = command_range(model)
        self.driven = model.jnt_dofadr[model.actuator_trnid[:, 0]] if robot.drive == "motor" else []
        if robot.drive == "rotors":
            self.flight = _FlightController(model)

    def command(self, data, wanted):
        """Return controls (nu,) for the wanted positions or commands."""
        if self.drive_kind == "rotors":
            command = self.flight.command(data, wanted)
        elif self.drive_kind == "motor":
            error = wanted - data.qpos[self.positions]
            command = (self.kp * error - self.kv * data.qvel[self.driven]) / self.gear
        else:
            command = wanted
        return np.array([float(f"{value:.9g}") for value in np.clip(command, *self.range)])


class _FlightController:
    """Flight controller that follows x, y, z and yaw near hovering."""

    def __init__(self, model):
        self.mass, self.inertia = float(model.body_mass[1]), model.body_inertia[1].copy()
        places = np.array(list(ROTORS.values()))
        rows = np.ones(4), places[:, 1], -places[:, 0], ROTOR_TORQUE * places[:, 2]
        self.thrusts = np.linalg.inv(np.array(rows))

    def command(self, data, wanted):
        """Return thrusts (4,), N, for a wanted x, y, z (m) and yaw (rad)."""
        w, x, y, z = data.qpos[3:7]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        a = 6.0 * (wanted[:3] + np.array([0, 0, 1]) - data.qpos[:3]) - 4.5 * data.qvel[:3]
        thrust = self.mass * (9.81 + a[2]) / max(np.cos(pitch) * np.cos(roll), 0.5)
        c, s = np.cos(yaw), np.sin(yaw)
        goal = np.clip([(a[0] * s - a[1] * c) / 9.81, (a[0] * c + a[1] * s) / 9.81], -0.5, 0.5)
        rates = np.array([20.0, 20.0, 6.0]) * data.qvel[3:6]
        angles = [150 * (goal[0] - roll), 150 * (goal[1] - pitch), 20 * (wanted[3] - yaw)]
        return self.thrusts @ np.array([thrust, *(self.inertia * (angles - rates))])


def draw_model_case(question, seed):
    """Return the case of a question about a model of `MODELS`.

    Raises:
        UndrawableError: if the motion is obstructed, or no place shows the change.
    """
    name = f"models/{question.name}/{seed}"
    rng = _make_generator(name)
    motion = int(rng.integers(2**31))
    min_gap = MIN_GAP_WITH_TORQUES if question.with_torques else MIN_GAP
    wanted = float(np.exp(rng.uniform(*np.log([1.2 * min_gap, GAP[1]]))))
    noise = MODELS[question.system].noise

    def make(swing, number, place, size, gap, plain):
        return ModelCase(
            question.system, number, question.index, place, size, gap, plain, noise, False, {},
            swing, motion,
        )  # fmt: skip

    for swing in SWINGS:
        try:
            experiment = ModelExperiment(question.system, motion, swing, question.with_torques)
            experiment.performed(None)
        except ObstructedMotionError:
            continue
        if question.kind == "clean":
            return make(swing, "clean", "", 0.0, 0.0, 0.0)
        for number in question.numbers:
            for place in rng.permutation(list_places(experiment, number))[:TRIALS]:
                for sign in rng.permutation([1.0, -1.0]):
                    peaks = experiment.nominal_peaks.max(0)
                    largest = find_largest_change(experiment, number, str(place), sign, peaks)
                    if experiment.is_flight:
                        share = rng.uniform(*FLIGHT_SHARES)
                        size = float(f"{sign * largest * share:.3g}")
                        sized = (size, *experiment.gaps(Change(number, str(place), size)))
                        sized = sized if size and sized[1] > min_gap else None
                    else:
                        sized = find_size(
                            experiment, number, str(place), sign * largest, wanted, min_gap
                        )
                    if sized is not None:
                        return make(swing, number, str(place), *sized)
    raise UndrawableError(f"{question.name}: no place shows a gap of {min_gap:g} noises")


def list_places(experiment, number):
    """Return the joints, bodies, actuators, geoms or contacts that may have the wrong number."""
    model = experiment.model
    if number in ("kp", "gear"):
        return [model.actuator(i).name for i in range(model.nu)]
    if number == "friction":
        rounded = [g for g in range(1, model.ngeom) if model.geom_contype[g]]
        return [f"floor/{model.geom(g).name}" for g in rounded if model.geom_condim[g] > 1]
    if number in ("mass", "com", "payload", "length", "gravcomp"):
        return [model.body(b).name for b in experiment.bodies if model.body_mass[b] > 0]
    if number == "radius":
        return [model.geom(g).name for g in range(model.ngeom) if model.geom(g).name in WHEELS]
    return experiment.places


EXAM = Exam(
    "Model files as people have them",
    "Hands, grippers with loops and tendons, quadrupeds, humanoids, a biped with rods, a "
    "quadrotor, wheels and arms. One number of the file is wrong, or none; plain MuJoCo makes the "
    "recording.",
    questions,
    (
        Target("cause and place, alone or in a set of equals", "single", "fair", 0.85),
        Target("a clean recording: adequate", "clean", "strict", 1.0),
    ),
    groups=("system", "number"), needs_command=True,
)  # fmt: skip
