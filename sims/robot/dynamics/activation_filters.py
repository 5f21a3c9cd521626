"""First-order filters before actuators: MuJoCo's dyntype ``filter`` and ``filterexact``.

With the control u, the activation a that replaces it, the time constant T and the step h,

    filter        a[k+1] = a[k] + (h / T) (u[k] - a[k])                                         (1)
    filterexact   a[k+1] = a[k] + (1 - exp(-h / T)) (u[k] - a[k])                               (2)

The activation at the start of a run is not recorded. It is the first of these that is available:
the value that the recording specifies; the result of (1) or (2) for the known commands before the
run; the first command.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sims.core.simulator import Array, Scenario
from sims.effects.compiled_recursions import LINEAR, run_recursion
from sims.robot.robot_model import Actuator, RobotModel, cache_per_robot, filters

ACTIVATION_PREFIX = "act."
"""Prefix of the names under which a recording specifies activations."""
MIN_TIME_CONSTANT = 1e-15
"""Smallest time constant in seconds, MuJoCo's mjMINVAL."""


class ActivationFilter(NamedTuple):
    """A filter before an actuator.

    Attributes:
        actuator: the actuator.
        address: address of its activation in MuJoCo's ``act``.
        seconds: time constant in seconds.
        exact: whether (2) applies instead of (1).
        limits: lowest and highest activation; infinite if not limited.
    """

    actuator: Actuator
    address: int
    seconds: float
    exact: bool
    limits: tuple[float, float]

    @property
    def state(self) -> str:
        """Name under which a recording specifies the activation."""
        return ACTIVATION_PREFIX + self.actuator.name

    def clip_controls(self, controls: Array) -> Array:
        """Return controls limited to the control range, as the filter receives them."""
        if self.actuator.range is None:
            return controls
        clipped: Array = np.clip(controls, *self.actuator.range)
        return clipped

    def compute_activations(
        self, controls: Array, initial: Array, step: float, is_rk4: bool
    ) -> Array:
        """Compute the filter's outputs, its activations, at the beginnings of S steps.

        In each step of length h, the activation approaches the control by the share h / T (Euler's
        method), with the time constant T; or by 1 - exp(-h / T) if the filter is exact, or if the
        integrator is Runge-Kutta 4, which agrees with it to fourth order.

        Args:
            controls: (n, S) controls of n batch elements in the steps.
            initial: (n,) initial activations.
            step: step length h in seconds.
            is_rk4: whether the integrator is Runge-Kutta 4.

        Returns:
            (n, S + 1) activations; the last one is after the last step.
        """
        # A model file may state a time constant of zero, which MuJoCo replaces by this minimum.
        ratio = step / max(self.seconds, MIN_TIME_CONSTANT)
        # Share of the activation a[k] that remains after a step: 1 - h / T, or exp(-h / T).
        retained_share = float(np.exp(-ratio)) if self.exact or is_rk4 else 1.0 - ratio
        # The recursion a[k+1] = decay a[k] + (1 - decay) u[k] gives a after each step, (n, S).
        inputs = self.clip_controls(controls)
        decay = np.full_like(inputs, retained_share)
        end_activations = run_recursion(LINEAR, decay, (1.0 - decay) * inputs, initial[:, None])
        # MuJoCo applies a limit within the recursion. But commands that reach the limit stay beyond
        # it for longer than a step, so the difference only lasts as long as the filter's time
        # constant.
        result: Array = np.clip(
            np.concatenate([initial[:, None], end_activations], axis=1), *self.limits
        )
        return result


@cache_per_robot
def activation_filters(robot: RobotModel) -> tuple[ActivationFilter, ...]:
    """Return the filters before actuators of a robot, which delay a control by a first-order lag.

    They have MuJoCo's types `filter` and `filterexact`. Filters of actuators with two controls (a
    set point and its rate) are left out.

    Args:
        robot: robot with its actuators.

    Returns:
        Filters in the order of the actuators; an actuator has at most one.
    """
    import mujoco

    model = robot.compiled
    # MuJoCo's numbers of both types; an exact filter advances by the exact solution of the lag.
    filter_types, exact_type = filters(), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
    activation_filters_of_robot = []
    for actuator in robot.actuators:
        actuator_id, has_one_control = actuator.id, actuator.controls == 1
        dynamics_type = int(model.actuator_dyntype[actuator_id])
        if dynamics_type not in filter_types or not has_one_control:
            continue
        is_limited = bool(model.actuator_actlimited[actuator_id])
        low, high = model.actuator_actrange[actuator_id] if is_limited else (-np.inf, np.inf)
        activation_filters_of_robot.append(
            ActivationFilter(
                actuator=actuator,
                address=int(model.actuator_actadr[actuator_id]),
                # The first parameter of a filter is its time constant.
                seconds=float(model.actuator_dynprm[actuator_id, 0]),
                exact=dynamics_type == exact_type,
                limits=(float(low), float(high)),
            )
        )
    return tuple(activation_filters_of_robot)


def select_initial_activations(robot: RobotModel, initial: Mapping[str, float]) -> dict[str, float]:
    """Return the activations (outputs of filters before actuators) among a run's initial states.

    Args:
        robot: robot with the filters.
        initial: initial states of the run by name; activations are named ``act.`` and actuator.
    """
    activation_names = {one_filter.state for one_filter in activation_filters(robot)}
    return {name: value for name, value in initial.items() if name in activation_names}


def compute_initial_activation(
    activation_filter: ActivationFilter,
    scenario: Scenario,
    controls: Array,
    step: float,
    is_rk4: bool,
    compute_inputs: Callable[[Scenario, int], Mapping[str, Array]],
) -> Array:
    """Return the activation (n,) of a filter at the start of a run, for n batch elements.

    It is the first of these that is known:

    1. the value that the recording states,
    2. the result of the filter for the commands before the run,
    3. the output of a filter that has settled at the first command.

    Args:
        activation_filter: filter: its actuator, time constant and kind.
        scenario: scenario of the run.
        controls: (n, S) controls of the filter in the S steps of the run.
        step: step length in seconds.
        is_rk4: whether the integrator is Runge-Kutta 4.
        compute_inputs: function that returns the applied inputs (n, S) by name of a scenario, in
            the first S steps of it.
    """
    # 1. Stated value, by the filter's name among the initial states.
    if activation_filter.state in scenario.initial:
        return np.full(len(controls), scenario.initial[activation_filter.state])
    # 3. Without known commands before the run, the filter has settled.
    history = extend_into_past(scenario, step)
    if history is None:
        settled_activation: Array = np.clip(
            activation_filter.clip_controls(controls[:, 0]), *activation_filter.limits
        )
        return settled_activation
    # 2. The filter has settled at the first of the commands before the run.
    earlier_controls = compute_inputs(*history)[f"u.{activation_filter.actuator.name}"]
    first_activation = activation_filter.clip_controls(earlier_controls[:, 0])
    activations = activation_filter.compute_activations(
        earlier_controls, first_activation, step, is_rk4
    )
    last_activation: Array = activations[:, -1]
    return last_activation


def extend_into_past(scenario: Scenario, step: float) -> tuple[Scenario, int] | None:
    """Extend a scenario into the time before the run for which its inputs are known.

    A filter's initial activation follows from the commands before the run. A recording may contain
    them, if the run is a part of a longer one: `Scenario.before` has, for each input, their times
    (negative, in seconds before the run) and values. The extended scenario begins a whole number of
    steps earlier, so that the run's own steps stay the same.

    Args:
        scenario: scenario of the run.
        step: step length in seconds.

    Returns:
        The scenario that begins a whole number of steps earlier, and this number; None if the
        inputs before the run are not known for at least one step.
    """
    known_inputs = [scenario.before[name] for name in scenario.inputs if name in scenario.before]
    # Times of the first known input: negative and increasing, so the first one is the earliest.
    earlier_times = next((times for times, _ in known_inputs), np.empty(0))
    steps = int(np.floor(-earlier_times[0] / step)) if earlier_times.size else 0
    # A scenario has one array of times for all of its inputs.
    have_equal_times = all(np.array_equal(times, earlier_times) for times, _ in known_inputs)
    if steps < 1 or len(known_inputs) < len(scenario.inputs) or not have_equal_times:
        return None
    start_time = -steps * step
    is_included = earlier_times > start_time
    times = np.concatenate(
        [[start_time], earlier_times[is_included], scenario.times - scenario.times[0]]
    )
    inputs = {}
    for name, values in scenario.inputs.items():
        _, earlier_values = scenario.before[name]
        # The value at the start time, which lies between two earlier times: interpolated for a
        # piecewise linear input, else the last earlier value.
        if name in scenario.linear:
            ends = np.append(earlier_times, 0.0), np.append(earlier_values, values[0])
            initial = float(np.interp(start_time, *ends))
        else:
            initial = float(earlier_values[np.flatnonzero(earlier_times <= start_time)[-1]])
        inputs[name] = np.concatenate([[initial], earlier_values[is_included], values])
    # The history (`before`) is part of the inputs here. Switches (`off`) are known in the run only.
    return replace(scenario, times=times - start_time, inputs=inputs, before={}, off={}), steps
