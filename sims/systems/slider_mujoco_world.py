"""World of the slider in MuJoCo: a body on a guide along x.

There is no gravity, which the guide would support.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sims.systems.slider_bullet_world import gravity  # same force as in Bullet

__all__ = ["gravity", "load", "model"]


def model(constants: Mapping[str, float]) -> str:  # noqa: ARG001
    """Return the MuJoCo model (MJCF) of the slider.

    The body hangs below the guide, because MuJoCo does not update the mass of a body at its joint's
    origin.
    """
    return """
    <mujoco>
      <option gravity="0 0 0"/>
      <worldbody>
        <body>
          <joint type="slide" axis="1 0 0"/>
          <inertial mass="1" pos="0 0 -1" diaginertia="1 1 1"/>
        </body>
      </worldbody>
    </mujoco>"""


def load(model: Any, inertia: float, constants: Mapping[str, float]) -> bool:  # noqa: ARG001
    """Set the body's mass; return False if it is not positive.

    Args:
        model: compiled model (``MjModel``).
        inertia: generalised inertia in kg or kg*m^2.
        constants: constants of the system by name.
    """
    model.body_mass[1] = inertia
    return inertia > 0.0
