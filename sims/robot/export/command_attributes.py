"""Input effects and constant forces as fields of a compiled model.

With the command u, the actuator input w = clip((1 + a) u + b, -s, s), the control range [l, h] of
the actuator, and force = g w + bias:

* (1) force = g (1 + a) v + g b + bias, with
* (2) v = clip(u, ...) between ((L - b) / (1 + a), (H - b) / (1 + a)), where [L, H] is the
  intersection of [-s, s] and the control range

so gain, bias and saturation become MuJoCo's gain, bias and control range.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import ceil
from typing import Any

import numpy as np

from sims.robot.export.mjcf_attributes import Fields
from sims.robot.fitted_causes import FittedCause
from sims.robot.model_field_effects import get_write_order
from sims.robot.robot_model import RobotModel

UnstatableReason = str | None
"""Reason why a cause cannot be written; None if it is written.

A text that begins with ``+`` is a note about a cause that is written.
"""

MIN_GAIN_FACTOR = 1e-12
"""Minimum factor 1 + a, since a gain error cannot reverse the sign of a command."""


class _Actuator:
    """The fields of one actuator, and its properties."""

    def __init__(self, fields: Fields, robot: RobotModel, place: str) -> None:
        """Read the fields of the actuator with this name, and its properties for eqs. (1) and (2).

        `gain` and `bias` are views, so that writing to them changes `fields`. `direct`
        means without activation dynamics, `fixed` with a constant gain, `clamped` with a
        limited activation.
        """
        import mujoco

        self.id = robot.actuator(place).id
        self.control = int(robot.compiled.actuator_ctrladr[self.id])
        self.single = int(robot.compiled.actuator_ctrlnum[self.id]) == 1
        self.fields = fields
        self.direct = self._get_integer_field("actuator_dyntype") == int(mujoco.mjtDyn.mjDYN_NONE)
        self.clamped = bool(robot.compiled.actuator_actlimited[self.id])
        self.fixed = self._get_integer_field("actuator_gaintype") == int(
            mujoco.mjtGain.mjGAIN_FIXED
        )
        self.gain = fields["actuator_gainprm"][0, self.id]
        self.bias = fields["actuator_biasprm"][0, self.id]
        # The factor 1 + a and the offset b of (1) from causes that are in the fields already.
        self.command = fields.setdefault("command", _get_command_scaling(robot))[0, self.id]

    def _get_integer_field(self, name: str) -> int:
        return int(self.fields[name][0, self.id])

    @property
    def linear(self) -> bool:
        """True if the force is a gain times one control (possibly filtered) plus a bias."""
        return self.single and (self.direct or self.filtered) and self.fixed and self.steady

    @property
    def steady(self) -> bool:
        """True if the bias has a constant term, or can be given one."""
        import mujoco

        kinds = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
        return self._get_integer_field("actuator_biastype") in kinds

    @property
    def filtered(self) -> bool:
        """True if a linear filter without limits precedes the actuator."""
        import mujoco

        kinds = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
        return self._get_integer_field("actuator_dyntype") in kinds and not self.clamped

    def shift(self, force: float) -> None:
        """Add a constant force in N or N m to the force that the actuator computes."""
        import mujoco

        if self._get_integer_field("actuator_biastype") == int(mujoco.mjtBias.mjBIAS_NONE):
            # Bias parameters of an actuator without a bias type have no effect.
            self.bias[:] = 0.0
            self.fields["actuator_biastype"][0, self.id] = int(mujoco.mjtBias.mjBIAS_AFFINE)
        self.bias[0] += force

    def limits(self) -> tuple[float, float]:
        """Return the lower and upper limit of the control; infinite if there is none."""
        if not self.fields["actuator_ctrllimited"][0, self.control]:
            return -np.inf, np.inf
        low, high = self.fields["actuator_ctrlrange"][0, self.control]
        return float(low), float(high)

    def limit(self, low: float, high: float) -> None:
        """Set the limits of the control; infinite limits are ignored."""
        if np.isfinite(low) and np.isfinite(high):
            self.fields["actuator_ctrllimited"][0, self.control] = True
            self.fields["actuator_ctrlrange"][0, self.control] = (low, high)


def _get_command_scaling(robot: RobotModel) -> Any:
    """Return the unchanged factor and offset (1, N, 2) of each actuator's command."""
    return np.array([[(1.0, 0.0)] * len(robot.compiled.actuator_ctrlnum)])


_NOT_LINEAR = "its actuator is not a gain and a bias of one control"


def _write_input_gain(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:
    """Write an input gain a into the actuator: gain times 1 + a (1), range divided by it (2)."""
    actuator, (a,) = _Actuator(fields, robot, cause.place), cause.coefficients
    can_scale = actuator.single and actuator.fixed and (actuator.direct or actuator.filtered)
    if not can_scale:
        return _NOT_LINEAR
    if 1.0 + a < MIN_GAIN_FACTOR:
        return "a control range cannot express a factor of zero or less"
    low, high = actuator.limits()
    actuator.limit(low / (1.0 + a), high / (1.0 + a))  # (2)
    actuator.gain[0] *= 1.0 + a  # (1)
    actuator.command[0] *= 1.0 + a
    return None


def _write_input_bias(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:
    """Write an input bias b into the actuator: shift its force by gain b (1), its range by -b (2).

    `input_factor` is the factor 1 + a of an input gain that is in the fields already.
    """
    actuator, (b,) = _Actuator(fields, robot, cause.place), cause.coefficients
    if not actuator.linear:
        return _NOT_LINEAR
    input_factor, _ = actuator.command
    low, high = actuator.limits()
    actuator.limit(low - b / input_factor, high - b / input_factor)  # (2)
    actuator.shift(float(actuator.gain[0] / input_factor * b))  # (1)
    actuator.command[1] += b
    return None


def _write_saturation(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:
    """Write a saturation of the input at ±s as a narrower control range, eq. (2).

    A saturation s of zero or less has no effect, as in the simulation.
    """
    actuator, (s,) = _Actuator(fields, robot, cause.place), cause.coefficients
    if s <= 0:
        return None
    if not actuator.linear:
        return _NOT_LINEAR
    input_factor, b = actuator.command
    low, high = actuator.limits()
    low, high = max(low, (-s - b) / input_factor), min(high, (s - b) / input_factor)
    if low >= high:
        return "the control range would be empty"
    actuator.limit(low, high)  # (2)
    return None


def _write_delay(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:
    """Write an input delay in seconds into the actuator's delay and history buffer.

    The returned text begins with +, which marks a note about a cause that was written.
    """
    actuator, (delay,) = _Actuator(fields, robot, cause.place), cause.coefficients
    step = float(fields["opt.timestep"][0])
    if delay == 0:
        return None
    if delay < 0:
        return "a negative delay is not possible"
    if fields["actuator_delay"][0, actuator.id] > 0:
        return "the file states a delay already"
    fields["actuator_delay"][0, actuator.id] = delay
    # MuJoCo interpolates linearly between past controls. This equals the mean, over a step, of
    # delayed controls that are constant over their steps.
    fields["actuator_history"][0, actuator.id] = (ceil(delay / step) + 1, 1)
    delay_note = "" if delay >= step else f", delays it by a whole step, {step:g} s"
    return (
        f"+MuJoCo takes a control that is delayed for 0 before the first one{delay_note} "
        "(mj_initCtrlHistory sets another)"
    )


def _write_lag(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:
    """Write a first-order lag of the input as an exact activation filter (FILTEREXACT) of MuJoCo.

    `lag` is the time constant in seconds. The returned text begins with +, which marks a note
    about a cause that was written.
    """
    import mujoco

    actuator, (lag,) = _Actuator(fields, robot, cause.place), cause.coefficients
    if lag <= 0:
        return None
    if not (actuator.direct and actuator.fixed and actuator.single):
        return "its actuator has dynamics already"
    fields["actuator_dyntype"][0, actuator.id] = int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
    parameters = fields["actuator_dynprm"][0, actuator.id]
    parameters[:] = 0.0
    parameters[0] = lag
    return (
        "+MuJoCo filters the control after its range, from 0 on (set data.act to the first control)"
        ", and holds the filtered one over each step"
    )


def _write_constant_force(
    fields: Fields, robot: RobotModel, cause: FittedCause
) -> UnstatableReason:
    """Write a constant force at a joint into the model, in N or N m.

    A joint with a linear spring gets another rest position: force = stiffness times
    displacement. Otherwise an actuator of the joint gets a bias, if no force limit would clip
    it. The result is None, a note that begins with +, or the reason why neither is possible.
    """
    joint, (force,) = robot.joint(cause.place), cause.coefficients
    stiffness = fields["jnt_stiffness"][0, joint.id]
    tendon_count = robot.compiled.ntendon - len(robot.coupled)
    has_linear_spring = not fields["jnt_stiffnesspoly"][0, joint.id].any() and not tendon_count
    if (
        joint.has_one_coordinate
        and stiffness > 0
        and has_linear_spring
        and not robot.compiled.jnt_springyield[joint.id]
    ):
        fields["qpos_spring"][0, joint.position] += force / stiffness
        return None
    for driving in robot.actuators:
        actuator = _Actuator(fields, robot, driving.name)
        is_uncoupled = joint.name not in robot.coupled
        is_unlimited = driving.force is None and joint.effort is None and is_uncoupled
        if driving.joint == joint.name and actuator.single and actuator.steady and is_unlimited:
            gear = robot.compiled.actuator_gear[actuator.id]
            if not fields["actuator_forcelimited"][0, actuator.id] and gear[0]:
                actuator.shift(float(force / gear[0]))
                return (
                    f"+it is written as a bias of actuator {driving.name}, and is part of its force"
                )
    return "MuJoCo has no constant force at a joint without a spring or an actuator free of limits"


def _write_time_step(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:  # noqa: ARG001
    """Write a time step in seconds as the option of the model file."""
    (step,) = cause.coefficients
    fields["opt.timestep"][0] = step
    return None


def _write_integrator(fields: Fields, robot: RobotModel, cause: FittedCause) -> UnstatableReason:  # noqa: ARG001
    """Write MuJoCo's number of an integrator as the option of the model file."""
    (number,) = cause.coefficients
    fields["opt.integrator"][0] = int(number)
    return None


CommandWriter = Callable[[Fields, RobotModel, FittedCause], UnstatableReason]

COMMAND_WRITERS: Mapping[str, CommandWriter] = {
    "numerics.step": _write_time_step,
    "numerics.integrator": _write_integrator,
    "input.gain": _write_input_gain,
    "input.bias": _write_input_bias,
    "input.saturation": _write_saturation,
    "input.delay": _write_delay,
    "input.lag": _write_lag,
    "force.bias": _write_constant_force,
}
"""Writers by effect: model changes, then effects in the order in which a command passes them."""


def get_application_order(cause: FittedCause) -> tuple[int, int]:
    """Return the sort key of a cause in the order of application.

    Integrator settings come first, then causes in the model, then input effects in the order in
    which a command passes them.
    """
    # The stiffness of dry friction depends on the time step.
    if cause.effect.startswith("numerics."):
        return 0, 0
    names = list(COMMAND_WRITERS)
    if cause.effect in names:
        return 2, names.index(cause.effect)
    return 1, get_write_order(cause.effect)
