"""Recording conditions of floating-base robots: machine, runs, channels and noise."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bench.diagnosis_benchmark.case_generation.recording_conditions import SensorNoise
from tests.exams.floating import floating_robots
from tests.exams.robots import command_signals
from tests.exams.robots.exam_settings import FITTED, HELD_OUT, Setting
from tests.exams.robots.reference_world import COARSE, Run, World
from tests.exams.robots.sensor_models import NOISES

RATE, SECONDS = 100, 2.5
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
    return Setting(
        machine, runs, tuple(noise), made, bare, _typical(machine, motions), 0.0, HELD_OUT
    )


def _run(machine, form, times, rng):
    """Draw a run whose hinges move by about `SWING`, and its motion without a hidden cause."""
    hinges = len(machine.hinges)
    start = rng.uniform(-0.5, 0.5, hinges)
    pose, rate = _draw_base_state(machine, rng)
    q, v = np.concatenate([start, pose]), np.concatenate([np.zeros(hinges), rate])
    world = World(machine, step=COARSE)
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


def _draw_base_state(machine, rng):
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


def _typical(machine, motions):
    """Return scales of a motion by coordinate: force, speed, travel, position and inertia."""
    plant = World(machine).plant
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
