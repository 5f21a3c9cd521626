"""Limits of an experimental setup: reject runs that exceed limits of position, speed or force.

Runs are also rejected if bodies touch that did not touch before. The runs are simulated, and all
moving channels are monitored, whether they are recorded or not.

A limit of the model file (`model_file_limits`) holds whatever the present runs did. Where the file
specifies no limit, it follows from the values in the present runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.candidate_runs import CandidateRun
from bench.diagnosis.experiment_design.model_file_limits import Interval, read_model_file_limits
from bench.diagnosis.fitting.fitted_models import FittedModel
from sims.core.simulator import Array, Scenario

TRAVEL_FACTOR = 3.0
"""Distance by which a channel without a specified limit may leave its present range, as a multiple
of that range.
"""
SPEED_AND_FORCE_FACTOR = 2.0
"""Maximum speed and force of a robot's joint without a specified limit, as a multiple of the
present maximum.
"""
STOP_SHARE = 0.01
"""Share of its range by which a joint may press into its stop if it did so in the present runs:
stops are soft in MuJoCo.
"""
IDLE_JOINT_SHARE = 0.1
"""Minimum value used as the present maximum speed and force of a joint that was at rest, as a share
of the maximum over all joints.
"""
ROUNDING_TOLERANCE = 1e-9
"""Distance beyond a limit that counts as rounding, relative to the larger limit."""


class RigLimits:
    """Check of which runs an experimental setup can execute.

    Args:
        evaluator: Run evaluator of the present runs.
        model: Model fitted to them.
    """

    def __init__(self, evaluator: RunEvaluator, model: FittedModel) -> None:
        """Simulate the present runs with the fitted model, and derive the channel limits.

        `present_runs` has the simulated channels of each present run, (T,) by name, and `bounds`
        the lowest and highest value that a proposed run may have, by channel.

        Args:
            evaluator: run evaluator of the present runs.
            model: model fitted to them.
        """
        self.evaluator = evaluator
        fitted_states = model.fit.initial_states
        self.present_runs = self._simulate_monitored_channels(
            model,
            [run_data.scenario for run_data in evaluator.prepared_runs],
            # NaN where a state is not estimated.
            np.where(np.isfinite(fitted_states), fitted_states, evaluator.initial_state_guesses),
        )
        self.bounds = self._determine_bounds()

    def __call__(self, model: FittedModel, runs: Sequence[CandidateRun]) -> list[bool]:
        """Return for each run whether it stays within the limits if a model is true.

        Args:
            model: Model with which the runs are simulated.
            runs: Candidate runs.
        """
        if not runs:
            return []
        states = np.array([run.states for run in runs])
        simulated_channels = self._simulate_monitored_channels(
            model, [run.scenario for run in runs], states
        )
        return [self._is_within_limits(channels) for channels in simulated_channels]

    # -- monitored channels

    @cached_property
    def monitored_channels(self) -> list[str]:
        """Names of the monitored channels.

        For a robot they are positions, velocities and forces of joints; otherwise coordinates,
        rates and observed channels.
        """
        kind = self.evaluator.kind
        if kind.has_model:
            names = {
                f"{quantity}.{joint.name}"
                for joint in self._single_coordinate_joints
                for quantity in ("q", "qd", "tau")
            }
        else:
            names = {*kind.system.coordinates, *kind.system.rates, *self.evaluator.channels}
        return [channel.name for channel in kind.channels if channel.name in names]

    @property
    def _single_coordinate_joints(self) -> list[Any]:
        """The joints of the robot with one coordinate."""
        robot: Any = self.evaluator.kind
        return [joint for joint in robot.robot.joints if joint.has_one_coordinate]

    def _simulate_monitored_channels(
        self, model: FittedModel, scenarios: Sequence[Scenario], states: Array
    ) -> list[Mapping[str, Array]]:
        """Simulate runs with a model, and return all channels that have limits, (T,) by name.

        Channels that are not recorded are simulated too, because a run can damage a robot at a
        joint without a sensor.

        Shapes: T samples, s states of a run.

        Args:
            model: fitted model with which the runs are simulated.
            scenarios: R runs that could be recorded.
            states: (R, s) initial states of these runs.
        """
        evaluator = self.evaluator
        values = {
            parameter.name: float(value)
            for parameter, value in zip(evaluator.parameters, model.fit.theta, strict=True)
        }
        # The simulator of the fit returns the recorded channels only.
        simulator = evaluator.make_observing_simulator(self.monitored_channels, model.effects)
        try:
            # This simulator has the effects of the model only, so its vector is shorter.
            theta = np.array([[values.get(p.name, 0.0) for p in simulator.parameters]])
            # Constants that the fit estimated as parameters.
            freed_constants = {c.name: values[c.name] for c in evaluator.freed_constants}
            model_scenarios = [
                replace(scenario, constants={**scenario.constants, **freed_constants})
                for scenario in scenarios
            ]
            initial = dict(zip(evaluator.state_names, states.T, strict=True))
            result = simulator.simulate_batch(
                np.repeat(theta, len(model_scenarios), 0), model_scenarios, initial
            )
        finally:
            simulator.close()
        evaluator.simulation_count += len(model_scenarios)
        names = [channel.name for channel in simulator.channels]
        # The batch is padded to the longest run.
        return [
            dict(zip(names, channel_values[: scenario.times.size].T, strict=True))
            for channel_values, scenario in zip(result, model_scenarios, strict=True)
        ]

    # -- limits

    def _determine_bounds(self) -> dict[str, tuple[float, float]]:
        """Determine the allowed range of each monitored channel.

        1. A system: the range of the present runs, widened.
        2. A robot: the limit of the model file if it states one.
        3. Otherwise, for positions, the range of the present runs, widened; for speeds and forces,
           a multiple of the largest value in these runs.
        """
        present_ranges = {}
        for name in self.monitored_channels:
            values = np.concatenate([run[name] for run in self.present_runs])
            values = values[np.isfinite(values)]
            present_ranges[name] = (
                (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
            )
        scales = {channel.name: channel.scale for channel in self.evaluator.kind.channels}
        # 1. A system.
        if not self.evaluator.kind.has_model:
            return {
                name: _widen_range(*present_range, scales[name])
                for name, present_range in present_ranges.items()
            }
        stated_limits = read_model_file_limits(self.evaluator).channels
        bounds = {}
        for name, (low, high) in present_ranges.items():
            quantity = name.partition(".")[0]
            # 2. Limits of the model file.
            if name in stated_limits:
                bounds[name] = _widen_by_stop(stated_limits[name], (low, high), quantity == "q")
            # 3. Limits of the present runs.
            elif quantity == "q":
                bounds[name] = _widen_range(low, high, scales[name])
            else:
                # A joint that hardly moved may be as fast as a share of the fastest joint.
                largest_of_all = max(
                    max(map(abs, present_range))
                    for other_name, present_range in present_ranges.items()
                    if other_name.startswith(quantity)
                )
                limit = SPEED_AND_FORCE_FACTOR * max(
                    abs(low), abs(high), IDLE_JOINT_SHARE * largest_of_all
                )
                bounds[name] = -limit, limit
        return bounds

    def _is_within_limits(self, channels: Mapping[str, Array]) -> bool:
        """Return whether a simulated run stays within the limits of all monitored channels.

        In a run of a robot, geoms that did not touch each other in the present runs must not touch
        either.

        Args:
            channels: (T,) simulated values by channel. A run with NaN or infinity is rejected.
        """
        for name, values in channels.items():
            if not np.isfinite(values).all():
                return False
            low, high = self.bounds[name]
            # Values that only exceed a limit by rounding errors are allowed. An infinite limit
            # needs no tolerance, which would be infinite, too.
            is_limited = np.isfinite([low, high]).all()
            tolerance = ROUNDING_TOLERANCE * max(abs(low), abs(high)) if is_limited else 0.0
            if values.min() < low - tolerance or values.max() > high + tolerance:
                return False
        return (
            not self.evaluator.kind.has_model
            or self._find_contacts(channels) <= self._touching_pairs
        )

    @cached_property
    def _touching_pairs(self) -> frozenset[tuple[int, int]]:
        """Pairs of bodies that touched in the present runs."""
        return frozenset().union(*(self._find_contacts(run) for run in self.present_runs))

    def _find_contacts(self, channels: Mapping[str, Array]) -> frozenset[tuple[int, int]]:
        """Return the pairs of geoms (collision shapes) of the robot that touch in a motion.

        Each pair has the numbers of the geoms in MuJoCo.

        Args:
            channels: joint positions of the motion, by channel.
        """
        # This import is needed for robots only.
        from sims.robot.contact_pairs import find_contacts

        return find_contacts(self.evaluator.kind, channels)


def _widen_by_stop(stated_range: Interval, present_range: Interval, is_position: bool) -> Interval:
    """Return the limits of the model file, with a position range widened a little if necessary.

    It is widened to the range of the present runs, but at each end by at most `STOP_SHARE` of the
    range, because a joint may have been pressed into its soft stop.

    Args:
        stated_range: lower and upper limit of the model file.
        present_range: smallest and largest value in the present runs.
        is_position: whether the channel is a position.
    """
    if not is_position:
        return stated_range
    (low, high), (present_low, present_high) = stated_range, present_range
    max_widening = STOP_SHARE * (high - low)
    return (
        max(min(low, present_low), low - max_widening),
        min(max(high, present_high), high + max_widening),
    )


def _widen_range(low: float, high: float, scale: float) -> tuple[float, float]:
    """Return a range with the allowed margin at both ends.

    Args:
        low: lower end of the recorded range.
        high: upper end of the recorded range.
        scale: minimum size of the range from which the margin is computed.
    """
    margin = TRAVEL_FACTOR * max(high - low, scale)
    return low - margin, high + margin
