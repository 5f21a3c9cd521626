"""The pendulum's world in MuJoCo: gravity's torque from a body on a short arm, the inertia from the
joint's armature.

As in Bullet (`sims.pendulum.bullet_world`) the inertia may be anything above mass length^2 / 1000.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sims.pendulum.bullet_world import gravity  # the same torque

__all__ = ["OPEN_LOOP", "gravity", "load", "model"]

OPEN_LOOP = True
"""The torque is the input, whatever the motion."""
SHORTER = 1000.0
"""The body is so many times heavier, its arm so many times shorter."""
_TINY = 1e-14
"""kg m^2: MuJoCo wants the body to have some inertia of its own."""


def model(constants: Mapping[str, float]) -> str:
    """The world as MJCF."""
    mass = constants["mass"] * SHORTER
    arm = constants["length"] / SHORTER
    return f"""
    <mujoco>
      <option gravity="0 0 {-constants["gravity"]!r}"/>
      <worldbody>
        <body>
          <joint type="hinge" axis="0 1 0"/>
          <inertial mass="{mass!r}" pos="0 0 {-arm!r}" diaginertia="{_TINY} {_TINY} {_TINY}"/>
        </body>
      </worldbody>
    </mujoco>"""


def load(model: Any, inertia: float, constants: Mapping[str, float]) -> bool:
    """Give the joint the armature that makes up this inertia; False if there is none."""
    armature = inertia - constants["mass"] * constants["length"] ** 2 / SHORTER - _TINY
    model.dof_armature[0] = armature
    return armature > 0.0
