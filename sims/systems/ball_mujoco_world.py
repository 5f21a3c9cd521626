"""World of the ball in MuJoCo: a sphere on three slides, which cannot spin, above a plane."""

from __future__ import annotations

from collections.abc import Mapping


def model(constants: Mapping[str, float]) -> str:
    """Return the MuJoCo model (MJCF) of the ball and the ground.

    The joints are x, y, z, with zero at the origin. Contact is frictionless (``condim`` 1), and its
    parameters are those of the ball, which has the higher priority.

    Args:
        constants: radius (m), mass (kg) and gravity (m/s^2) by name.
    """
    size = constants["radius"]
    mass = constants["mass"]
    return f"""
    <mujoco>
      <option gravity="0 0 {-constants["gravity"]!r}"/>
      <worldbody>
        <geom type="plane" size="0 0 1" condim="1"/>
        <body>
          <joint type="slide" axis="1 0 0"/>
          <joint type="slide" axis="0 1 0"/>
          <joint type="slide" axis="0 0 1"/>
          <geom type="sphere" size="{size!r}" mass="{mass!r}" condim="1" priority="1"/>
        </body>
      </worldbody>
    </mujoco>"""
