"""World of the pendulum in MuJoCo.

A body on a short arm gives the torque of gravity, and the armature of the joint the inertia. As in
Bullet (`sims.systems.pendulum_bullet_world`) the inertia may be anything above
mass length^2 / 1000.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sims.systems.pendulum_bullet_world import gravity  # same torque as in Bullet

__all__ = ["gravity", "load", "model"]

LENGTH_REDUCTION_FACTOR = 1000.0
"""Factor by which the body is heavier and its arm is shorter than in the system."""
_BODY_INERTIA = 1e-14
"""Inertia of the body in kg m^2: MuJoCo requires a positive value."""


def model(constants: Mapping[str, float]) -> str:
    """Return the MuJoCo model (MJCF) of the pendulum, with the gravity torque of its constants.

    Mass times arm is that of the pendulum. The arm is far shorter, so that the body adds hardly any
    inertia to the armature of the joint, which `load` sets.
    """
    mass = constants["mass"] * LENGTH_REDUCTION_FACTOR
    arm = constants["length"] / LENGTH_REDUCTION_FACTOR
    inertia = f"{_BODY_INERTIA} {_BODY_INERTIA} {_BODY_INERTIA}"
    return f"""
    <mujoco>
      <option gravity="0 0 {-constants["gravity"]!r}"/>
      <worldbody>
        <body>
          <joint type="hinge" axis="0 1 0"/>
          <inertial mass="{mass!r}" pos="0 0 {-arm!r}" diaginertia="{inertia}"/>
        </body>
      </worldbody>
    </mujoco>"""


def load(model: Any, inertia: float, constants: Mapping[str, float]) -> bool:
    """Set the joint's armature for this inertia; return False if it would not be positive.

    Args:
        model: compiled model (``MjModel``).
        inertia: generalised inertia in kg or kg*m^2.
        constants: constants of the system by name.
    """
    armature = (
        inertia
        - constants["mass"] * constants["length"] ** 2 / LENGTH_REDUCTION_FACTOR
        - _BODY_INERTIA
    )
    model.dof_armature[0] = armature
    return armature > 0.0
