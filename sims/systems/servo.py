"""Servo: a position-controlled motor that carries a pendulum, and its MJCF model.

With K = kt / R, torque = clip(K voltage kp error_gain (goal - q), -K voltage, K voltage) - K kt q':
the second part is the back electromotive force, which damps the joint while the motor is driven.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from sims.core.effect import Effect
from sims.core.number_limits import (
    GAIN_RANGE,
    GRAVITY_RANGE,
    LENGTH_RANGE,
    MASS_RANGE,
    VOLTAGE_RANGE,
)
from sims.core.simulator import Array, Channel, Constant, Parameter
from sims.core.system import (
    DefaultRecording,
    DerivedQuantity,
    RenderedModelFile,
    StateSnapshot,
)
from sims.system_simulator import SystemSimulator
from sims.systems.pendulum import PendulumSystem

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
    """Return the model file of the servo with these parameters and constants.

    MuJoCo has no motor with a voltage. A position actuator with a force range is equivalent: its
    largest force is the stall torque (the torque at full voltage and standstill), and damping takes
    the place of the voltage that the motor itself generates.

    Args:
        numbers: Parameters and constants of the servo by name, SI units.
    """
    stall_torque = numbers["torque_constant"] * numbers["voltage"] / numbers["resistance"]
    text = SERVO_MJCF_TEMPLATE.format(
        down=repr(-numbers["gravity"]),
        armature=repr(numbers["armature"]),
        damping=repr(numbers["torque_constant"] ** 2 / numbers["resistance"]),
        below=repr(-numbers["length"]),
        mass=repr(numbers["mass"]),
        point=repr(POINT_MASS_INERTIA),
        kp=repr(stall_torque * numbers["kp"] * numbers["error_gain"]),
        least=repr(-stall_torque),
        most=repr(stall_torque),
    )
    assumptions = (
        "damping is the motor's own voltage, kt^2/R, of a driven motor: with torque_enable 0 there "
        "is none",
        "forcerange is the stall torque at this supply",
    )
    return RenderedModelFile(
        text,
        joint="joint",
        actuator="motor",
        signals={"q": "q.joint", "goal": "u.motor"},
        notes=assumptions,
    )


_TORQUE_CONSTANT = slice(0, 1)
"""Column of the torque constant among the parameters."""
_RESISTANCE = slice(1, 2)
"""Column of the winding's resistance among the parameters."""
_ARMATURE = slice(2, 3)
"""Column of the inertia of motor and gears among the parameters."""


class ServoSystem(PendulumSystem):
    """Pendulum on a motor with a proportional position controller.

        (armature + mass length^2) q'' = torque - mass gravity length sin q    (1)
        duty = clip(kp error_gain (goal - q), -1, 1)                           (2)
        torque = kt (duty voltage - kt q') / resistance                        (3)

    while enabled, else without torque. States are the angle q [rad], 0 hanging, and its rate qd
    [rad/s].
    """

    name = "servo"
    says = "a position-controlled servo motor that carries a pendulum"
    parameters = (
        Parameter(
            "torque_constant",
            "N*m/A",
            0.5,
            (0.05, 3.0),
            (0.2, 1.0),
            says="torque of the motor per ampere",
        ),
        Parameter(
            "resistance",
            "ohm",
            4.0,
            (0.5, 20.0),
            (2.0, 8.0),
            says="resistance of the motor's winding",
        ),
        Parameter(
            "armature",
            "kg*m^2",
            2e-3,
            (1e-4, 0.05),
            (5e-4, 8e-3),
            says="inertia of motor and gears",
        ),
    )
    constants = (
        Constant("mass", "kg", 0.49, "load", positive=True, limits=MASS_RANGE),
        Constant(
            "length", "m", 0.1, "from the joint to the load", positive=True, limits=LENGTH_RANGE
        ),
        Constant("gravity", "m/s^2", 9.81, "downward", limits=GRAVITY_RANGE),
        Constant("voltage", "V", 7.4, "supply", positive=True, limits=VOLTAGE_RANGE),
        Constant(
            "error_gain",
            "1/rad",
            0.00287738,
            "duty per radian of error and unit of kp",
            limits=GAIN_RANGE,
        ),
        Constant("kp", "1", 200.0, "firmware gain", limits=GAIN_RANGE),
    )
    inputs = (
        Channel("goal", "rad", says="commanded angle"),
        Channel("torque_enable", "1", says="1 while the motor is driven, 0 while it is free"),
    )
    channels = (Channel("q", "rad", says="angle, 0 when hanging"),)
    states: ClassVar[Mapping[str, float]] = MappingProxyType({"q": 0.0, "qd": 0.0})
    sensed = ("q",)
    servo = "goal"
    derived = (
        DerivedQuantity(
            "torque constant over resistance",
            "N*m/V",
            "stall torque for each volt",
            lambda k: k["torque_constant"] / k["resistance"],
        ),
        DerivedQuantity(
            "back-EMF damping",
            "N*m*s/rad",
            "torque reduction by the back-EMF of the driven motor",
            lambda k: k["torque_constant"] ** 2 / k["resistance"],
        ),
        DerivedQuantity(
            "stall torque",
            "N*m",
            "at the whole supply, at rest",
            lambda k: k["torque_constant"] * k["voltage"] / k["resistance"],
            strongest=True,
        ),
        DerivedQuantity(
            "free speed",
            "rad/s",
            "at the whole supply, without friction",
            lambda k: k["voltage"] / k["torque_constant"],
        ),
    )
    usual_recording = DefaultRecording(
        initial={"q": (-0.5, 0.5)},
        inputs={"goal": "steps:1:1", "torque_enable": "1"},
    )

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:
        """Return why the servo cannot have an effect; see `System`."""
        return "its input is a set point, not a force" if effect.name == "input.power" else ""

    @classmethod
    def model_file(cls, numbers: Mapping[str, float]) -> RenderedModelFile:
        """Return the servo as a model file; see `System`.

        The duty is limited before the back electromotive force is subtracted. Therefore the latter
        is a damping of the joint, outside the limit of the servo's force.
        """
        return render_model_file(numbers)

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return the inertia (L, 1) about the joint in kg m^2.

        Args:
            theta: (L, p) parameters.
            constants: (L, 1) constants by name.
        """
        return theta[:, _ARMATURE] + constants["mass"] * constants["length"] ** 2  # (1)

    def drive(self, moment: StateSnapshot) -> Array:
        """Return the motor's torque (L, 1), reduced by its back electromotive force.

        Shapes: L batch elements.

        With duty = clip(kp error_gain (goal - q), -1, 1) (2), the torque is
        kt (duty voltage - kt q') / resistance (3), and zero unless the input `torque_enable` is 1.

        Args:
            moment: state snapshot; its `x` (L, 1) is the angle q, and its `v` (L, 1) the rate q'.
        """
        k = moment.constants
        kt = moment.theta[:, _TORQUE_CONSTANT]
        error = moment.inputs["goal"] - moment.x
        unlimited_duty = k["kp"] * k["error_gain"] * error
        duty = np.minimum(np.maximum(unlimited_duty, -1.0), 1.0)  # (2)
        voltage = duty * k["voltage"] - kt * moment.v
        torque = kt * voltage / moment.theta[:, _RESISTANCE]  # (3)
        return np.where(moment.inputs["torque_enable"] > 0.5, torque, 0.0)


class Servo(SystemSimulator):
    """Servo; see `ServoSystem`."""

    system = ServoSystem
    default_engine = "pybullet"
