"""Check the recorded poses of a robot: contacts, overlaps, and initial poses of floating bodies.

Initial poses are not estimated, and the same commands produce a different motion from a different
initial pose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from bench.logs.quality.quality_finding import Anomaly, QualityFinding
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
from sims.recording.recording_description import get_required_state_units
from sims.robot.mujoco_messages import capture_mujoco_warnings

CHECKED_INSTANTS = 100
"""Maximum number of times of a run at which forces or contacts are evaluated."""
MAX_CONTACTS = 12
"""Maximum number of contacts at which effects are candidates."""
_STATIC_TREE = -1
"""Index by which MuJoCo marks bodies that do not move."""


def find_contacts(
    kind: type[Simulator], positions: Mapping[str, Array]
) -> frozenset[tuple[int, int]]:
    """Find pairs of a robot's geoms (collision shapes) that touch during a motion.

    At most `CHECKED_INSTANTS` poses of the motion are evaluated.

    Args:
        kind: Simulator class of the robot.
        positions: (N,) position of each joint at N times, rad or m, by channel; other joints keep
            their initial position.

    Returns:
        Pairs of the geoms' numbers in MuJoCo, the smaller one first.
    """
    pairs: set[tuple[int, int]] = set()
    for data in iterate_poses(kind, positions):
        pairs |= {(int(min(pair)), int(max(pair))) for pair in data.contact.geom[: data.ncon]}
    return frozenset(pairs)


def compute_static_accelerations(run: Run, kind: type[Simulator]) -> Array:
    """Compute accelerations of a robot at rest in recorded positions under recorded commands.

    They show how fast the robot could move, by which time stamps in a wrong unit are found.

    Args:
        run: Run of the robot.
        kind: Simulator class of the robot.

    Returns:
        (N, D) accelerations of the D joints with one coordinate, at N times of the run, at most
        `CHECKED_INSTANTS`.
    """
    joints = [
        joint
        for joint in kind.robot.joints  # type: ignore[attr-defined]
        if joint.has_one_coordinate
    ]
    return np.array(
        [
            [data.qacc[joint.velocity] for joint in joints]
            for data in iterate_poses(kind, run.channels, run.inputs)
        ]
    )


def find_recorded_contacts(recording: Recording, kind: type[Simulator]) -> tuple[str, ...]:
    """Return the pairs of a robot's geoms (collision shapes) that touch in the recorded poses.

    Joints that are not recorded keep their initial position. Contacts that cannot act on a recorded
    joint, such as those of an object that rests on a table next to the robot, are left out.
    Held-out runs are not used.

    Args:
        recording: Recording of the robot.
        kind: Simulator class of the robot.

    Returns:
        Names of at most `MAX_CONTACTS` pairs, the most frequent ones, in alphabetical order.
    """
    # This import is needed for robots only.
    from sims.robot.contact_pairs import make_pair_name

    model = kind.robot.compiled  # type: ignore[attr-defined]
    if not _can_touch(model):
        return ()
    # Number of poses in which a pair of geoms touches.
    counts = Counter[tuple[int, int]]()
    for run in recording.training():
        for data in iterate_poses(kind, run.channels):
            is_touching = data.contact.dist[: data.ncon] <= 0.0
            touching_geoms = data.contact.geom[: data.ncon][is_touching]
            counts.update({(int(min(pair)), int(max(pair))) for pair in touching_geoms})
    # Kinematic trees (bodies connected by joints) in which some joint is recorded. The index of a
    # joint's velocity is that of its degree of freedom.
    recorded_trees = {
        int(model.dof_treeid[joint.velocity])
        for run in recording.training()
        for joint in kind.robot.joints  # type: ignore[attr-defined]
        if f"q.{joint.name}" in run.channels
    }
    acting_pairs = _select_acting_pairs(model, counts, recorded_trees)
    frequent_pairs = Counter({pair: counts[pair] for pair in acting_pairs}).most_common(
        MAX_CONTACTS
    )
    return tuple(sorted({make_pair_name(model, pair) for pair, _ in frequent_pairs}))


def _can_touch(model: Any) -> bool:
    """Return whether any contact can arise in a compiled model.

    Args:
        model: compiled model (mujoco.MjModel).
    """
    # These imports are needed for robots only.
    import mujoco

    from sims.robot.parsing.collision_filters import can_collide

    is_disabled = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    return not is_disabled and can_collide(model)


def _select_acting_pairs(
    model: Any, pairs: Iterable[tuple[int, int]], recorded_trees: Collection[int]
) -> list[tuple[int, int]]:
    """Return the pairs of geoms whose contact can act on a recorded joint.

    A force is passed on within a kinematic tree (bodies connected by joints), and from tree to tree
    at a contact, but not by a body that does not move. Starting from the recorded trees, further
    trees are added until none is reached by a contact any more.

    Args:
        model: Compiled model (mujoco.MjModel).
        pairs: Pairs of geoms that touch.
        recorded_trees: Kinematic trees (`MjModel.body_treeid`) with recorded joints.

    Returns:
        The pairs in their order.
    """
    trees_by_pair = {
        pair: {int(model.body_treeid[model.geom_bodyid[geom]]) for geom in pair} - {_STATIC_TREE}
        for pair in pairs
    }
    reached = set(recorded_trees)
    while True:
        acting = [pair for pair, trees in trees_by_pair.items() if trees & reached]
        newly_reached = reached.union(*(trees_by_pair[pair] for pair in acting))
        if newly_reached == reached:
            return acting
        reached = newly_reached


def iterate_poses(
    kind: type[Simulator], positions: Mapping[str, Array], inputs: Mapping[str, Array] | None = None
) -> Iterator[Any]:
    """Yield MuJoCo's data (mujoco.MjData) of a robot at rest at some of its recorded poses.

    Up to `CHECKED_INSTANTS` poses are evaluated, evenly spaced over the samples. The same object is
    yielded each time, with the contacts and accelerations of the next pose.

    Args:
        kind: simulator class of the robot.
        positions: (T,) positions by channel ``q.JOINT``, rad or m; joints without one, and missing
            samples, have the initial position.
        inputs: (T,) inputs by name; those that are missing are zero.
    """
    import mujoco

    robot = kind.robot  # type: ignore[attr-defined]
    inputs = inputs or {}
    model = robot.compiled
    data = mujoco.MjData(model)
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    sample_count = max((values.size for values in positions.values()), default=0)
    samples = np.unique(np.linspace(0, max(sample_count - 1, 0), CHECKED_INSTANTS).astype(np.intp))
    with capture_mujoco_warnings():
        for sample in samples:
            mujoco.mj_resetData(model, data)
            # `position`, `velocity` and `control` are indices into MuJoCo's arrays.
            for joint in joints:
                values = positions.get(f"q.{joint.name}")
                if values is not None and np.isfinite(values[sample]):
                    data.qpos[joint.position] = values[sample]
                if f"force.{joint.name}" in inputs:
                    data.qfrc_applied[joint.velocity] = inputs[f"force.{joint.name}"][sample]
            for actuator in robot.actuators:
                if f"u.{actuator.name}" in inputs:
                    data.ctrl[actuator.control] = inputs[f"u.{actuator.name}"][sample]
            mujoco.mj_forward(model, data)
            yield data


MIN_OVERLAP_METRES = 1e-3
"""Smallest depth, in m, at which two bodies overlap; feet on the ground sink in by less."""
MIN_OVERLAP_SHARE = 0.9
"""Smallest share of the recorded poses in which bodies overlap that do so by their shape."""


def find_overlaps(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find bodies of a robot that overlap in most of the recorded poses.

    Contact forces would then act all the time, which is not possible in a real robot: the shapes
    in the model file are too large. A pair counts at most once in a pose, with its deepest contact,
    and only if that is deeper than `MIN_OVERLAP_METRES`. Held-out runs are not used.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.
    """
    if not kind.has_model:
        return
    robot: Any = kind.robot  # type: ignore[attr-defined]
    model = robot.compiled
    if not _can_touch(model):
        return
    # Depth of the overlap in m in each pose with one, by the names of two bodies.
    depths: dict[tuple[str, str], list[float]] = {}
    pose_count = 0
    for run in recording.training():
        for data in iterate_poses(kind, run.channels):
            pose_count += 1
            deepest: dict[tuple[str, str], float] = {}
            for contact in data.contact[: data.ncon]:
                bodies = [model.body(int(model.geom_bodyid[g])).name for g in contact.geom]
                pair = min(bodies), max(bodies)
                deepest[pair] = max(deepest.get(pair, 0.0), -float(contact.dist))
            for pair, depth in deepest.items():
                if depth > MIN_OVERLAP_METRES:
                    depths.setdefault(pair, []).append(depth)
    for (body, other_body), values in depths.items():
        if len(values) > MIN_OVERLAP_SHARE * pose_count:
            if robot.format == "urdf":
                remedy = "make their collision shapes smaller"
            else:
                remedy = f'add <contact><exclude body1="{body}" body2="{other_body}"/></contact>'
            yield QualityFinding(
                "overlap",
                f"bodies {body} and {other_body} overlap by up to {1e3 * max(values):.3g} mm in "
                f"{len(values) / pose_count:.0%} of the recorded poses, so that a contact force "
                "always acts between them",
                f"{remedy} in {robot.path.name}",
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
        if names.count(run.name) > 1:  # two parts of a single run
            missing_text = (
                f"where {joint} is when the last third of a single run begins; record another"
            )
        else:
            missing_text = (
                f"where {joint} begins; state [runs.{run.name}.initial], of {', '.join(states)} "
                "(states that are left out are as in the model file, at rest)"
            )
        yield Anomaly(f"run {run.name}: the log does not state {missing_text}", True)
