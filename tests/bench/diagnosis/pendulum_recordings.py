"""Model file of a two-joint arm that is fast to simulate, for tests of comparisons."""

from __future__ import annotations

from pathlib import Path

SWINGING = """
<mujoco model="swinging">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <inertial pos="0 0 -0.18" mass="1.2" diaginertia="0.018 0.018 0.0012"/>
      <joint name="shoulder" axis="0 1 0" damping="0.3" range="-1.5 1.5"/>
      <body name="fore" pos="0 0 -0.4">
        <inertial pos="0 0 -0.15" mass="0.8" diaginertia="0.009 0.009 0.0006"/>
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m_shoulder" joint="shoulder" ctrlrange="-3 3"/>
    <position name="s_elbow" joint="elbow" kp="4" kv="0.2" ctrlrange="-0.5 0.9"/>
  </actuator>
</mujoco>
"""


def written(folder: Path, text: str = SWINGING, name: str = "swinging.xml") -> Path:
    """Write the model file to a folder; return its path."""
    path = folder / name
    path.write_text(text)
    return path
