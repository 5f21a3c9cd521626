"""Robots whose motion depends on a contact, simulated with plain MuJoCo.

The arm slides with its tip over a table, the sled slides and is pressed on a plane, and the hopper
leaves the ground and lands again. Sizes, masses and the numbers of the contact are drawn.
"""

from __future__ import annotations

import numpy as np

from tests.exams.planted.planted_motion import RATE, SAMPLES, SECONDS, Run, Simulator, reference

SETTLE_SAMPLES = 200  # Samples before a run, in which the robot comes to rest.
PUSH_BANDWIDTH = 2 * np.pi * 2.0  # Bandwidth of the loop that moves the sled, rad/s.

ARM = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><joint damping="{damping:g}" armature="0.005"/></default>
  <worldbody>
    <geom name="ground" type="plane" size="2 2 0.1" friction="{ground:g}"/>
    <body name="upper" pos="0 0 {height:g}">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 {upper:g} 0 0" size="0.02" mass="{mass:g}"
        contype="0" conaffinity="0"/>
      <body name="fore" pos="{upper:g} 0 0">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 {fore:g} 0 0" size="0.015" mass="0.5"
          contype="0" conaffinity="0"/>
        <geom name="foot" type="sphere" size="0.02" pos="{fore:g} 0 0" mass="0.1"
          friction="{friction:g}" solref="{time_constant:g} {damping_ratio:g}" priority="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="{kp:g}" kv="2"/>
    <position name="m_elbow" joint="elbow" kp="{kp:g}" kv="1"/>
  </actuator>
</mujoco>
"""
SLED = """<mujoco model="sled">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1" friction="{ground:g}"/>
    <body name="sled" pos="0 0 0.05">
      <joint name="slide" type="slide" axis="1 0 0" damping="{damping:g}"/>
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom name="foot" type="box" size="0.08 0.06 0.05" mass="{mass:g}"
        friction="{friction:g}" solref="{time_constant:g} {damping_ratio:g}" priority="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide"/><motor name="press" joint="lift"/></actuator>
</mujoco>
"""
HOPPER = """<mujoco model="hopper">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1" friction="{ground:g}"/>
    <body name="trunk" pos="0 0 0.3">
      <joint name="lift" type="slide" axis="0 0 1" damping="{damping:g}"/>
      <geom type="box" size="0.08 0.06 0.05" mass="{mass:g}" contype="0" conaffinity="0"/>
      <body name="leg">
        <joint name="hip" axis="0 1 0" damping="0.05" armature="0.002"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.26" size="0.015" mass="0.2"
          contype="0" conaffinity="0"/>
        <geom name="foot" type="sphere" size="0.03" pos="0 0 -0.27" mass="0.05"
          friction="{friction:g}" solref="{time_constant:g} {damping_ratio:g}" priority="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="thrust" joint="lift"/>
    <position name="m_hip" joint="hip" kp="{kp:g}" kv="1"/>
  </actuator>
</mujoco>
"""
TEXTS = {"arm": ARM, "sled": SLED, "hopper": HOPPER}
NAMES = tuple(TEXTS)


def draw_numbers(rng):
    """Draw the numbers of a model file; those that a robot lacks are not used."""
    return {
        "damping": rng.uniform(0.1, 0.4),
        "ground": rng.uniform(0.3, 1.0),
        "height": rng.uniform(0.2, 0.3),
        "upper": rng.uniform(0.25, 0.35),
        "fore": rng.uniform(0.25, 0.35),
        "mass": rng.uniform(0.8, 2.5),
        "friction": rng.uniform(0.4, 1.0),
        "time_constant": rng.uniform(0.012, 0.03),
        "damping_ratio": rng.uniform(0.6, 1.2),
        "kp": rng.uniform(60.0, 150.0),
    }


def write_model(robot, numbers):
    """Return the model file of a robot."""
    return TEXTS[robot].format(**numbers)


def replay(model, start, commands):
    """Return the states (SAMPLES, nq + nv) from a state under commands that are held."""
    return Simulator(model, []).simulate(Run(commands, start[: model.nq], start[model.nq :]))


def record_motion(robot, numbers, model, form, rng):
    """Drive a robot with the numbers of its contact for one run: (commands, states).

    Args:
        robot: a key of `TEXTS`.
        numbers: numbers of the model file.
        model: compiled model of the true robot.
        form: "multisine", "steps" or "both".
        rng: random generator of the motion.
    """
    drive = {"arm": _drive_arm, "sled": _drive_sled, "hopper": _drive_hopper}[robot]
    waves = reference(form, 2, rng)
    begin, command = drive(numbers, waves, rng)
    simulator = Simulator(model, [])
    simulator.start(begin, np.zeros(model.nv))
    for _ in range(SETTLE_SAMPLES):
        simulator.advance(command(0, simulator.data))
    # The warm start of MuJoCo's solver is no part of the state that a log states.
    start = simulator.data.qpos.copy(), simulator.data.qvel.copy()
    simulator.start(*start)
    commands = []
    for sample in range(SAMPLES):
        # Round as in the table.
        given = command(sample, simulator.data)
        commands.append([float(f"{value:.9g}") for value in given])
        simulator.advance(commands[-1])
    run = Run(np.array(commands), *start)
    return run.commands, simulator.simulate(run)


def _drive_arm(numbers, waves, rng):
    """Move the set point of the tip along the table, below its surface."""
    upper, fore, height = (numbers[key] for key in ("upper", "fore", "height"))
    depth = 0.015 + 0.01 * rng.random() + 0.01 * waves[:, 1]
    x = 0.75 * np.sqrt((upper + fore) ** 2 - height**2) + 0.08 * waves[:, 0]
    down = height - 0.02 + depth  # Distance of the set point below the shoulder.
    distance = np.hypot(x, down)
    bend = np.arccos(np.clip((distance**2 - upper**2 - fore**2) / (2 * upper * fore), -1, 1))
    shoulder = np.arctan2(down, x) - np.arctan2(fore * np.sin(bend), upper + fore * np.cos(bend))
    commands = np.stack([shoulder, bend], axis=1)
    above = commands[0] - [0.1, 0.0]
    return above, lambda sample, data: commands[sample]


def _drive_sled(numbers, waves, rng):
    """Push the sled along a reference position and press it on the ground."""
    mass = numbers["mass"]
    weight = 9.81 * mass
    press = -weight * (0.5 + 0.2 * rng.random() + 0.6 * waves[:, 1])
    kp = PUSH_BANDWIDTH**2 * mass

    def command(sample, data):
        pull = kp * (0.15 * waves[sample, 0] - data.qpos[0]) - 0.1 * kp * data.qvel[0]
        return np.array([pull, press[sample]])

    return np.zeros(2), command


def _drive_hopper(numbers, waves, rng):
    """Lift the hopper from the ground by pulses and swing its leg a little."""
    times = np.arange(SAMPLES) / RATE
    weight = 9.81 * (numbers["mass"] + 0.25)
    period, duty = rng.uniform(0.5, 0.8), rng.uniform(0.15, 0.25)
    is_lifted = (times > 0.2) & ((times / period) % 1.0 < duty) & (times < SECONDS - 0.3)
    thrust = weight * (np.where(is_lifted, rng.uniform(1.6, 2.2), 0.0) + 0.15 * waves[:, 1])
    commands = np.stack([thrust, 0.25 * waves[:, 0]], axis=1)
    return np.zeros(2), lambda sample, data: commands[sample]
