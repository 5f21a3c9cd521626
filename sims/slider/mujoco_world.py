"""The slider's world in MuJoCo: a body on a guide along x, without gravity, which the guide would
carry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

OPEN_LOOP = True
"""The force is the input, whatever the motion."""


def model(constants: Mapping[str, float]) -> str:  # noqa: ARG001
    """The world as MJCF. The body hangs below the guide, since MuJoCo keeps the mass of one at its
    joint's origin.
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
    """Give the body this mass; False if there is no such mass."""
    model.body_mass[1] = inertia
    return inertia > 0.0


def gravity(constants: Mapping[str, float]) -> Callable[[float], float]:  # noqa: ARG001
    """None along the guide."""
    return lambda x: 0.0  # noqa: ARG005
