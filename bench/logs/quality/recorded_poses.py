"""Accelerations and contacts of a robot's model in recorded poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
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
    """Find pairs of a robot's geoms that touch at some of `CHECKED_INSTANTS` times of a motion.

    Args:
        kind: Simulator class of the robot.
        positions: (N,) position of each joint, rad or m, by channel; other joints keep their
            initial position.
    """
    pairs: set[tuple[int, int]] = set()
    for data in iterate_poses(kind, positions):
        pairs |= {(int(min(pair)), int(max(pair))) for pair in data.contact.geom[: data.ncon]}
    return frozenset(pairs)


def compute_static_accelerations(run: Run, kind: type[Simulator]) -> Array:
    """Compute accelerations of a robot at rest in recorded positions under recorded commands.

    Args:
        run: Run with the positions and commands.
        kind: Simulator class of the robot.

    Returns:
        (N, D) accelerations at up to `CHECKED_INSTANTS` times of the run.
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
    """Return the names of the pairs of a robot's geoms that touch in the recorded poses.

    Joints that are not recorded keep their initial position. Contacts that cannot act on a recorded
    joint, such as those of an object that rests on a table next to the robot, are left out.

    Args:
        recording: Recording of the robot.
        kind: Simulator class of the robot.

    Returns:
        Names of at most `MAX_CONTACTS` pairs, the most frequent ones, in alphabetical order.
    """
    # This import is needed for robots only.
    from sims.robot.contact_pairs import make_pair_name

    model = kind.robot.compiled  # type: ignore[attr-defined]
    counts = Counter[tuple[int, int]]()
    for run in recording.training():
        for data in iterate_poses(kind, run.channels):
            touching = data.contact.geom[: data.ncon][data.contact.dist[: data.ncon] <= 0.0]
            counts.update({(int(min(pair)), int(max(pair))) for pair in touching})
    recorded_trees = {
        int(model.dof_treeid[joint.velocity])
        for run in recording.training()
        for joint in kind.robot.joints  # type: ignore[attr-defined]
        if f"q.{joint.name}" in run.channels
    }
    acting = Counter({p: counts[p] for p in _select_acting_pairs(model, counts, recorded_trees)})
    frequent_pairs = acting.most_common(MAX_CONTACTS)
    return tuple(sorted({make_pair_name(model, pair) for pair, _ in frequent_pairs}))


def _select_acting_pairs(
    model: Any, pairs: Iterable[tuple[int, int]], recorded_trees: Collection[int]
) -> list[tuple[int, int]]:
    """Return the pairs of geoms whose contact can act on a recorded joint.

    A force is passed on within a kinematic tree, and from tree to tree at a contact, but not by a
    body that does not move.

    Args:
        model: Compiled model (mujoco.MjModel).
        pairs: Pairs of geoms that touch.
        recorded_trees: Kinematic trees (`MjModel.body_treeid`) with recorded joints.
    """
    trees_by_pair = {
        pair: {int(model.body_treeid[model.geom_bodyid[geom]]) for geom in pair} - {_STATIC_TREE}
        for pair in pairs
    }
    reached = set(recorded_trees)
    while True:
        acting = [pair for pair, trees in trees_by_pair.items() if trees & reached]
        larger = reached.union(*(trees_by_pair[pair] for pair in acting))
        if larger == reached:
            return acting
        reached = larger


def iterate_poses(
    kind: type[Simulator], positions: Mapping[str, Array], inputs: Mapping[str, Array] | None = None
) -> Iterator[Any]:
    """Yield MuJoCo's data (mujoco.MjData) of a robot at rest at some of its recorded poses.

    The same object is yielded each time, with up to `CHECKED_INSTANTS` poses one after another.
    Commands and forces that `inputs` lacks are zero.
    """
    import mujoco

    robot = kind.robot  # type: ignore[attr-defined]
    inputs = inputs or {}
    model = robot.compiled
    data = mujoco.MjData(model)
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    count = max((values.size for values in positions.values()), default=0)
    rows = np.unique(np.linspace(0, max(count - 1, 0), CHECKED_INSTANTS).astype(np.intp))
    with capture_mujoco_warnings():
        for row in rows:
            mujoco.mj_resetData(model, data)
            for joint in joints:
                values = positions.get(f"q.{joint.name}")
                if values is not None and np.isfinite(values[row]):
                    data.qpos[joint.position] = values[row]
                if f"force.{joint.name}" in inputs:
                    data.qfrc_applied[joint.velocity] = inputs[f"force.{joint.name}"][row]
            for actuator in robot.actuators:
                if f"u.{actuator.name}" in inputs:
                    data.ctrl[actuator.control] = inputs[f"u.{actuator.name}"][row]
            mujoco.mj_forward(model, data)
            yield data
