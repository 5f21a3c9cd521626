"""Limits of an experimental setup: reject runs that exceed limits of position, speed or force.

Runs are also rejected if bodies touch that did not touch before. The runs are simulated, and all
moving channels are monitored, whether they are recorded or not.

A limit of the model file (`experiment_design.candidate_runs`) holds whatever the present runs
did. Where the file specifies no limit, it follows from the values in the present runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.candidate_runs import (
    CandidateRun,
    Interval,
    read_model_file_limits,
)
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.logs.quality.pose_check import find_contacts
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

        A proposed run may not exceed these limits by far, so that it is safe on the real system.

        Args:
            evaluator: Run evaluator of the recording.
            model: Fitted model.
        """
        self.evaluator = evaluator
        self.past = self._simulate_monitored_channels(
            model,
            [run_data.scenario for run_data in evaluator.prepared_runs],
            np.where(
                np.isfinite(model.fit.initial_states),
                model.fit.initial_states,
                evaluator.initial_state_guesses,
            ),
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
        if not kind.has_model:
            monitored_names = {
                *kind.system.coordinates,
                *kind.system.rates,
                *self.evaluator.channels,
            }
            return [c.name for c in kind.channels if c.name in monitored_names]
        names = {
            f"{quantity}.{joint.name}"
            for joint in self._single_coordinate_joints
            for quantity in ("q", "qd", "tau")
        }
        return [c.name for c in kind.channels if c.name in names]

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
            p.name: float(v) for p, v in zip(evaluator.parameters, model.fit.theta, strict=True)
        }
        simulator = evaluator.make_observing_simulator(self.monitored_channels, model.effects)
        try:
            theta = np.array([[values.get(p.name, 0.0) for p in simulator.parameters]])
            freed_constants = {p.name: values[p.name] for p in evaluator.freed_constants}
            model_scenarios = [
                replace(s, constants={**s.constants, **freed_constants}) for s in scenarios
            ]
            initial = dict(zip(evaluator.state_names, states.T, strict=True))
            result = simulator.simulate_batch(
                np.repeat(theta, len(model_scenarios), 0), model_scenarios, initial
            )
        finally:
            simulator.close()
        evaluator.simulation_count += len(model_scenarios)
        names = [channel.name for channel in simulator.channels]
        return [
            dict(zip(names, channel_values[: scenario.times.size].T, strict=True))
            for channel_values, scenario in zip(result, model_scenarios, strict=True)
        ]

    # -- limits

    def _determine_bounds(self) -> dict[str, tuple[float, float]]:
        """Determine the allowed range of each monitored channel.

        1. A system: the range of the recorded runs, widened.
        2. A robot: the limit of the model file if it states one.
        3. Otherwise, for positions, the range of the recorded runs, widened; for speeds and forces,
           a multiple of the largest recorded value.
        """
        # 1. Ranges of the recorded runs.
        recorded_ranges = {}
        for name in self.monitored_channels:
            values = np.concatenate([run[name] for run in self.past])
            values = values[np.isfinite(values)]
            recorded_ranges[name] = (
                (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
            )
        scales = {channel.name: channel.scale for channel in self.evaluator.kind.channels}
        if not self.evaluator.kind.has_model:
            return {
                name: _widen_range(*recorded_ranges[name], scales[name]) for name in recorded_ranges
            }
        # 2. Limits of the model file.
        stated_channels = read_model_file_limits(self.evaluator).channels
        bounds = {}
        for name, (low, high) in recorded_ranges.items():
            if name in stated_channels:
                bounds[name] = _widen_by_stop(
                    stated_channels[name], (low, high), name.startswith("q.")
                )
            # 3. Ranges of the recorded runs, widened.
            elif name.startswith("q."):
                bounds[name] = _widen_range(low, high, scales[name])
            else:
                # A joint that hardly moved may be as fast as a share of the fastest joint.
                kind = name.partition(".")[0]
                largest = max(
                    max(map(abs, limit))
                    for key, limit in recorded_ranges.items()
                    if key.startswith(kind)
                )
                limit = SPEED_AND_FORCE_FACTOR * max(
                    abs(low), abs(high), IDLE_JOINT_SHARE * largest
                )
                bounds[name] = -limit, limit
        return bounds

    def _is_within_limits(self, channels: Mapping[str, Array]) -> bool:
        """Return whether a simulated run stays within the limits of all monitored channels.

        A run of a robot must also not touch bodies that did not touch each other in the present
        runs.

        Args:
            channels: (T,) simulated values by channel. A run with NaN or infinity is rejected.
        """
        for name, values in channels.items():
            low, high = self.bounds[name]
            tolerance = (
                ROUNDING_TOLERANCE * max(abs(low), abs(high))
                if np.isfinite([low, high]).all()
                else 0.0
            )
            if not np.isfinite(values).all():
                return False
            if values.min() < low - tolerance or values.max() > high + tolerance:
                return False
        return (
            not self.evaluator.kind.has_model
            or find_contacts(self.evaluator.kind, channels) <= self._touching_pairs
        )

    @cached_property
    def _touching_pairs(self) -> frozenset[tuple[int, int]]:
        """Pairs of bodies that touched in the present runs."""
        return frozenset().union(*(find_contacts(self.evaluator.kind, run) for run in self.past))


def _widen_by_stop(stated_range: Interval, recorded_range: Interval, is_position: bool) -> Interval:
    """Return the specified limits; a position range is widened a little if stops were pressed.

    Args:
        stated_range: lower and upper limit of the model file.
        recorded_range: smallest and largest recorded value.
        is_position: whether the channel is a position.
    """
    low, high = stated_range
    if not is_position:
        return stated_range
    max_widening = STOP_SHARE * (high - low)
    return max(min(low, recorded_range[0]), low - max_widening), min(
        max(high, recorded_range[1]), high + max_widening
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
