"""Cases with one changed number in a model file of an installed package.

Plain MuJoCo makes the recording. A case is a robot, a kind of number and a seed. Place, size,
motion and noise are drawn from the seed. The size is scaled so that the model discrepancy is 3 to
30 times the noise.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from bench.diagnosis_benchmark.case_generation.strength_search import (
    compute_orthonormal_basis,
    find_strength_for_size,
)
from sims.core.root_mean_square import compute_rms
from tests.exams.exam import (
    Case,
    Exam,
    Question,
    Target,
    UndrawableError,
    conditions_text,
    hidden_text,
    number,
)
from tests.exams.marking import HiddenCause, Standard, mark_answer
from tests.exams.planted.equivalent_causes import held_out_ratios
from tests.exams.planted.planted_motion import (
    EFFECTS,
    HELD_OUT,
    RATE,
    RUNS,
    SAMPLES,
    Change,
    Operator,
    Run,
    Simulator,
    mass_matrix,
    reference,
)
from tests.exams.planted.planted_robots import ROBOTS
from tests.exams.robot_files import signal_unit, write_robot_recording

# Masses of the links are small compared with the armature of the joints.
INVISIBLE = {("reacher", "mass")}
NUMBERS = ("damping", "frictionloss", "mass", "kp", "armature")  # Kinds of the changed number.
DRAWS = 3  # Cases for each robot and kind.
GAP = (3.0, 30.0)  # Smallest and largest discrepancy, in multiples of the noise.
POSITION_NOISE = (1e-4, 2e-4, 3e-4)  # Standard deviations of positions to draw from, rad or m.
VELOCITY_NOISE = 2e-3  # Standard deviation of velocities, rad/s or m/s.
VELOCITY_SHARE = 0.3  # Fraction of cases with velocity channels.
SATURATED_SHARE = 0.5  # Fraction of servo cases with force limits that are reached in some runs.
FORMS = ("multisine", "steps", "both")  # Motion of the runs r1, r2, r3.
STATE_STEP = 1e-5  # Finite-difference step of an initial state, rad, m, rad/s or m/s.
# Maximum growth of a deviation of the initial positions; above it, the motion is chaotic.
MAX_GROWTH = 4.0
MAX_SERVO_STEP = 1.0  # Maximum of kv * timestep / inertia for a servo with a force limit.
STANDARD = Standard(max_set=4, largest_fair_set=4, number_counts=True)
GAP_TOLERANCE = 0.15  # Accepted relative difference between the wanted and the reached discrepancy.

# Largest change of each kind. Armature and damping are relative to the inertia M that the joint
# moves, the damping at a servo also to the servo's kv, friction to the torque of the motion.
MAX_MASS = 2.0  # Relative increase.
MAX_DECREASE = 0.7  # Relative decrease of mass, kp, damping, friction or armature in the file.
MAX_KP = 1.0  # Relative increase.
MAX_ARMATURE = 3.0  # Multiples of M.
MAX_DAMPING = 100.0  # Multiples of M per second, and multiples of kv for servos.
MAX_PAYLOAD = 1.0  # Multiple of the mass of the body.
# Gear (relative), centre of mass (m), zero of a joint (rad or m), friction coefficient, length and
# radius (relative), tilt of an axis (rad).
MAX_DIFFERENCES = {
    "gear": 0.3, "com": 0.05, "zero": 0.09, "friction": 0.5, "length": 0.2, "radius": 0.1,
    "axis": 0.3,
}  # fmt: skip
MAX_FRICTION = 0.8  # Multiple of the largest torque at the joint.


@dataclass(frozen=True)
class PlantedQuestion(Question):
    """Specification of a case: robot, kind of the changed number, and number of the draw."""

    system: str
    number: str  # A key of `EFFECTS`, or "clean".
    index: int

    @property
    def kind(self):
        return "clean" if self.number == "clean" else "single"

    @property
    def name(self):
        return f"{self.system}/{self.number}/{self.index}"

    @property
    def effect(self):
        return EFFECTS.get(self.number, "")

    def draw(self, seed=0):
        """Draw the case; another seed gives another exam."""
        return draw_planted_case(self, f"{self.name}/{seed}" if seed else self.name)


def questions(seed=0):
    """Return all questions."""
    return [
        PlantedQuestion(robot.name, number, draw)
        for robot in ROBOTS.values()
        for number in NUMBERS
        for draw in range(DRAWS)
        if (robot.drive == "servo" or number != "kp") and (robot.name, number) not in INVISIBLE
    ]


@dataclass(frozen=True)
class PlantedCase(Case):
    """One recording with a planted cause.

    Attributes:
        robot: name of the robot.
        kind: kind of the changed number.
        draw: number of the draw.
        place: joint, body, actuator or contact; empty if nothing is wrong.
        size: see `Change`.
        gap: RMS discrepancy over all samples and channels with fitted initial states, in multiples
            of the noise.
        plain_gap: RMS discrepancy without fitted initial states, in multiples of the noise.
        noise: standard deviation of positions, rad or m.
        with_velocities: whether velocities are channels.
        force_limits: by joint, N m or N.
        swing: factor of the robot's amplitude.
        seed: seed of motion and noise.
    """

    robot: str
    kind: str
    draw: int
    place: str
    size: float
    gap: float
    plain_gap: float
    noise: float
    with_velocities: bool
    force_limits: dict[str, float]
    swing: float
    seed: int

    @property
    def change(self):
        """The wrong number; None for a clean recording."""
        return Change(self.kind, self.place, self.size) if self.place else None

    @property
    def hidden_effects(self):
        """Coefficients by effect@place."""
        return {self.change.effect: (self.size,)} if self.place else {}

    @cached_property
    def experiment(self):
        return Experiment(
            self.robot, self.seed, self.noise, self.with_velocities, self.swing, self.force_limits
        )

    @cached_property
    def performance(self):
        """Runs of the experiment on the changed robot: (runs, states) by name of the run."""
        return self.experiment.performed(self.change)

    def measured(self):
        """Return channels (SAMPLES, C) with noise, by name of the run."""
        _, states = self.performance
        rng = np.random.default_rng([self.seed, 1])
        experiment = self.experiment
        return {
            name: (values := experiment.channels(states[name]))
            + experiment.sigma * rng.standard_normal(values.shape)
            for name in RUNS
        }

    def write(self, folder):
        robot, experiment, model = ROBOTS[self.robot], self.experiment, self.experiment.model
        inputs, actuators = {}, {}
        for index in range(model.nu):
            joint, name = model.joint(model.actuator_trnid[index, 0]), model.actuator(index).name
            inputs[f"u.{name}"] = signal_unit("u", position_unit(joint), robot.drive == "motor")
            actuators[name] = robot.drive_of(joint.name, self.force_limits).description
        channels = {
            name: (signal_unit(name, position_unit(model.joint(name.partition(".")[2]))), sigma)
            for name, sigma in zip(experiment.channel_names, experiment.sigma.tolist(), strict=True)
        }
        times, (runs, _) = np.arange(SAMPLES) / RATE, self.performance
        tables = {
            name: (name == HELD_OUT, times, runs[name].commands, values)
            for name, values in self.measured().items()
        }
        timestep, integrator = robot.engine or (None, None)
        more = {"engine": {"timestep": timestep, "integrator": integrator}, "actuators": actuators}
        return write_robot_recording(
            folder, "log", inputs, channels, tables,
            (robot.model_name, robot.model_text(self.force_limits)),
            **(more if robot.is_urdf else {}),
        )  # fmt: skip

    def describe(self):
        conditions = conditions_text(
            number=self.kind, limited=bool(self.force_limits), sigma=self.noise,
            velocities=self.with_velocities,
        )  # fmt: skip
        hidden, size = hidden_text(self.hidden_effects), number(self.gap) if self.place else ""
        return {"hidden": hidden, "size": size, "noise": "white", "conditions": conditions}

    def mark(self, outcome):
        kind = "single" if self.place else "clean"
        hidden_cause = HiddenCause(kind, self.hidden_effects)
        return mark_answer(hidden_cause, outcome.verdict, STANDARD, self._held_out_ratios)

    def _held_out_ratios(self, sets):
        names = [name for names in sets for name in names if name != self.change.effect]
        return held_out_ratios(self, names)


def position_unit(joint):
    """Return the unit of the position of a joint of a compiled model."""
    return "m" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "rad"


class Experiment:
    """A robot, its motions and its sensors, without a change.

    Args:
        robot: name of the robot.
        seed: seed of the motion.
        noise: standard deviation of positions.
        with_velocities: whether velocities are channels.
        swing: factor of the robot's amplitude.
        force_limits: force limits of servos, by joint.
    """

    def __init__(self, robot, seed, noise, with_velocities, swing=1.0, force_limits=None):
        self.robot, self.force_limits = ROBOTS[robot], force_limits or {}
        self.model = self.robot.compile(self.force_limits)
        self.pose = self.robot.about(self.model)
        self.operator = Operator(self.model, self.robot.drive == "servo", self.pose)
        rng = np.random.default_rng([seed, 0])
        amplitudes = self._amplitudes() * swing
        self.references = {
            name: self.pose[self.operator.positions]
            + amplitudes * (rng.uniform(-0.3, 0.3, self.model.nu) + 0.7 * wave)
            for name, form in zip(RUNS, FORMS, strict=True)
            for wave in [reference(form, self.model.nu, rng)]
        }
        self.bodies = [b for b in range(self.model.nbody) if self._is_carried(b)]
        joints = [j for j in range(self.model.njnt) if self.model.jnt_bodyid[j] in self.bodies]
        self.joints = [self.model.joint(j).name for j in joints]
        self.places = self.joints
        self.columns = list(self.model.jnt_qposadr[joints])
        self.channel_names = [f"q.{joint}" for joint in self.joints]
        self.sigma = np.full(len(joints), noise)
        if with_velocities:
            self.channel_names += [f"qd.{joint}" for joint in self.joints]
            self.columns += [self.model.nq + d for d in self.model.jnt_dofadr[joints]]
            self.sigma = np.append(self.sigma, np.full(len(joints), VELOCITY_NOISE))
        self.with_velocities = with_velocities

    def _is_carried(self, body):
        """Return whether a driven joint carries the body; targets and objects have none."""
        driven = self.model.jnt_bodyid[self.model.actuator_trnid[:, 0]]
        while body and body not in driven:
            body = self.model.body_parentid[body]
        return bool(body)

    def _amplitudes(self):
        """Return amplitudes (nu,) that stay inside the joints' ranges."""
        joints = self.model.actuator_trnid[:, 0]
        limited = self.model.jnt_limited[joints].astype(bool)
        room = np.abs(self.model.jnt_range[joints] - self.pose[self.operator.positions, None])
        return np.where(limited, np.minimum(self.robot.swing, 0.6 * room.min(1)), self.robot.swing)

    def simulator(self, change=None):
        model = self.robot.compile(self.force_limits)
        if change is not None:
            change.apply(model)
        return Simulator(model, self.bodies)

    def channels(self, states):
        return states[:, self.columns]

    def performed(self, change):
        """Simulate the runs on the changed robot: ({name: Run}, {name: states}).

        Raises:
            ObstructedMotionError: if a contact or a joint limit is active.
        """
        simulator = self.simulator(change)
        runs, states = {}, {}
        for name, references in self.references.items():
            runs[name] = self.operator.drive(simulator, self.pose, references)
            states[name] = simulator.simulate(runs[name])
            if simulator.touches or not np.isfinite(states[name]).all():
                raise ObstructedMotionError(name)
        return runs, states

    def difference(self, change):
        """Return the error of the unchanged model in units of the noise, (SAMPLES, C) by run."""
        runs, states = self.performed(change)
        simulator = self.simulator()
        return {
            name: self.channels(states[name] - simulator.simulate(runs[name])) / self.sigma
            for name in RUNS
        }

    @cached_property
    def state_responses(self):
        """Derivatives (SAMPLES, C, nq + nv) of the channels by the initial state, for each run."""
        runs, _ = self.performed(None)
        simulator = self.simulator()
        responses = {}
        for name, run in runs.items():
            base = simulator.simulate(run)
            columns = []
            for index in range(self.model.nq + self.model.nv):
                begin = np.concatenate([run.positions, run.velocities])
                begin[index] += STATE_STEP
                moved = Run(run.commands, begin[: self.model.nq], begin[self.model.nq :])
                columns.append(self.channels(simulator.simulate(moved) - base) / STATE_STEP)
            responses[name] = np.stack(columns, axis=-1)
        return responses

    def growth(self, change=None):
        """Return the growth of a deviation of the initial positions.

        The initial positions deviate by 1e-4 rad. Later deviations (root mean square after the
        first tenth of a second) are counted in units of 1e-4 rad and, for velocities, 2e-3 rad/s.
        """
        runs, states = self.performed(change)
        simulator, largest = self.simulator(change), 0.0
        units = np.repeat([1e-4, 2e-3], [self.model.nq, self.model.nv])
        deviation = 1e-4 * np.random.default_rng(0).standard_normal(self.model.nq)
        for name, run in runs.items():
            moved = simulator.simulate(Run(run.commands, run.positions + deviation, run.velocities))
            later = (moved - states[name])[RATE // 10 :] / units
            largest = max(largest, np.sqrt(np.mean(later**2, axis=0)).max())
        return float(largest)

    @cached_property
    def state_bases(self):
        """Orthonormal columns (SAMPLES * C, nq + nv) by run: responses to initial states."""
        bases = {}
        for name, response in self.state_responses.items():
            matrix = (response / self.sigma[:, None]).reshape(-1, response.shape[-1])
            bases[name] = compute_orthonormal_basis(matrix)
        return bases

    def gaps(self, change):
        """Return (gap with fitted initial states, gap without), in multiples of the noise."""
        plain, fitted = [], []
        for name, values in self.difference(change).items():
            flat, basis = values.ravel(), self.state_bases[name]
            plain.append(flat)
            fitted.append(flat - basis @ (basis.T @ flat))
        return compute_rms(np.concatenate(fitted)), compute_rms(np.concatenate(plain))

    @cached_property
    def nominal_peaks(self):
        """Largest torque at each of `Operator.dofs` of the unchanged model by run, (runs, D)."""
        runs, _ = self.performed(None)
        simulator, rows = self.simulator(), []
        for run in runs.values():
            simulator.start(run.positions, run.velocities)
            row = np.zeros(len(self.operator.dofs))
            for command in run.commands[:-1]:
                simulator.advance(command)
                row = np.maximum(row, np.abs(simulator.data.qfrc_actuator[self.operator.dofs]))
            rows.append(row)
        return np.array(rows)

    @cached_property
    def nominal_inertia(self):
        """Diagonal (nv,) of the mass matrix at the pose, kg m^2 or kg."""
        return np.diag(mass_matrix(self.model, self.pose))


class ObstructedMotionError(Exception):
    """A contact or a joint limit was active in a run, or the motion diverged."""


def draw_planted_case(question, name):
    """Draw the case of a question from the seed that is the hash of a name.

    Raises:
        UndrawableError: if no place shows the change.
    """
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")
    rng = np.random.default_rng(seed)
    noise = float(rng.choice(POSITION_NOISE))
    with_velocities = bool(rng.random() < VELOCITY_SHARE)
    wanted = float(np.exp(rng.uniform(*np.log(GAP))))
    experiment, swing = _find_simple_experiment(question.system, seed, noise, with_velocities)
    limits = {}
    peaks = experiment.nominal_peaks
    if experiment.robot.drive == "servo" and rng.random() < SATURATED_SHARE:
        limits = _force_limits(experiment, peaks)
        limited = Experiment(question.system, seed, noise, with_velocities, swing, limits)
        if _is_simple(limited):
            experiment = limited
        else:  # The limited servos chatter or the robot falls.
            limits = {}
    if question.kind == "clean":
        return PlantedCase(
            question.system, question.number, question.index, "", 0.0, 0.0, 0.0, noise,
            with_velocities, limits, swing, seed,
        )  # fmt: skip
    for place in rng.permutation(_places(experiment, question.number)):
        signs = rng.permutation([1.0, -1.0])
        for sign in signs:
            largest = find_largest_change(
                experiment, question.number, str(place), sign, peaks.max(0)
            )
            sized = find_size(experiment, question.number, str(place), sign * largest, wanted)
            if sized is not None:
                size, gap, plain = sized
                if not _is_simple(experiment, Change(question.number, str(place), size)):
                    continue
                return PlantedCase(
                    question.system, question.number, question.index, str(place), size, gap, plain,
                    noise, with_velocities, limits, swing, seed,
                )  # fmt: skip
    raise UndrawableError(f"{question.name}: no place shows a gap of {GAP[0]:g} noises")


def _find_simple_experiment(robot, seed, noise, with_velocities):
    """Return the experiment with the largest amplitude whose motion is simple."""
    for swing in (1.0, 0.7, 0.5, 0.35):
        experiment = Experiment(robot, seed, noise, with_velocities, swing)
        if _is_simple(experiment):
            return experiment, swing
    raise UndrawableError(f"{robot}: every motion meets a contact or a joint limit, or is chaotic")


def _is_simple(experiment, change=None):
    """Return whether the motion is free of contacts and joint limits, and is not chaotic."""
    try:
        return experiment.growth(change) <= MAX_GROWTH
    except ObstructedMotionError:
        return False


def _force_limits(experiment, peaks):
    """Return limits (N m or N, by joint) that only the faster runs reach.

    A servo at its limit chatters from step to step if kv * timestep / inertia is large, so joints
    with little inertia have no limit.
    """
    model = experiment.model
    dofs, joints = experiment.operator.dofs, model.actuator_trnid[:, 0]
    stiffness = experiment.robot.gains[1] * model.opt.timestep / experiment.nominal_inertia[dofs]
    limits = 1.05 * peaks.min(0) + 0.3 * (peaks.max(0) - peaks.min(0))
    return {
        model.joint(joint).name: float(f"{limit:.3g}")
        for joint, limit, factor in zip(joints, limits, stiffness, strict=True)
        if factor < MAX_SERVO_STEP
    }


def _places(experiment, kind):
    """Return the joints, bodies or actuators that the motion affects."""
    model = experiment.model
    if kind == "kp":
        return [model.actuator(i).name for i in range(model.nu)]
    if kind == "mass":
        return [model.body(b).name for b in experiment.bodies if model.body_mass[b] > 0]
    return experiment.joints


def find_largest_change(experiment, kind, place, sign, torques):
    """Return the size of the largest plausible change of this sign; 0 if there is none.

    Args:
        experiment: `Experiment`.
        kind: kind of the number.
        place: joint, body, actuator or contact.
        sign: 1 or -1.
        torques: largest force at each degree of freedom of `Operator.dofs`, N m or N.
    """
    model, operator = experiment.model, experiment.operator
    if kind == "mass":
        return MAX_MASS if sign > 0 else MAX_DECREASE
    if kind == "kp":
        return MAX_KP if sign > 0 else MAX_DECREASE
    if kind == "payload":  # A payload has no negative mass.
        return MAX_PAYLOAD * model.body(place).mass[0] if sign > 0 else 0.0
    if kind == "gravcomp":
        return 1.0 if sign > 0 else 0.0
    if kind in MAX_DIFFERENCES:
        return MAX_DIFFERENCES[kind]
    dof = model.joint(place).dofadr[0]
    stated = {
        "damping": model.dof_damping,
        "frictionloss": model.dof_frictionloss,
        "armature": model.dof_armature,
    }[kind][dof]
    if sign < 0:
        return MAX_DECREASE * stated
    inertia = experiment.nominal_inertia[dof]
    driven = {d: i for i, d in enumerate(operator.dofs)}
    if kind == "armature":
        return MAX_ARMATURE * inertia
    if kind == "damping":
        stiff = experiment.robot.gains[1] if experiment.robot.drive == "servo" else 0.0
        return MAX_DAMPING * inertia + stiff
    torque = torques[driven[dof]] if dof in driven else torques.max()
    return MAX_FRICTION * torque


def find_size(experiment, kind, place, largest, wanted, min_gap=GAP[0]):
    """Return (size, gap, plain gap) near the wanted gap; None if the place cannot show one.

    Args:
        experiment: `Experiment`.
        kind: kind of the number.
        place: joint, body, actuator or contact.
        largest: largest size, with its sign.
        wanted: discrepancy in multiples of the noise.
        min_gap: smallest discrepancy.
    """

    def gaps(share):
        size = float(f"{share * largest:.3g}")
        try:
            return size, *experiment.gaps(Change(kind, place, size))
        except ObstructedMotionError:
            return size, np.inf, np.inf

    # If the largest change shows less than wanted, the smallest visible size is tried.
    for target in (wanted, 1.2 * min_gap) if largest else ():
        found = find_strength_for_size(
            lambda share: gaps(share)[1], target, 1.0, 0.1, np.inf, GAP_TOLERANCE
        )
        if found is not None:
            return gaps(found[0])
    return None


EXAM = Exam(
    "Causes planted in model files of installed packages",
    "One number of a robot's model file is changed at a random place, plain MuJoCo makes the "
    "recording, and the command explains it with the unchanged file.",
    questions,
    (
        Target("the planted cause alone, its number right", "single", "strict"),
        Target("the same, or in a set of at most 4 whose others do as well", "single", "fair", 0.9),
    ),
    groups=("system", "number", "limited"), needs_command=True,
)  # fmt: skip
