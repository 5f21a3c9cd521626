"""Check the recorded poses of a robot: bodies that touch, and missing poses of floating bodies.

Initial poses are not estimated, and the same commands produce a different motion from a different
initial pose.
"""

from __future__ import annotations

from collections import Counter
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


def find_overlaps(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find bodies of a robot that overlap in most of the recorded poses, or touch in some.

    * Contact forces between bodies that always overlap would act all the time, which is not
      possible in a real robot: the shapes in the model file are too large. A pair counts at most
      once in a pose, with its deepest contact, and only if that is deeper than
      `MIN_OVERLAP_METRES`.
    * Links that touch each other now and then, such as two feet, get contact forces that depend on
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
    from sims.robot.contact_pairs import can_touch, iterate_poses, list_recorded_trees

    robot: Any = kind.robot  # type: ignore[attr-defined]
    model = robot.compiled
    if not can_touch(model):
        return
    recorded_trees = list_recorded_trees(recording, kind)
    # Depth of the overlap in m in each pose with one, by the names of two bodies.
    depths: dict[tuple[str, str], list[float]] = {}
    # Number of poses in which two links touch, by their names.
    touches = Counter[tuple[str, str]]()
    pose_count = 0
    for run in recording.training():
        for data in iterate_poses(kind, run.channels):
            pose_count += 1
            deepest: dict[tuple[str, str], float] = {}
            touching: set[tuple[str, str]] = set()
            for contact in data.contact[: data.ncon]:
                body_ids = model.geom_bodyid[contact.geom]
                names = [model.body(int(body)).name for body in body_ids]
                pair = min(names), max(names)
                # The distance of a contact is negative if the geoms overlap.
                deepest[pair] = max(deepest.get(pair, 0.0), -float(contact.dist))
                are_links = recorded_trees.issuperset(model.body_treeid[body_ids].tolist())
                if are_links and contact.dist < 0.0:
                    touching.add(pair)
            touches.update(touching)
            for pair, depth in deepest.items():
                if depth > MIN_OVERLAP_METRES:
                    depths.setdefault(pair, []).append(depth)
    overlapping = {
        pair: max(values)
        for pair, values in depths.items()
        if len(values) > MIN_OVERLAP_SHARE * pose_count
    }
    for (body, other_body), depth in overlapping.items():
        if robot.format == "urdf":
            remedy = "make their collision shapes smaller"
        else:
            remedy = f'add <contact><exclude body1="{body}" body2="{other_body}"/></contact>'
        yield QualityFinding(
            "overlap",
            f"bodies {body} and {other_body} overlap by up to {1e3 * depth:.3g} mm in "
            f"{len(depths[body, other_body]) / pose_count:.0%} of the recorded poses, so that a "
            "contact force always acts between them",
            f"{remedy} in {robot.path.name}",
        )
    for pair, count in touches.most_common(MAX_TOUCHING_PAIRS):
        if count > MIN_TOUCHING_SHARE * pose_count and pair not in overlapping:
            yield QualityFinding(
                "contact",
                f"links {pair[0]} and {pair[1]} touch each other in {count / pose_count:.0%} of "
                "the recorded poses, so that causes near them may not be found",
                "record a motion in which the robot does not touch itself",
            )


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
