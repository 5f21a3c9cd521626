"""Write input effects, constant forces and solver options into fields of a compiled model.

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

import numpy as np

from sims.robot.export.mjcf_attributes import Fields, UnstatableCauseError
from sims.robot.fitted_causes import FittedCause
from sims.robot.integrator_settings import OPTION_EFFECTS
from sims.robot.model_field_effects import get_write_order
from sims.robot.robot_model import RobotModel

MIN_GAIN_FACTOR = 1e-12
"""Minimum factor 1 + a, since a gain error cannot reverse the sign of a command."""


class _Actuator:
    """The fields of one actuator, and its properties."""

    def __init__(self, fields: Fields, robot: RobotModel, place: str) -> None:
        """Read the fields of the actuator with this name, and its properties.

        An actuator exerts the force gain * input + bias (1).

        Args:
            fields: fields of the compiled model; `gain`, `bias` and `command` are views of them, so
                that writing to these changes the fields.
            robot: robot with the actuator.
            place: name of the actuator.
        """
        import mujoco

        self.id = robot.actuator(place).id
        # Address of its first control.
        self.control = int(robot.compiled.actuator_ctrladr[self.id])
        self.has_one_control = int(robot.compiled.actuator_ctrlnum[self.id]) == 1
        self.fields = fields
        # Whether the input is the control itself, without activation dynamics such as a filter.
        self.has_no_dynamics = self._get_integer_field("actuator_dyntype") == int(
            mujoco.mjtDyn.mjDYN_NONE
        )
        self.has_activation_limits = bool(robot.compiled.actuator_actlimited[self.id])
        self.has_constant_gain = self._get_integer_field("actuator_gaintype") == int(
            mujoco.mjtGain.mjGAIN_FIXED
        )
        self.gain = fields["actuator_gainprm"][0, self.id]
        self.bias = fields["actuator_biasprm"][0, self.id]
        # The factor 1 + a and the offset b of the input (1 + a) u + b for the command u, from
        # causes that are in the fields already. MuJoCo has no such field; it is added here for all
        # actuators, without any cause at first.
        unchanged = np.array([[(1.0, 0.0)] * len(robot.compiled.actuator_ctrlnum)])
        self.command = fields.setdefault("command", unchanged)[0, self.id]

    def _get_integer_field(self, name: str) -> int:
        return int(self.fields[name][0, self.id])

    @property
    def is_linear(self) -> bool:
        """True if the force is a gain times one control (possibly filtered) plus a bias."""
        return (
            self.has_one_control
            and (self.has_no_dynamics or self.is_filtered)
            and self.has_constant_gain
            and self.can_have_constant_bias
        )

    @property
    def can_have_constant_bias(self) -> bool:
        """True if the bias has a constant term, or can be given one."""
        import mujoco

        kinds = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
        return self._get_integer_field("actuator_biastype") in kinds

    @property
    def is_filtered(self) -> bool:
        """True if a linear filter without limits precedes the actuator."""
        import mujoco

        kinds = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
        return (
            self._get_integer_field("actuator_dyntype") in kinds and not self.has_activation_limits
        )

    def shift(self, force: float) -> None:
        """Add a constant to the force of the actuator, before its gear, in N or N m.

        In MuJoCo the force is gain * control + bias; the constant is the first bias parameter.

        Args:
            force: the constant in N or N m.
        """
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
        """Set the limits of the control; infinite limits are ignored.

        Args:
            low: lower limit, in the unit of the control.
            high: upper limit.
        """
        if np.isfinite(low) and np.isfinite(high):
            self.fields["actuator_ctrllimited"][0, self.control] = True
            self.fields["actuator_ctrlrange"][0, self.control] = (low, high)


_NOT_LINEAR = "its actuator is not a gain and a bias of one control"


def _write_input_gain(actuator: _Actuator, a: float) -> None:
    """Write an error a of the input gain into the actuator.

    The actuator's gain is multiplied by 1 + a. Its control range is divided by the same factor,
    since MuJoCo's range limits the command before the gain, but in reality it does so after the
    gain.

    Args:
        actuator: actuator whose fields are changed.
        a: relative error of the gain.

    Raises:
        UnstatableCauseError: the force of the actuator is not proportional to a gain and one
            control, or 1 + a is not positive.
    """
    can_scale = (
        actuator.has_one_control
        and actuator.has_constant_gain
        and (actuator.has_no_dynamics or actuator.is_filtered)
    )
    if not can_scale:
        raise UnstatableCauseError(_NOT_LINEAR)
    if 1.0 + a < MIN_GAIN_FACTOR:
        raise UnstatableCauseError("a control range cannot express a factor of zero or less")
    low, high = actuator.limits()
    actuator.limit(low / (1.0 + a), high / (1.0 + a))
    actuator.gain[0] *= 1.0 + a
    # The factor of the command, for causes that are written later.
    actuator.command[0] *= 1.0 + a


def _write_input_bias(actuator: _Actuator, b: float) -> None:
    """Write an input bias b into the actuator: a constant force, and a shifted control range.

    With the command u and an input gain 1 + a that is in the fields already, the input is
    (1 + a) u + b. So the actuator with gain g gets the additional force g b, and the limits of its
    control are shifted by -b / (1 + a). The gain in the fields is g (1 + a).

    Args:
        actuator: actuator whose fields are changed.
        b: bias, in the unit of the control.

    Raises:
        UnstatableCauseError: the force of the actuator is not a gain times one control plus a bias.
    """
    if not actuator.is_linear:
        raise UnstatableCauseError(_NOT_LINEAR)
    input_factor, _ = actuator.command  # 1 + a
    low, high = actuator.limits()
    actuator.limit(low - b / input_factor, high - b / input_factor)
    actuator.shift(float(actuator.gain[0] / input_factor * b))
    # The offset of the command, for causes that are written later.
    actuator.command[1] += b


def _write_saturation(actuator: _Actuator, s: float) -> None:
    """Write a saturation of the input at ±s as a narrower control range of the actuator.

    The input is w = clip((1 + a) u + b, -s, s) for the command u, with a gain error a and a bias b
    that are in the fields already. So the command is limited to the range from (-s - b) / (1 + a)
    to (s - b) / (1 + a), within its own control range (2). A saturation s of zero or less has no
    effect, as in the simulation.

    Args:
        actuator: actuator whose fields are changed.
        s: limit of the input, in the unit of the control.

    Raises:
        UnstatableCauseError: the force of the actuator is not a gain times one control plus a bias,
            or no command is in both ranges.
    """
    if s <= 0:
        return
    if not actuator.is_linear:
        raise UnstatableCauseError(_NOT_LINEAR)
    input_factor, b = actuator.command  # 1 + a, and b
    low, high = actuator.limits()
    low, high = max(low, (-s - b) / input_factor), min(high, (s - b) / input_factor)
    if low >= high:
        raise UnstatableCauseError("the control range would be empty")
    actuator.limit(low, high)  # (2)


def _write_delay(actuator: _Actuator, delay: float) -> str | None:
    """Write an input delay into the actuator: its delay, and a buffer of past controls.

    Args:
        actuator: actuator whose fields are changed.
        delay: delay in seconds; zero changes nothing.

    Returns:
        A note for the user, or None.

    Raises:
        UnstatableCauseError: the delay is negative, or the file states one already.
    """
    # Fields have one batch element, 0.
    step = float(actuator.fields["opt.timestep"][0])
    if delay == 0:
        return None
    if delay < 0:
        raise UnstatableCauseError("a negative delay is not possible")
    if actuator.fields["actuator_delay"][0, actuator.id] > 0:
        raise UnstatableCauseError("the file states a delay already")
    actuator.fields["actuator_delay"][0, actuator.id] = delay
    # The buffer's number of samples and kind of interpolation (1 is linear). Linear interpolation
    # between past controls is the mean, over a step, of delayed controls that are constant over
    # their steps.
    actuator.fields["actuator_history"][0, actuator.id] = (ceil(delay / step) + 1, 1)
    delay_note = "" if delay >= step else f", delays it by a whole step, {step:g} s"
    return (
        f"MuJoCo takes a control that is delayed for 0 before the first one{delay_note} "
        "(mj_initCtrlHistory sets another)"
    )


def _write_lag(actuator: _Actuator, lag: float) -> str | None:
    """Write a first-order lag of the input as an exact activation filter (FILTEREXACT) of MuJoCo.

    Args:
        actuator: actuator whose fields are changed.
        lag: time constant in seconds; zero or less changes nothing.

    Returns:
        A note for the user, or None.

    Raises:
        UnstatableCauseError: the actuator has activation dynamics already, no constant gain, or not
            one control.
    """
    import mujoco

    if lag <= 0:
        return None
    if not (actuator.has_no_dynamics and actuator.has_constant_gain and actuator.has_one_control):
        raise UnstatableCauseError("its actuator has dynamics already")
    # Fields have one batch element, 0. The first parameter of a filter is its time constant.
    actuator.fields["actuator_dyntype"][0, actuator.id] = int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
    parameters = actuator.fields["actuator_dynprm"][0, actuator.id]
    parameters[:] = 0.0
    parameters[0] = lag
    return (
        "MuJoCo filters the control after its range, from 0 on (set data.act to the first control)"
        ", and holds the filtered one over each step"
    )


def _write_constant_force(fields: Fields, robot: RobotModel, cause: FittedCause) -> str | None:
    """Write a constant force at a joint into the model, in N or N m.

    MuJoCo has no such element, so one of these is used:

    1. A joint with a linear spring gets another rest position: force = stiffness times
       displacement.
    2. An actuator of the joint gets a bias, if no force limit would clip it.

    Args:
        fields: fields of the compiled model, changed in place.
        robot: robot of this model.
        cause: cause with its fitted force.

    Returns:
        A note for the user, or None.

    Raises:
        UnstatableCauseError: the joint has neither a linear spring nor an actuator without limits.
    """
    # 1. Spring. Its rest position also determines the rest length of tendons, so it cannot be
    # changed in a model with tendons. Those of coupled drives have no springs and do not count.
    joint, (force,) = robot.joint(cause.place), cause.coefficients
    stiffness = fields["jnt_stiffness"][0, joint.id]
    has_tendons = robot.compiled.ntendon > len(robot.coupled)
    is_linear = not fields["jnt_stiffnesspoly"][0, joint.id].any()
    if (
        joint.has_one_coordinate
        and stiffness > 0
        and is_linear
        and not has_tendons
        and not robot.compiled.jnt_springyield[joint.id]
    ):
        fields["qpos_spring"][0, joint.position] += force / stiffness
        return None
    # 2. Actuator. That of a coupled drive acts on two joints. Limits may be those of the file, of
    # the joint, or of another cause, which is in the fields.
    for driving in robot.actuators:
        actuator = _Actuator(fields, robot, driving.name)
        is_uncoupled = joint.name not in robot.coupled
        is_unlimited = driving.force is None and joint.effort is None
        can_have_bias = actuator.has_one_control and actuator.can_have_constant_bias
        if driving.joint == joint.name and can_have_bias and is_unlimited and is_uncoupled:
            gear = robot.compiled.actuator_gear[actuator.id]
            if not fields["actuator_forcelimited"][0, actuator.id] and gear[0]:
                actuator.shift(float(force / gear[0]))
                return (
                    f"it is written as a bias of actuator {driving.name}, and is part of its force"
                )
    raise UnstatableCauseError(
        "MuJoCo has no constant force at a joint without a spring or an actuator free of limits"
    )


def _write_option(fields: Fields, robot: RobotModel, cause: FittedCause) -> None:  # noqa: ARG001
    """Write an option of MuJoCo's solver, such as the time step in seconds, into the model.

    Args:
        fields: fields of the model, changed in place.
        robot: unused; all writers have the same arguments.
        cause: the cause, whose coefficient is the value of the option; for a word, such as the name
            of an integrator, MuJoCo's number of the word.
    """
    (number,) = cause.coefficients
    fields[f"opt.{OPTION_EFFECTS[cause.effect]}"][0] = number


_INPUT_WRITERS: Mapping[str, Callable[[_Actuator, float], str | None]] = {
    "input.gain": _write_input_gain,
    "input.bias": _write_input_bias,
    "input.saturation": _write_saturation,
    "input.delay": _write_delay,
    "input.lag": _write_lag,
}
"""Writers of effects on the input of an actuator."""


def _write_input_effect(fields: Fields, robot: RobotModel, cause: FittedCause) -> str | None:
    """Write an effect on an input into its actuator.

    Args:
        fields: fields of the compiled model, changed in place.
        robot: robot with the actuator.
        cause: effect at an actuator with its only coefficient.

    Returns:
        A note for the user, or None.

    Raises:
        UnstatableCauseError: the actuator cannot state the effect.
    """
    (coefficient,) = cause.coefficients
    actuator = _Actuator(fields, robot, cause.place)
    return _INPUT_WRITERS[cause.effect](actuator, float(coefficient))


COMMAND_WRITERS: Mapping[str, Callable[[Fields, RobotModel, FittedCause], str | None]] = {
    **dict.fromkeys(OPTION_EFFECTS, _write_option),
    **dict.fromkeys(_INPUT_WRITERS, _write_input_effect),
    "force.bias": _write_constant_force,
}
"""Writers by effect: model changes, then effects in the order in which a command passes them."""


def get_application_order(cause: FittedCause) -> tuple[int, int]:
    """Return the sort key of a cause in the order in which causes are written into a model.

    1. Time step and other options of the solver, on which the stiffness of dry friction depends.
    2. Causes that are numbers of the model.
    3. Effects on inputs, in the order in which a command passes them; and constant forces.

    Args:
        cause: cause to write.

    Returns:
        Number of the group in this list, counted from 0, and order within the group.
    """
    if cause.effect.startswith("numerics."):
        return 0, 0
    names = list(COMMAND_WRITERS)
    if cause.effect in names:
        return 2, names.index(cause.effect)
    return 1, get_write_order(cause.effect)
