"""Leave out the start of runs in which the filters of a robot's actuators settle.

The activation of a filter at the start of a run is not recorded. For a robot at rest it equals the
first command, MuJoCo starts it at zero, and in a log that was cut out of a motion it can have any
value. After a few time constants nothing depends on it, and the commands up to then are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sims.core.simulator import Simulator
from sims.recording.recording import Recording, Run

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

MAX_SETTLING_SHARE = 0.5
"""Maximum share of a run that may be left out."""

SETTLING_TIME_CONSTANTS = 10.0
"""Number of time constants after which a wrong initial activation has no effect.

The remaining share exp(-10) is less than the accuracy of a simulation.
"""


def leave_out_settling(recording: Recording, kind: type[Simulator]) -> tuple[Recording, str]:
    """Leave out the first samples of runs whose first activations (filter outputs) are not known.

    The output of a filter before an actuator depends on commands before the run, but after a few
    time constants this influence is negligible (the filter has settled). A run keeps all of its
    samples if its filters take more than half of it to settle, or if the robot has floating bodies,
    whose later poses are not recorded; its filters then begin at the first commands.

    Args:
        recording: Recording as it was read.
        kind: Simulator class of its system.

    Returns:
        The recording, and a message for the user, which is empty if nothing is left out.
    """
    if not kind.has_model:
        return recording, ""
    robot: Any = kind
    # Nothing to do for floating bodies, which have required initial states, or without filters.
    if robot.system.required_state_units or not robot.system.activations:
        return recording, ""
    from sims.robot.dynamics.activation_filters import activation_filters

    runs: list[Run] = []
    left_out = 0.0  # longest start of a run that is left out, s
    # Settling time if no initial activation is stated, s.
    longest_settling = compute_settling_time(robot.robot, {})
    for run in recording.runs:
        # The commands before a part of the run are kept for as long as its filters depend on them.
        run = replace(run, memory=max(run.memory, longest_settling))
        # Recorded commands before the run, or stated initial activations, determine the filters.
        settling = 0.0 if run.before else compute_settling_time(robot.robot, run.initial)
        first = int(np.searchsorted(run.times, run.times[0] + settling))
        if 0 < settling <= MAX_SETTLING_SHARE * (run.times[-1] - run.times[0]):
            left_out = max(left_out, settling)
            run = run.part(slice(first, None))
        runs.append(run)
    if not left_out:
        return recording, ""
    filters = activation_filters(robot.robot)
    names = ", ".join(state_filter.actuator.name for state_filter in filters)
    note = (
        f"the first {left_out:.3g} s of runs are left out, in which the filters of {names} settle: "
        "their first activations are not recorded (state them if they are known: "
        f'[runs.NAME.initial] "{filters[0].state}" = 0.0)'
    )
    return replace(recording, runs=tuple(runs)), note


def compute_settling_time(robot: RobotModel, initial: Mapping[str, float]) -> float:
    """Return the time in seconds after which no filter depends on its initial activation.

    Filters whose initial activation is specified are ignored. The slowest of the others decides:
    the time is `SETTLING_TIME_CONSTANTS` times its time constant, or zero without such filters.

    Args:
        robot: robot with the filters before its actuators.
        initial: initial states of the run, by name.
    """
    # This import is needed for robots only.
    from sims.robot.dynamics.activation_filters import activation_filters

    unknown_filters = [
        one_filter for one_filter in activation_filters(robot) if one_filter.state not in initial
    ]
    return SETTLING_TIME_CONSTANTS * max(
        (one_filter.seconds for one_filter in unknown_filters), default=0.0
    )
