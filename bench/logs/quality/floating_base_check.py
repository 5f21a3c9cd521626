"""Check that a recording states the initial poses of floating bodies.

Initial poses are not estimated, and the same commands produce a different motion from a different
initial pose.
"""

from __future__ import annotations

from collections.abc import Iterator

from bench.logs.quality.anomaly import Anomaly
from sims.core.simulator import Simulator
from sims.recording.recording import Recording
from sims.recording.recording_description import get_floating_state_units


def find_missing_base_poses(recording: Recording, kind: type[Simulator]) -> Iterator[Anomaly]:
    """Find floating joints whose initial state is missing in some run.

    Only the first run without the state is reported for each joint.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        One certain anomaly for each such joint.
    """
    states_by_joint: dict[str, list[str]] = {}
    for name in get_floating_state_units(kind):
        joint = name.split(".", 1)[1].rpartition(".")[0]
        states_by_joint.setdefault(joint, []).append(name)
    for joint, states in states_by_joint.items():
        incomplete_runs = (run for run in recording.runs if run.initial.keys().isdisjoint(states))
        run = next(incomplete_runs, None)
        if run is None:
            continue
        names = [recorded_run.name for recorded_run in recording.runs]
        if names.count(run.name) > 1:
            missing_text = (
                f"where {joint} is when the last third of a single run begins; record another"
            )
        else:
            missing_text = (
                f"where {joint} begins; state [runs.{run.name}.initial], of {', '.join(states)}"
            )
            missing_text = (
                f"{missing_text} (states that are left out are as in the model file, at rest)"
            )
        yield Anomaly(f"run {run.name}: the log does not state {missing_text}", True)
