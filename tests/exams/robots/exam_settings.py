"""Recording conditions of a robot, drawn from a seed: machine, runs, channels and noise.

Robots with a floating base begin in a drawn state, and their numerics are not compared with MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bench.diagnosis_benchmark.case_generation.recording_conditions import SensorNoise
from tests.exams.robots import exam_robots, floating_robots, robot_models, robot_signals
from tests.exams.robots.exam_robots import Machine
from tests.exams.robots.reference_world import COARSE, Run, World
from tests.exams.robots.robot_signals import NOISES, Drives

RATE, SECONDS, FLOATING_SECONDS = 100, 4.0, 2.5
FITTED, HELD_OUT = 4, 2
# Largest error of MuJoCo's numerics where they are not the cause, in units of the noise.
QUIET = 0.1
# Time steps in s tried with MuJoCo's Runge-Kutta; the first one below QUIET is used.
STEPS = (0.002, 0.001, 0.0005, 0.00025)
COARSER = ((0.005, "Euler"), (0.002, "Euler"), (0.01, "implicitfast"), (0.01, "Euler"))
SPARE = 0.8  # Largest fraction of an actuator's force that a motion may use.
# Floating base: largest initial rotation rate in rad/s and velocity in m/s in each direction.
SPIN, DRIFT = 1.0, 0.5
SWING = 0.9  # Approximate largest deviation of a hinge from its initial position, rad.
LEAN = 0.5  # Largest initial rotation of a ball joint, rad; a free joint begins at any orientation.


@dataclass(frozen=True)
class Setting:
    """All conditions of a recording except the hidden cause.

    Attributes:
        machine: the robot as its file describes it.
        runs: runs for fitting, followed by the held-out runs.
        channels: names of the recorded channels.
        noise: sensor noise.
        bare: noise-free positions of every run without a hidden cause, (T, N).
        typical: scales of the bare motion by name, each (N,).
        numerics: error of MuJoCo's numerics in units of the noise.
        held_out: number of held-out runs; they are the last ones.
    """

    machine: Machine
    runs: tuple[Run, ...]
    channels: tuple[str, ...]
    noise: SensorNoise
    bare: tuple[np.ndarray, ...]
    typical: dict[str, np.ndarray]
    numerics: float
    held_out: int

    @property
    def sigma(self):
        return np.array([self.noise.sigma[name] for name in self.channels])

    @property
    def fitted(self):
        return self.runs[: len(self.runs) - self.held_out]


def setting(name, rng, coarse=False, noise=None):
    """Draw a setting of a robot.

    Args:
        name: one of `robot_models.NAMES` or `floating_robots.NAMES`.
        rng: random generator.
        coarse: whether MuJoCo's numerics are the hidden cause.
        noise: kind of noise; drawn if None.

    Raises:
        ValueError: if no tried step has a small enough numerical error or, with `coarse`, a large
            enough one.
    """
    floats = name in floating_robots.NAMES
    models, draw = (floating_robots, _floating_run) if floats else (robot_models, _run)
    machine = models.machine(name, rng)
    times = np.arange(round(RATE * (FLOATING_SECONDS if floats else SECONDS)) + 1) / RATE
    forms = [str(rng.choice(robot_signals.FORMS)) for _ in range(FITTED + HELD_OUT)]
    runs, motions = zip(*(draw(machine, form, times, rng) for form in forms), strict=True)
    sigma = float(np.exp(rng.uniform(np.log(5e-4), np.log(1e-3))))
    channels, by_channel = _channels(machine, motions, sigma, rng)
    kind = noise or str(rng.choice(NOISES))
    made = SensorNoise(by_channel, kind, float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.3, 0.6)))
    left = 0.0
    if not floats:
        machine, left = _stepped(machine, runs, motions, by_channel, coarse, rng)
    bare = tuple(motion.q for motion in motions)
    return Setting(machine, runs, channels, made, bare, _typical(machine, motions), left, HELD_OUT)


def _run(machine, form, times, rng):
    """Draw a run and return it with its motion without a hidden cause.

    Commands are scaled until the motion stays within the limits of force and range.
    """
    pose, plant = np.array(machine.pose), World(machine).plant
    hold, moved = plant.needed(pose, 0 * pose), plant.moved_inertia(pose)
    servo = machine.drives[0].kind == "position"
    waves = {d.name: robot_signals.wave(form, times, rng) for d in machine.drives}
    shares = {d.name: float(rng.uniform(0.5, 1.0)) for d in machine.drives}
    start = pose if servo else pose + rng.uniform(-0.3, 0.3, pose.size)
    travel = _compute_free_travel(machine, pose)
    wanted = float(rng.uniform(0.4, 0.8))
    scale = 1.0
    for _ in range(12):
        signals = {}
        for joint, drive in zip(machine.driven, machine.drives, strict=True):
            size = (
                scale
                * shares[drive.name]
                * (min(0.5, travel[joint]) if servo else 8 * moved[joint])
            )
            middle = pose[joint] + hold[joint] / drive.kp if servo else 0.0
            signals[drive.name] = middle + size * waves[drive.name]
        run = Run(times, signals, start, 0 * start)
        motion = World(machine, step=COARSE / 2).move(run, times)
        over = _over(machine, motion, pose, travel, None if servo else wanted)
        if over <= 1.0:
            return run, motion
        scale *= 0.9 / min(over, 4.0)
    raise ValueError(f"{machine.name}: found no command that stays within its limits")


def _floating_run(machine, form, times, rng):
    """Draw a run whose hinges move by about `SWING`, and its motion without a hidden cause."""
    hinges = len(machine.hinges)
    start = rng.uniform(-0.5, 0.5, hinges)
    pose, rate = draw_base_state(machine, rng)
    q, v = np.concatenate([start, pose]), np.concatenate([np.zeros(hinges), rate])
    world = World(machine, step=COARSE)
    moved = world.plant.moved_inertia(q)
    waves = {drive.name: robot_signals.wave(form, times, rng) for drive in machine.drives}
    sizes = {drive.name: float(rng.uniform(0.5, 1.0)) for drive in machine.drives}
    scale = 1.0
    for _ in range(8):
        signals = {}
        for joint, drive in zip(machine.driven, machine.drives, strict=True):
            size = 0.6 if drive.kp else 15.0 * moved[joint]
            about = start[joint] if drive.kp else 0.0
            signals[drive.name] = about + scale * sizes[drive.name] * size * waves[drive.name]
        run = Run(times, signals, q, v)
        motion = world.move(run, times)
        over = np.abs(motion.q[:, :hinges] - start).max() / SWING
        if over < 1.5:
            break
        scale *= 0.9 / min(over, 4.0)
    return run, motion


def draw_base_state(machine, rng):
    """Draw a pose and a padded velocity of the floating base."""
    turn = rng.uniform(-SPIN, SPIN, 3)
    if machine.root == "ball":
        lean = Rotation.from_rotvec(rng.uniform(-LEAN, LEAN, 3))
        return lean.as_quat(), np.append(turn, 0.0)
    pose = Rotation.random(random_state=int(rng.integers(2**31)))
    place = rng.uniform(-1.0, 1.0, 3) + np.array([0.0, 0.0, 3.0])
    drift = rng.uniform(-DRIFT, DRIFT, 3)
    rate = np.concatenate([pose.inv().apply(drift), turn, [0.0]])
    return np.concatenate([place, pose.as_quat()]), rate


def _compute_free_travel(machine, pose):
    """Return how far each joint may move away from its pose."""
    limits = np.array([machine.range(name) for name in machine.joints])
    return 0.8 * np.minimum(np.abs(limits[:, 0] - pose), np.abs(limits[:, 1] - pose))


def _over(machine, motion, pose, travel, wanted):
    """Return the factor by which a motion exceeds its limits."""
    far = np.abs(motion.q - pose).max(axis=0)
    if not np.isfinite(far).all():
        return 10.0
    over = float(np.max(far / (1.1 * travel)))
    for joint, drive in zip(machine.driven, machine.drives, strict=True):
        over = max(over, float(np.abs(motion.force[:, joint]).max() / (SPARE * drive.force)))
    return max(over, float(far.max() / wanted)) if wanted else over


def _channels(machine, motions, sigma, rng):
    """Draw the channels: positions, and in some settings velocities or actuator forces."""
    noise = {f"q.{joint}": sigma for joint in machine.hinges}
    if machine.floats:
        more = "qd" if rng.random() < 0.25 else ""
    else:
        more = str(rng.choice(["", "", "tau", "qd"]))
    for number, joint in enumerate(machine.hinges):
        if more == "qd":
            noise[f"qd.{joint}"] = 8.0 * sigma
        elif more == "tau" and number in machine.driven and machine.drives[0].kp:
            force = np.concatenate([motion.force[:, number] for motion in motions])
            noise[f"tau.{joint}"] = float(f"{0.01 * force.std() + 1e-4:.3g}")
    return tuple(noise), noise


def _typical(machine, motions):
    """Return scales of a motion by joint: force, speed, travel, position and inertia.

    Forces are those of inverse dynamics, with a floating base those of the actuators.
    """
    plant = World(machine).plant
    speed, away = (np.concatenate([getattr(m, part) for m in motions]) for part in ("v", "q"))
    forces = [
        motion.force
        if machine.floats
        else [
            plant.torque(*state)
            for state in zip(
                motion.q[::8], motion.v[::8],
                np.gradient(motion.v, motion.times, axis=0)[::8], strict=True,
            )
        ]
        for motion in motions
    ]  # fmt: skip
    force = np.concatenate(forces)
    return {
        "force": force.std(axis=0) + 0.05 * np.abs(force.mean(axis=0)) + 1e-9,
        "speed": np.sqrt(np.mean(speed**2, axis=0)),
        "travel": np.mean([np.ptp(motion.q, axis=0) for motion in motions], axis=0),
        "position": np.sqrt(np.mean(away**2, axis=0)),
        "inertia": plant.moved_inertia(motions[0].q[0] if machine.floats else machine.pose),
    }


def _stepped(machine, runs, motions, noises, coarse, rng):
    """Return the machine with a MuJoCo step, and the error of its numerics in units of the noise.

    Without `coarse` the error is below `QUIET` in every channel; with it, the RMS error is 3 to
    300.
    """
    choices = COARSER if coarse else tuple((step, "RK4") for step in STEPS)
    order = rng.permutation(len(choices)).tolist() if coarse else range(len(choices))
    for step, integrator in (choices[k] for k in order):
        tried = replace(machine, step=step, integrator=integrator)
        sizes = _missed(tried, list(zip(runs, motions, strict=True))[:FITTED], noises)
        left = float(np.sqrt(np.mean(np.square(sizes))) if coarse else sizes.max())
        if (3.0 <= left <= 300.0) if coarse else left < QUIET:
            return tried, left
    raise ValueError(f"{machine.name}: MuJoCo's numerics leave {left:.2g} noises at {step} s")


def _missed(machine, moved, noises):
    """Return the RMS error of MuJoCo in each channel, in units of the noise.

    Args:
        machine: robot with the step and integrator to test.
        moved: pairs (run, motion of the reference world).
        noises: noise standard deviation by channel.
    """
    drives, gaps = Drives.of(machine), []
    for run, motion in moved:
        q, v = exam_robots.moved(machine, run)
        u = np.zeros_like(q)
        for joint, drive in zip(machine.driven, machine.drives, strict=True):
            u[:, joint] = run.commands[drive.name]
        gap = {"q": q - motion.q, "qd": v - motion.v, "tau": drives.forces(u, q, v) - motion.force}
        columns = []
        for name, noise in noises.items():
            kind, _, joint = name.partition(".")
            columns.append(gap[kind][:, machine.joints.index(joint)] / noise)
        gaps.append(np.column_stack(columns))
    return np.sqrt(np.mean(np.square(gaps), axis=(0, 1)))
