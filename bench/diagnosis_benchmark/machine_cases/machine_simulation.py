"""Integration of machine motion by Runge-Kutta 4 with dry friction; applied inputs and encoders.

Within a step, each joint with dry friction either keeps its direction of motion or is stuck. If a
joint comes to rest within a step, the rest of that step is computed separately: the joint sticks,
or continues with friction in the other direction (E. Hairer, S. P. Norsett, G. Wanner, Solving
Ordinary Differential Equations I, 1993, section II.6, for steps up to a change of the law).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import (
    SENSOR_EFFECTS,
    STEPWISE_INPUT_EFFECTS,
)
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import Effects, MachineDynamics
from sims.core.simulator import Array

SMOOTH_STEP_SECONDS = 1e-3
"""Step size without dry friction, seconds."""
FRICTION_STEP_SECONDS = 5e-4
"""Step size with dry friction, seconds."""
_BREAK_AWAY_TOLERANCE = 1e-9
"""Relative amount by which a force must exceed the dry friction limit to break a joint away."""


class MachineRuns(NamedTuple):
    """Runs of equal length, simulated together.

    Attributes:
        times: evenly spaced times from the first sample, seconds, (T,).
        commands: commands, each held until the next sample, (L, T, N).
        q: initial positions, (L, N).
        v: initial velocities, (L, N).
    """

    times: Array
    commands: Array
    q: Array
    v: Array


class MachineMotion(NamedTuple):
    """Simulated motion.

    Attributes:
        times: times of the steps, (K,).
        q: positions, (K, L, N).
        v: velocities, (K, L, N).
    """

    times: Array
    q: Array
    v: Array


def simulate_machine(
    plant: MachineDynamics, runs: MachineRuns, coarse: float = 1.0
) -> MachineMotion:
    """Simulate the motion of a machine, with equal steps that divide each sampling interval.

    Args:
        plant: machine with its parameters and hidden causes.
        runs: initial states and commands.
        coarse: factor of the step size; above 1 is faster and less accurate.

    Returns:
        The motion at the times of all steps.
    """
    sampling_interval = runs.times[1] - runs.times[0]
    max_step = coarse * (
        FRICTION_STEP_SECONDS if plant.has_dry_friction.any() else SMOOTH_STEP_SECONDS
    )
    # Steps per sampling interval; the small number prevents a further step by rounding.
    parts = int(np.ceil(sampling_interval / max_step - 1e-9))
    times = np.linspace(0.0, runs.times[-1], (len(runs.times) - 1) * parts + 1)
    applied_inputs = compute_applied_inputs(runs, plant, times)
    integrator = _MachineIntegrator(plant, runs.q, runs.v)
    q, v = [integrator.q], [integrator.v]
    for step_index, time in enumerate(times[:-1].tolist()):
        integrator.step(time, float(times[step_index + 1]) - time, applied_inputs[:, step_index])
        q.append(integrator.q)
        v.append(integrator.v)
    return MachineMotion(times, np.array(q), np.array(v))


class _MachineIntegrator:
    """Integrator of L runs of a machine with N joints by Runge-Kutta 4, with dry friction.

    Attributes:
        q: positions, (L, N).
        v: velocities, (L, N).
        dry: whether any joint has dry friction.
        sliding_direction: direction of motion of joints with dry friction: -1, 0 or 1, (L, N).
        held: whether each joint is stuck, (L, N).
    """

    def __init__(self, plant: MachineDynamics, q: Array, v: Array) -> None:
        """Start at given positions and velocities.

        `dry` tells whether any joint has dry friction. The first step decides which joints are
        stuck (`held`) and in which direction the others slide.

        Shapes: L runs, N joints.

        Args:
            plant: machine with its parameters and hidden causes.
            q: initial positions, (L, N).
            v: initial velocities, (L, N).
        """
        self.plant, self.q, self.v = plant, q.copy(), v.copy()
        self.has_friction = plant.has_dry_friction
        self.dry = bool(self.has_friction.any())
        self.sliding_direction = np.zeros_like(q)
        self.held = np.zeros(q.shape, dtype=bool)

    def step(self, t: float, h: float, u: Array) -> None:
        """Make one step of the Runge-Kutta method of order 4.

        With dry friction, the direction of friction is fixed for the step; joints that come to rest
        within it are corrected afterwards.

        Shapes: L runs, N joints.

        Args:
            t: time at the beginning of the step, s.
            h: length of the step, s.
            u: mean applied input over the step, (L, N).
        """
        if self.dry:  # some joint has dry friction
            self._update_stuck_joints(t, u)
        q, v = self.q, self.v
        a1 = self._compute_accelerations(t, q, v, u)
        v2 = v + 0.5 * h * a1
        a2 = self._compute_accelerations(t + 0.5 * h, q + 0.5 * h * v, v2, u)
        v3 = v + 0.5 * h * a2
        a3 = self._compute_accelerations(t + 0.5 * h, q + 0.5 * h * v2, v3, u)
        v4 = v + h * a3
        a4 = self._compute_accelerations(t + h, q + h * v3, v4, u)
        self.q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        self.v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        if self.dry:
            self._recompute_stopped_joints(t, h, u, v)

    def _compute_accelerations(self, t: float, q: Array, v: Array, u: Array) -> Array:
        """Compute the accelerations (L, N), with dry friction against the direction of motion.

        Shapes: L runs, N joints.

        Args:
            t: time, s.
            q: positions, (L, N).
            v: velocities, (L, N).
            u: applied input, (L, N).
        """
        force = self.plant.compute_force(t, q, v, u)
        if self.dry:
            force = force - self.sliding_direction * self.plant.compute_friction_limit(q, v)
        return self._solve_accelerations(q, force)

    def _solve_accelerations(self, q: Array, force: Array) -> Array:
        """Solve M q'' = force for the accelerations (L, N); those of stuck joints are zero.

        Shapes: L runs, N joints.

        Args:
            q: positions, (L, N).
            force: generalised forces, (L, N).
        """
        is_free = ~self.held
        inertia = self.plant.compute_mass_matrix(q)
        if self.held.any():
            # Rows and columns of stuck joints become those of the identity matrix.
            inertia = np.where(is_free[:, :, None] & is_free[:, None], inertia, 0.0)
            inertia += np.eye(q.shape[1]) * self.held[:, :, None]
            force = np.where(is_free, force, 0.0)
        is_single_joint = q.shape[1] == 1
        solved = (
            force / inertia[:, 0]
            if is_single_joint
            else np.linalg.solve(inertia, force[:, :, None])[..., 0]
        )
        return np.asarray(solved, dtype=np.float64)

    def _update_stuck_joints(self, t: float, u: Array) -> None:
        """Decide which joints at rest are stuck, and in which direction the others move.

        A joint breaks away if holding it needs more force than its friction limit.

        Shapes: L runs, N joints.

        Args:
            t: time, s.
            u: applied input, (L, N).
        """
        resting = self.has_friction & (self.v == 0.0)
        self.sliding_direction = np.where(self.has_friction & ~resting, np.sign(self.v), 0.0)
        self.held = resting  # all at first; those that break away are released below
        if not resting.any():
            return
        limit = self.plant.compute_friction_limit(self.q, self.v)
        force = self.plant.compute_force(t, self.q, self.v, u) - self.sliding_direction * limit
        accelerations = self._solve_accelerations(self.q, force)
        # Force needed to hold a joint still while the others move.
        holding_force = force - np.einsum(
            "lij,lj->li", self.plant.compute_mass_matrix(self.q), accelerations
        )
        loose = resting & (np.abs(holding_force) > limit * (1 + _BREAK_AWAY_TOLERANCE))
        self.sliding_direction = np.where(loose, np.sign(holding_force), self.sliding_direction)
        self.held = resting & ~loose

    def _recompute_stopped_joints(
        self, t: float, h: float, u: Array, velocity_before: Array
    ) -> None:
        """Recompute the rest of the step for joints that came to rest within it.

        The time of rest is estimated by linear interpolation of the velocity. For the time that is
        left (`remaining_time`), the joint sticks or moves with constant acceleration.

        Shapes: L runs, N joints.

        Args:
            t: time at the beginning of the step, s.
            h: length of the step, s.
            u: applied input, (L, N).
            velocity_before: velocities at the beginning of the step, (L, N).
        """
        # The velocity has changed its sign against the direction of friction.
        has_stopped = (self.sliding_direction * self.v < 0.0) & (
            self.sliding_direction * velocity_before >= 0.0
        )
        if not has_stopped.any():
            return
        # On the line from `velocity_before` to v, the part after zero is the share v / (v - v0).
        with np.errstate(divide="ignore", invalid="ignore"):
            remaining_time = np.where(has_stopped, self.v / (self.v - velocity_before), 0.0) * h
        # The motion after the time of rest, in the wrong direction, is taken back.
        q = self.q - np.where(has_stopped, 0.5 * self.v * remaining_time, 0.0)
        v = np.where(has_stopped, 0.0, self.v)
        self.q, self.v = q, v
        self._update_stuck_joints(t + h, u)
        # Zero for a joint that sticks, otherwise with friction in the new direction.
        onward = np.where(has_stopped, self._compute_accelerations(t + h, q, v, u), 0.0)
        self.q, self.v = q + 0.5 * onward * remaining_time**2, v + onward * remaining_time


def compute_applied_inputs(runs: MachineRuns, plant: MachineDynamics, times: Array) -> Array:
    """Compute the mean applied input over each step, after the hidden effects on the command.

    Effects without memory act first, then delay and lag.

    Shapes: L runs, N joints.

    Args:
        runs: the runs with their commands.
        plant: machine with its parameters and hidden causes.
        times: times at which the K steps begin and end, s, (K + 1,).

    Returns:
        Applied inputs, (L, K, N).
    """
    run_count, _, joints = runs.commands.shape
    applied_inputs = np.empty((run_count, len(times) - 1, joints))
    for joint, motor in enumerate(plant.motors):
        input_effects = select_signal_effects(plant.effects, "input.", motor)
        for run in range(run_count):
            levels: Array = runs.commands[run, :, joint]
            for name, coefficients in input_effects.items():
                # These functions change each level by itself, as a gain or a dead band does.
                if name in STEPWISE_INPUT_EFFECTS:
                    levels = STEPWISE_INPUT_EFFECTS[name](levels, *coefficients)
            (delay,) = input_effects.get("input.delay", (0.0,))
            (lag,) = input_effects.get("input.lag", (0.0,))
            applied_inputs[run, :, joint] = _average_input(runs.times, levels, times, delay, lag)
    return applied_inputs


def _average_input(stamps: Array, levels: Array, times: Array, delay: float, lag: float) -> Array:
    """Average an input over each step, with a zero-order hold, a delay and a lag.

    A simulation step with the mean input changes the velocity as the true input does. Averages are
    exact: they are differences of the integral of the input, divided by the step.

    Args:
        stamps: sample times, s, (T,).
        levels: input at each sample, held until the next one, (T,).
        times: times at which the K steps begin and end, s, (K + 1,).
        delay: delay, s.
        lag: time constant of a first-order lag, s; 0 for none.

    Returns:
        Averages, (K,).
    """
    # The last level holds for one second more, so that the integral reaches beyond the last step.
    end_times = np.append(stamps[1:], times[-1] + 1.0)
    integral_at_samples = np.concatenate([[0.0], np.cumsum(levels * (end_times - stamps))])
    delayed_times = times - delay

    def integrate(t: Array) -> Array:
        """Return the integral of the held input from 0 to t; before 0 it has its first level."""
        held_integral: Array = np.interp(t, np.append(stamps, end_times[-1]), integral_at_samples)
        return np.where(t < 0, levels[0] * t, held_integral)

    input_integral = integrate(delayed_times)
    if lag > 0:
        # x' = (u - x) / lag, so the integral of x is that of u minus lag times the change of x.
        input_integral = input_integral - lag * _apply_lag(stamps, levels, delayed_times, lag)
    return np.diff(input_integral) / np.diff(times)


def _apply_lag(stamps: Array, levels: Array, query_times: Array, lag: float) -> Array:
    """Evaluate a first-order lag of the levels at given times; it starts at the first level.

    Between samples the lag approaches a constant level exponentially, so the result is exact.

    Args:
        stamps: sample times, s, (T,).
        levels: input at each sample, held until the next one, (T,).
        query_times: K times, s, (K,).
        lag: time constant, s.

    Returns:
        Lagging input at the given times, (K,).
    """
    lagged_at_samples = np.empty_like(levels)
    lagged_at_samples[0] = levels[0]
    # Share of the distance to the level that remains at the end of each interval.
    decay = np.exp(-np.diff(stamps) / lag)
    for level_index in range(len(stamps) - 1):
        lagged_at_samples[level_index + 1] = (
            levels[level_index]
            + (lagged_at_samples[level_index] - levels[level_index]) * decay[level_index]
        )
    sample_before = np.clip(np.searchsorted(stamps, query_times, side="right") - 1, 0, None)
    seconds_since = np.maximum(query_times - stamps[sample_before], 0.0)
    lagged: Array = levels[sample_before] + (
        lagged_at_samples[sample_before] - levels[sample_before]
    ) * np.exp(-seconds_since / lag)
    return lagged


def read_encoders(motion: MachineMotion, plant: MachineDynamics, times: Array) -> Array:
    """Compute the encoder readings at the sample times.

    Shapes: L runs, T samples, N joints.

    Args:
        motion: simulated motion.
        plant: machine with its parameters and hidden causes.
        times: sample times, (T,).

    Returns:
        Readings, (L, T, N).
    """
    _, runs, joints = motion.q.shape
    readings = np.empty((runs, len(times), joints))
    for joint, channel in enumerate(plant.channels):
        sensor_effects = select_signal_effects(plant.effects, "sensor.", channel)
        (delay,) = sensor_effects.get("sensor.delay", (0.0,))
        delayed_times = np.maximum(times - delay, 0.0)
        values = _interpolate_positions(motion, delayed_times)[:, :, joint].T
        for name in ("sensor.gain", "sensor.bias", "sensor.drift"):
            if name in sensor_effects:
                # Times since the first sample are those of the recording: it starts at zero.
                values = SENSOR_EFFECTS[name](values, sensor_effects[name], times, times)
        readings[:, :, joint] = values
    return readings


def select_signal_effects(
    effects: Effects, prefix: str, place: str
) -> dict[str, tuple[float, ...]]:
    """Select the effects on one motor or channel: those at it, and those without a place.

    Args:
        effects: coefficients by name, with or without a place.
        prefix: begin of the names of the effects, such as ``input.``, or several.
        place: name of the motor or channel.

    Returns:
        Coefficients by name without the place.
    """
    return {
        name.partition("@")[0]: tuple(coefficients)
        for name, coefficients in effects.items()
        if name.startswith(prefix) and name.partition("@")[2] in ("", place)
    }


def _interpolate_positions(motion: MachineMotion, query_times: Array) -> Array:
    """Interpolate positions (T, L, N) by cubic Hermite polynomials, which use velocities too.

    Shapes: L runs, T samples, N joints.

    Args:
        motion: simulated motion with steps of equal length.
        query_times: times, s, (T,).
    """
    step = motion.times[1] - motion.times[0]
    interval = np.clip((query_times / step).astype(int), 0, len(motion.times) - 2)
    # Relative time within the interval, 0 to 1; velocities are per interval.
    s = ((query_times - motion.times[interval]) / step)[:, None, None]
    q0, q1 = motion.q[interval], motion.q[interval + 1]
    v0, v1 = motion.v[interval] * step, motion.v[interval + 1] * step
    positions: Array = (
        q0 * (1 + 2 * s) * (1 - s) ** 2
        + v0 * s * (1 - s) ** 2
        + q1 * s**2 * (3 - 2 * s)
        + v1 * s**2 * (s - 1)
    )
    return positions
