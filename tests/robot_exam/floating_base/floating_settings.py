"""Recording conditions of floating-base robots: machine, runs, channels and noise."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bench.diagnosis_benchmark.case_generation.recording_conditions import SensorNoise
from tests.robot_exam import command_signals
from tests.robot_exam.cause_sizing import NUDGE, Gauge
from tests.robot_exam.exam_settings import FITTED, Setting
from tests.robot_exam.floating_base import floating_robots
from tests.robot_exam.floating_base.floating_world import FloatWorld
from tests.robot_exam.reference_integration import Run
from tests.robot_exam.sensor_models import NOISES, observed

RATE, SECONDS = 100, 2.5
HELD_OUT = 2
COARSE = 2e-3  # Step in s of simulations that only choose sizes.
# Largest initial rotation rate in rad/s and velocity in m/s in each direction.
SPIN, DRIFT = 1.0, 0.5
SWING = 0.9  # Approximate largest deviation of a hinge from its initial position, rad.
LEAN = 0.5  # Largest initial rotation of a ball joint, rad; a free joint begins at any orientation.


def setting(name, rng):
    """Draw a setting of a robot of `floating_robots.NAMES`."""
    machine = floating_robots.machine(name, rng)
    times = np.arange(round(RATE * SECONDS) + 1) / RATE
    forms = rng.choice(command_signals.FORMS, FITTED + HELD_OUT)
    drawn = [_run(machine, str(form), times, rng) for form in forms]
    runs, motions = zip(*drawn, strict=True)
    sigma = float(np.exp(rng.uniform(np.log(5e-4), np.log(1e-3))))
    channels = [f"q.{joint}" for joint in machine.hinges]
    noise = dict.fromkeys(channels, sigma)
    if rng.random() < 0.25:
        noise |= {f"qd.{joint}": 8.0 * sigma for joint in machine.hinges}
    kind = str(rng.choice(NOISES))
    made = SensorNoise(noise, kind, float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.3, 0.6)))
    bare = tuple(motion.q for motion in motions)
    return Setting(machine, runs, tuple(noise), made, bare, _typical(machine, motions), 0.0)


def _run(machine, form, times, rng):
    """Draw a run whose hinges move by about `SWING`, and its motion without a hidden cause."""
    hinges = len(machine.hinges)
    start = rng.uniform(-0.5, 0.5, hinges)
    pose, rate = _begun(machine, rng)
    q, v = np.concatenate([start, pose]), np.concatenate([np.zeros(hinges), rate])
    world = FloatWorld(machine, step=COARSE)
    moved = 1.0 / np.diag(np.linalg.inv(world.plant.inertia(q)))
    waves = {drive.name: command_signals.wave(form, times, rng) for drive in machine.drives}
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


def _begun(machine, rng):
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


def stated(machine, run):
    """Return the initial base state of a run by simgap's names.

    Position and velocity are in world axes, the rotation rate is in body axes.
    """
    base, hinges = machine.links[0].joint, len(machine.hinges)
    pose, rate = run.q[hinges:], run.v[hinges:-1]
    x, y, z, w = pose[-4:]
    said = {f"q.{base}.q{axis}": value for axis, value in zip("wxyz", (w, x, y, z), strict=True)}
    said |= {f"qd.{base}.w{axis}": value for axis, value in zip("xyz", rate[-3:], strict=True)}
    if machine.root == "free":
        drift = Rotation.from_quat(pose[3:]).apply(rate[:3])
        said |= {f"q.{base}.{axis}": value for axis, value in zip("xyz", pose[:3], strict=True)}
        said |= {f"qd.{base}.{axis}": value for axis, value in zip("xyz", drift, strict=True)}
    return {name: float(value) for name, value in said.items()}


def _typical(machine, motions):
    """Return scales of a motion by coordinate: force, speed, travel, position and inertia."""
    plant = FloatWorld(machine).plant
    speed = np.concatenate([motion.v for motion in motions])
    away = np.concatenate([motion.q for motion in motions])
    force = np.concatenate([motion.force for motion in motions])
    free = 1.0 / np.diag(np.linalg.inv(plant.inertia(motions[0].q[0])))
    return {
        "force": force.std(axis=0) + 0.05 * np.abs(force.mean(axis=0)) + 1e-9,
        "speed": np.sqrt(np.mean(speed**2, axis=0)),
        "travel": np.mean([np.ptp(motion.q, axis=0) for motion in motions], axis=0),
        "position": np.sqrt(np.mean(away**2, axis=0)),
        "inertia": free,
    }


class FloatGauge(Gauge):
    """Measure model discrepancies of a setting's runs, in units of the noise.

    Initial states of the hinges are fitted; that of the floating base is known.
    """

    def seen(self, effects):
        from tests.robot_exam import causes_outside_library

        world = FloatWorld(
            self.setting.machine, effects, causes_outside_library.plant_of(effects), COARSE
        )
        channels, sigma = self.setting.channels, self.setting.sigma
        return [
            observed(world, run, channels, causes_outside_library.slips_of(effects, number)) / sigma
            for number, run in self.runs
        ]

    def _states(self, run, base):
        world, columns = FloatWorld(self.setting.machine, step=COARSE), []
        hinges = len(self.setting.machine.hinges)
        for state in range(2 * hinges):
            q, v = run.q.copy(), run.v.copy()
            (q if state < hinges else v)[state % hinges] += NUDGE
            moved = observed(world, Run(run.times, run.commands, q, v), self.setting.channels)
            columns.append(((moved / self.setting.sigma - base) / NUDGE).ravel())
        return np.linalg.qr(np.column_stack(columns))[0]
