"""Servo as an MJCF model file: a force-limited position servo on a joint that carries a mass.

With K = kt / R, torque = clip(K voltage kp error_gain (goal - q), -K voltage, K voltage) - K kt q':
the second part is the back electromotive force, which damps the joint while the motor is driven.
"""

from __future__ import annotations

from collections.abc import Mapping

from sims.core.system import RenderedModelFile

SERVO_MJCF_TEMPLATE = """<mujoco model="servo">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 {down}"/>
  <worldbody>
    <body name="load">
      <joint name="joint" type="hinge" axis="0 -1 0" armature="{armature}" damping="{damping}"/>
      <inertial pos="0 0 {below}" mass="{mass}" diaginertia="{point} {point} {point}"/>
    </body>
  </worldbody>
  <actuator>
    <position name="motor" joint="joint" kp="{kp}" kv="0" forcelimited="true"
              forcerange="{least} {most}"/>
  </actuator>
</mujoco>
"""
POINT_MASS_INERTIA = 1e-9
"""Inertia in kg m^2 of a point mass about its centre: MuJoCo requires a positive value."""


def render_model_file(numbers: Mapping[str, float]) -> RenderedModelFile:
    """Return the model file of the servo with these parameters and constants."""
    k = numbers
    stall = k["torque_constant"] * k["voltage"] / k["resistance"]
    text = SERVO_MJCF_TEMPLATE.format(
        down=repr(-k["gravity"]),
        armature=repr(k["armature"]),
        damping=repr(k["torque_constant"] ** 2 / k["resistance"]),
        below=repr(-k["length"]),
        mass=repr(k["mass"]),
        point=repr(POINT_MASS_INERTIA),
        kp=repr(stall * k["kp"] * k["error_gain"]),
        least=repr(-stall),
        most=repr(stall),
    )
    assumptions = (
        "damping is the motor's own voltage, kt^2/R, of a driven motor: with torque_enable 0 there "
        "is none",
        "forcerange is the stall torque at this supply",
    )
    return RenderedModelFile(
        text, "joint", "motor", {"q": "q.joint", "goal": "u.motor"}, assumptions
    )
