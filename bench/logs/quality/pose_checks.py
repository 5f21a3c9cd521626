"""Check the recorded poses of a robot: bodies that touch, and missing poses of floating bodies.

Initial poses are not estimated, and the same commands produce a different motion from a different
initial pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bench.logs.quality.quality_finding import Anomaly, QualityFinding
from sims.core.simulator import Simulator
from sims.recording.recording import Recording
from sims.recording.recording_description import get_required_state_units

MIN_OVERLAP_METRES = 1e-3
"""Smallest depth, in m, at which two bodies overlap; feet on the ground sink in by less."""
MIN_OVERLAP_SHARE = 0.9
"""Smallest share of the recorded poses in which bodies overlap that do so by their shape."""
MIN_TOUCHING_SHARE = 0.05
"""Smallest share of the recorded poses in which links touch each other that is reported."""
MAX_TOUCHING_PAIRS = 3
"""Maximum number of pairs of links that are reported for touching each other."""


def find_body_contacts(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find bodies of a robot that overlap in most of the recorded poses, or touch in some.

    * Contact forces between bodies that always overlap would act all the time, which is not
      possible in a real robot: the shapes in the model file are too large. Only contacts deeper
      than `MIN_OVERLAP_METRES` count.
    * Links that sometimes touch each other, such as two feet, get contact forces that depend on
      small differences of their shapes and positions. Contacts with objects and with the
      surroundings do not count.

    Held-out runs are not used.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.
    """
    if not kind.has_model:
        return
    # This import is needed for robots only.
    from sims.robot.contact_pairs import can_touch, list_recorded_trees

    robot: Any = kind.robot  # type: ignore[attr-defined]
    model = robot.compiled
    if not can_touch(model):
        return
    pose_count, depths = _measure_contact_depths(recording, kind)
    recorded_trees = list_recorded_trees(recording, kind)
    touching: list[tuple[float, str]] = []
    for pair, values in depths.items():
        body, other_body = sorted(model.body(number).name for number in pair)
        overlaps = [depth for depth in values if depth > MIN_OVERLAP_METRES]
        if len(overlaps) > MIN_OVERLAP_SHARE * pose_count:
            if robot.format == "urdf":
                remedy = "make their collision shapes smaller"
            else:
                remedy = f'add <contact><exclude body1="{body}" body2="{other_body}"/></contact>'
            yield QualityFinding(
                "overlap",
                f"bodies {body} and {other_body} overlap by up to {1e3 * max(overlaps):.3g} mm in "
                f"{len(overlaps) / pose_count:.0%} of the recorded poses, so that a contact force "
                "always acts between them",
                f"{remedy} in {robot.path.name}",
            )
        elif recorded_trees.issuperset(model.body_treeid[list(pair)].tolist()):
            touching.append((len(values) / pose_count, f"links {body} and {other_body}"))
    for share, links in sorted(touching, reverse=True)[:MAX_TOUCHING_PAIRS]:
        if share > MIN_TOUCHING_SHARE:
            yield QualityFinding(
                "contact",
                f"{links} touch each other in {share:.0%} of the recorded poses, so that causes "
                "near them may not be found",
                "record a motion in which the robot does not touch itself",
            )


def _measure_contact_depths(
    recording: Recording, kind: type[Simulator]
) -> tuple[int, dict[tuple[int, int], list[float]]]:
    """Measure how deep bodies of a robot overlap in the recorded poses, without held-out runs.

    Args:
        recording: recording of the robot.
        kind: simulator class of the robot.

    Returns:
        Number of poses; and by the numbers of two bodies the depth in m of their deepest contact in
        each pose with one.
    """
    from sims.robot.contact_pairs import iterate_poses

    model = kind.robot.compiled  # type: ignore[attr-defined]
    pose_count = 0
    depths: dict[tuple[int, int], list[float]] = {}
    for run in recording.training():
        for data in iterate_poses(kind, run.channels):
            pose_count += 1
            deepest: dict[tuple[int, int], float] = {}
            for contact in data.contact[: data.ncon]:
                first, second = sorted(model.geom_bodyid[contact.geom].tolist())
                # The distance of a contact is negative if the geoms overlap.
                if contact.dist < 0.0:
                    depth = max(deepest.get((first, second), 0.0), -float(contact.dist))
                    deepest[first, second] = depth
            for pair, depth in deepest.items():
                depths.setdefault(pair, []).append(depth)
    return pose_count, depths


def find_missing_base_poses(recording: Recording, kind: type[Simulator]) -> Iterator[Anomaly]:
    """Find floating joints whose initial state is missing in some run.

    No sensor of a usual log shows where a free body begins, and the fit does not estimate it, so
    the description must state it, at least in part, unless closed loops determine it. Only the
    first run without any state of the joint is reported.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        One certain anomaly for each such joint.
    """
    states_by_joint: dict[str, list[str]] = {}
    for name in get_required_state_units(kind):
        # The name of a state is that of its quantity, joint and coordinate: q.hull.x.
        joint = name.split(".", 1)[1].rpartition(".")[0]
        states_by_joint.setdefault(joint, []).append(name)
    names = [run.name for run in recording.runs]
    for joint, states in states_by_joint.items():
        runs_without_state = (
            run for run in recording.runs if run.initial.keys().isdisjoint(states)
        )
        run = next(runs_without_state, None)
        if run is None:
            continue
        # A single run is divided in two parts with the same name, of which the second one is held
        # out; its first state cannot be stated.
        if names.count(run.name) > 1:
            missing_text = (
                f"where {joint} is when the last third of a single run begins; record another"
            )
        else:
            missing_text = (
                f"where {joint} begins; state [runs.{run.name}.initial], of {', '.join(states)} "
                "(states that are left out are as in the model file, at rest)"
            )
        yield Anomaly(f"run {run.name}: the log does not state {missing_text}", True)
