"""Toy systems on which conformance checks run: a tuning problem, a tank and a robot arm.

Parameter i of the tuning problem has the rate r_i = 0.5 + 0.6 p_i. Its two channels are the sums
over i = 1, 2, ... of

    cos(r_i t + 0.3 i) / i            (1)
    exp(-r_i t) (1 + 0.1 i)           (2)

so that every parameter is observable, no two can be exchanged, and there is no symmetry in p.

The arm has two joints, driven by a servo and a motor. Every quantity that an effect may change is
stated in its model file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.benchmark.runner.tuner_loop import Evaluate
from methods.tuner import Task
from sims.core.simulator import Array, Channel, Parameter, Scenario
from sims.own_simulator import OwnSimulator

if TYPE_CHECKING:
    from sims.core.effect import Effect
    from sims.robot.robot_simulator import RobotSimulator


SAMPLE_TIMES = np.linspace(0.0, 3.0, 40)
"""Sample times of the toy simulator, seconds."""
TRAINING_RANGE_LOW = 0.25
"""Lower bound of the training range in every direction of the unit cube."""
TRAINING_RANGE_HIGH = 0.75
"""Upper bound of the training range in every direction of the unit cube."""


def simulate_toy_problem(points: Array) -> Array:
    """Simulate the toy problem: (n, 40, 2) from (n, dim) points of the unit cube.

    With r_i = 0.5 + 0.6 p_i, channel 1 is the sum over i of cos(r_i t + 0.3 i) / i (1), channel 2
    that of exp(-r_i t) (1 + 0.1 i) (2).
    """
    i = np.arange(1, points.shape[1] + 1)
    # Arrays (n, 40, dim), which are summed over the parameters.
    cycles = (0.5 + 0.6 * points)[:, None, :] * SAMPLE_TIMES[:, None]
    waves = np.cos(cycles + 0.3 * i) / i  # (1)
    decays = np.exp(-cycles) * (1.0 + 0.1 * i)  # (2)
    return np.stack([waves.sum(axis=2), decays.sum(axis=2)], axis=2)


def make_task(budget: int, dim: int = 2, seed: int = 0) -> tuple[Task, Array]:
    """Make a task with its true parameters; its arrays are read-only.

    Args:
        budget: maximum number of simulations.
        dim: number of parameters.
        seed: seed of the true parameters and of the start.

    Returns:
        The task, and its true parameters (dim,) inside the training range.
    """
    rng = np.random.default_rng(seed)
    # Away from the bounds, where a tuner that clips would find the true parameters by clipping.
    truth, start = rng.uniform(0.3, 0.7, size=(2, dim))
    observed = simulate_toy_problem(truth[None])[0]
    training = np.array([[TRAINING_RANGE_LOW] * dim, [TRAINING_RANGE_HIGH] * dim])
    # Read-only as in the harness, where writing to them fails too.
    for array in (observed, start, training):
        array.setflags(write=False)
    return Task(dim, start, observed, np.ones(2), training, budget, (SAMPLE_TIMES.size,)), truth


def make_evaluate(task: Task, fails: Callable[[int], bool] = lambda _: False) -> Evaluate:
    """Make the function that simulates and evaluates points on a task.

    Args:
        task: task of the tuner: dimension, start, observations and budget.
        fails: returns whether simulation number k fails.
    """
    simulated = 0

    def evaluate(points: Array) -> tuple[Array, Array]:
        """Simulate points and compute their losses, as the harness of a comparison does.

        `fails` decides by its running number whether a simulation fails.

        Args:
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, 40, 2) and losses (n,); NaN and infinite for simulations that fail.
        """
        nonlocal simulated
        observations = simulate_toy_problem(points)
        for observation in observations:
            simulated += 1
            if fails(simulated):
                observation[:] = np.nan
        losses = np.sqrt(((observations - task.observed) ** 2).mean(axis=(1, 2)))
        losses[np.isnan(losses)] = np.inf  # as the harness does for a failed simulation
        return observations, losses

    return evaluate


class FirstOrderTank(OwnSimulator):
    """Tank with an inflow and a drain proportional to the level, integrated exactly."""

    name = "tub"
    parameters = (Parameter("drain", "1/s", 0.8, (0.1, 2.0)),)
    inputs = (Channel("tap", "m/s"),)
    channels = (Channel("level", "m"),)
    states = {"level": 0.5}  # noqa: RUF012
    levels = ("level",)
    time_step = 0.05

    def reset(
        self,
        theta: Mapping[str, float],
        constants: Mapping[str, float],  # noqa: ARG002
        initial: Mapping[str, float],
    ) -> None:
        """Start at a given level.

        Args:
            theta: parameters by name.
            constants: not used.
            initial: initial states by name.
        """
        self.drain, self.level = theta["drain"], initial["level"]

    def step(self, inputs: Mapping[str, float], seconds: float) -> None:
        """Advance the level; it approaches the value at which inflow and outflow are equal.

        Args:
            inputs: inputs by name.
            seconds: length of the step.
        """
        end = inputs["tap"] / self.drain
        self.level = end + (self.level - end) * math.exp(-self.drain * seconds)

    def observe(self) -> dict[str, float]:
        """Return the level."""
        return {"level": self.level}

    def put(self, levels: Mapping[str, float]) -> None:
        """Set the level."""
        self.level = levels["level"]


ARM_MJCF = """
<mujoco model="checks">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.004" integrator="RK4">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <geom name="table" type="plane" pos="0 0 -0.57" size="2 2 1"/>
    <body name="upper">
      <inertial pos="0.01 0 -0.2" mass="1.2" diaginertia="0.02 0.021 0.002"/>
      <joint name="shoulder" axis="0 1 0" damping="0.3 0.02 0" armature="0.01" stiffness="0.2"/>
      <body name="fore" pos="0 0 -0.4">
        <inertial pos="0 0.02 -0.1" mass="0.8" diaginertia="0.01 0.0095 0.001"/>
        <joint name="elbow" axis="0.2 1 0.1" damping="0.1" frictionloss="0.05" armature="0.005"/>
        <geom name="ball" size="0.02" pos="0 0 -0.2"/>
        <site name="tip" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="40" kv="2" forcerange="-30 30"/>
    <motor name="m_elbow" joint="elbow" gear="2"/>
  </actuator>
  <sensor>
    <gyro name="wrist" site="tip"/>
  </sensor>
</mujoco>
"""
"""Model file of the arm. All values differ, so that confusing two places is detected.

The ball at its tip slides on the table where contacts are enabled.
"""

_TESTED_CONTACT = "table/ball"
"""Contact at which effects at contacts act."""

OBSERVED_CHANNELS = ("q.shoulder", "q.elbow", "qd.shoulder", "tau.elbow", "s.wrist.y")
"""Observed channels of the arm, one of each kind."""

_RUN_SECONDS = 0.8
"""Duration of a run of the arm in seconds."""


@lru_cache(maxsize=1)
def make_arm_simulator(effect: type[Effect]) -> type[RobotSimulator]:
    """Make the simulator of the arm, with its contact enabled for effects at contacts and geoms.

    It is made anew for each effect, because it caches the places of effects by name; the cache here
    keeps that of the last effect only.
    """
    import mujoco

    from sims.robot.robot_model import RobotModel
    from sims.robot.robot_simulator import make_robot_simulator

    spec = mujoco.MjSpec.from_string(ARM_MJCF)
    contacts = (_TESTED_CONTACT,) if effect.at in ("contact", "geom") else ()
    if contacts:
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    robot = RobotModel(Path("checks.xml"), "mjcf", spec, digest="checks", contacts=contacts)
    return make_robot_simulator(robot)


def make_arm_scenario() -> Scenario:
    """Make a run of the arm in which both joints reverse and every command changes."""
    # The first samples are at the ends of simulation steps, the others between them.
    times = np.concatenate([np.arange(0.0, 0.3, 0.02), np.arange(0.301, _RUN_SECONDS, 0.021)])
    # Arbitrary angles (rad) and rates (rad/s), and torques (N m) that change every 0.2 s.
    initial = {"q.shoulder": 0.4, "q.elbow": -0.7, "qd.shoulder": -1.0, "qd.elbow": 2.0}
    shoulder = np.where(times % 0.4 < 0.2, 0.6, -0.3)
    return Scenario(times, initial, {"u.m_shoulder": shoulder, "u.m_elbow": 0.4 - 2.0 * shoulder})
