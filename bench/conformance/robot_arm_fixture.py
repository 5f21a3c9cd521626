"""Robot arm on which effects at places are checked.

It has two joints, driven by a servo and a motor. Every quantity that an effect may change is stated
in its model file.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sims.core.simulator import Scenario
from sims.effects import registry

if TYPE_CHECKING:
    from sims.core.effect import Effect
    from sims.robot.robot_simulator import RobotSimulator

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
"""Observed channels, one of each kind."""

_RUN_SECONDS = 0.8
"""Duration of a run in seconds."""


@lru_cache(maxsize=1)
def make_arm_simulator(effect: type[Effect]) -> type[RobotSimulator]:
    """Make the simulator of the arm, with its contact enabled for effects at contacts.

    It is made anew for each effect, because it caches the places of effects by name.
    """
    import mujoco

    from sims.robot.robot_model import RobotModel
    from sims.robot.robot_simulator import make_robot_simulator

    spec = mujoco.MjSpec.from_string(ARM_MJCF)
    contacts = (_TESTED_CONTACT,) if effect.at == "contact" else ()
    if contacts:
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    robot = RobotModel(Path("checks.xml"), "mjcf", spec, digest="checks", contacts=contacts)
    return make_robot_simulator(robot)


def list_effect_places(effect: type[Effect]) -> tuple[type[Effect], ...]:
    """Return an effect at all places of the arm where it can act, and its family.

    The result is empty if MuJoCo is not installed.
    """
    from importlib.util import find_spec

    if find_spec("mujoco") is None:
        return ()
    if effect.name not in registry.names():
        registry.register(effect)
    return tuple(make_arm_simulator(effect).system.placed(effect))


def make_scenario() -> Scenario:
    """Make a run in which both joints reverse and every command changes."""
    # The first samples are at the ends of simulation steps, the others between them.
    times = np.concatenate([np.arange(0.0, 0.3, 0.02), np.arange(0.301, _RUN_SECONDS, 0.021)])
    initial = {"q.shoulder": 0.4, "q.elbow": -0.7, "qd.shoulder": -1.0, "qd.elbow": 2.0}
    first = np.where(times % 0.4 < 0.2, 0.6, -0.3)
    return Scenario(times, initial, {"u.m_shoulder": first, "u.m_elbow": 0.4 - 2.0 * first})
