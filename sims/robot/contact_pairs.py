"""Pairs of geoms that touch: found in the poses of a motion, and as elements `<pair>` of a model.

A contact has the parameters of both geoms in combination. An element `<pair>` replaces them for one
pair, so that friction and softness of a pair can be changed without changing other contacts of its
geoms. The combined parameters are those of MuJoCo (documentation, "Computation", contact
parameters): of the geom with the higher priority; otherwise the larger friction coefficients and
dimension, and `solref` and `solimp` as a mean with the weights `solmix`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array, Simulator, make_unknown_name_error
from sims.recording.recording import Recording
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.parsing.collision_filters import can_collide
from sims.robot.robot_model import RobotModel, cache_per_robot

PAIR_SEPARATOR = "/"
"""Separator of the names of two geoms in the name of a pair, such as ``floor/foot``."""
UNNAMED_PREFIX = "simgap."
"""Prefix of the names that are given to unnamed geoms, such as ``simgap.geom3``."""
MIN_MIX = 1e-15
"""Weight `solmix` below which a geom has no weight (MuJoCo's mjMINVAL)."""
CHECKED_INSTANTS = 100
"""Maximum number of times of a run at which forces or contacts are evaluated."""
MAX_CONTACTS = 12
"""Maximum number of contacts at which effects are candidates."""
_STATIC_TREE = -1
"""Index by which MuJoCo marks bodies that do not move."""


class ContactParameters(NamedTuple):
    """Combined parameters of a contact: those of an element `<pair>`."""

    condim: int
    friction: Array
    solref: Array
    solimp: Array
    margin: float
    gap: float


def get_geom_name(model: Any, geom: int) -> str:
    """Return the name of a geom in the model file; such as ``geom3`` if it has none there.

    The prefix of names that `add_contact_pairs` gave to unnamed geoms is removed.

    Args:
        model: compiled model.
        geom: number of the geom.
    """
    return str(model.geom(geom).name).removeprefix(UNNAMED_PREFIX) or f"geom{geom}"


def make_pair_name(model: Any, geoms: Collection[int]) -> str:
    """Return the name of a pair of geoms of the whole model, the smaller number first."""
    return PAIR_SEPARATOR.join(get_geom_name(model, geom) for geom in sorted(geoms))


def find_pair_geoms(robot: RobotModel, pair: str) -> tuple[int, int]:
    """Return the numbers of the two geoms of a pair.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        pair: names of both geoms, joined by `PAIR_SEPARATOR`.

    Returns:
        Numbers of the geoms in the compiled model, in the order of their names in `pair`.

    Raises:
        InputError: there are no such geoms; the message lists the existing ones.
    """
    model = robot.compiled
    geom_ids = {get_geom_name(model, geom): geom for geom in range(model.ngeom)}
    # The name of a geom may contain the separator, so each way to divide `pair` into two is tried.
    parts = pair.split(PAIR_SEPARATOR)
    for count in range(1, len(parts)):
        names = (PAIR_SEPARATOR.join(part) for part in (parts[:count], parts[count:]))
        first, second = (geom_ids.get(name) for name in names)
        if first is not None and second is not None:
            return first, second
    unknown = next((name for name in parts if name not in geom_ids), pair)
    raise make_unknown_name_error(f"geom of {robot.path.name}", unknown, list(geom_ids) or ["none"])


def find_geom(robot: RobotModel, name: str) -> int:
    """Return the number of a geom in the compiled model.

    Args:
        robot: robot with the geom.
        name: name of the geom; unnamed ones are called ``geom3`` and so on.

    Raises:
        InputError: there is no such geom; the message lists the existing ones.
    """
    model = robot.compiled
    names = [get_geom_name(model, geom) for geom in range(model.ngeom)]
    if name not in names:
        raise make_unknown_name_error(f"geom of {robot.path.name}", name, names or ["none"])
    return names.index(name)


def combine_contact_parameters(model: Any, geoms: tuple[int, int]) -> ContactParameters:
    """Return the parameters that MuJoCo gives to a contact of two geoms.

    The geom with the higher priority determines them. With equal priorities, spring and damper
    (`solref`) and impedance (`solimp`) are averaged with the weights `solmix` of the geoms, and the
    larger friction counts. Margins and gaps are added in both cases.

    Args:
        model: compiled model.
        geoms: numbers of the two geoms.
    """
    geom_rows = np.array(geoms)
    margin, gap = float(model.geom_margin[geom_rows].sum()), float(model.geom_gap[geom_rows].sum())
    priority = model.geom_priority[geom_rows]
    # One geom remains, or both if their priorities are equal.
    geom_rows = geom_rows[priority == priority.max()]
    mixes = np.where(model.geom_solmix[geom_rows] < MIN_MIX, 0.0, model.geom_solmix[geom_rows])
    if not mixes.any():  # Neither geom has a weight, so both count equally.
        mixes = np.ones(len(geom_rows))
    weights = mixes / mixes.sum()
    solref = model.geom_solref[geom_rows]
    # Negative numbers are a stiffness and a damping in place of a time constant and a damping
    # ratio. MuJoCo does not average them.
    has_direct_form = (solref[:, 0] <= 0).any()
    sliding, torsional, rolling = model.geom_friction[geom_rows].max(axis=0)
    return ContactParameters(
        condim=int(model.geom_condim[geom_rows].max()),
        # A pair has two coefficients for the two tangents, and two for the rolling axes.
        friction=np.array([sliding, sliding, torsional, rolling, rolling]),
        solref=solref.min(axis=0) if has_direct_form else weights @ solref,
        solimp=weights @ model.geom_solimp[geom_rows],
        margin=margin,
        gap=gap,
    )


@cache_per_robot
def find_pair(robot: RobotModel, pair: str) -> int:
    """Return the number of the element `<pair>` of two geoms in the compiled model.

    The order of the two geoms does not matter.

    Args:
        robot: robot with this element, such as a result of `add_contact_pairs`.
        pair: names of both geoms, joined by `PAIR_SEPARATOR`.
    """
    model, geoms = robot.compiled, set(find_pair_geoms(robot, pair))
    return next(
        number
        for number in range(model.npair)
        if {int(model.pair_geom1[number]), int(model.pair_geom2[number])} == geoms
    )


def has_pair(robot: RobotModel, geoms: Collection[int]) -> bool:
    """Return whether the model has an element `<pair>` of two geoms.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        geoms: numbers of the two geoms.
    """
    model = robot.compiled
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return set(geoms) in [set(pair) for pair in pairs]


def read_contact_parameters(robot: RobotModel, pair: str) -> tuple[float, Array]:
    """Return the sliding friction coefficient and `solref` of a contact of two geoms.

    MuJoCo's `solref` is the time constant and the damping ratio of a contact, or its negative
    stiffness and damping. The numbers are those of the element `<pair>` of the contact, or the
    combined ones of both geoms without an element.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        pair: names of both geoms, joined by `PAIR_SEPARATOR`.

    Returns:
        The friction coefficient, and `solref` (2,).
    """
    geoms = find_pair_geoms(robot, pair)
    if has_pair(robot, geoms):
        pair_index = find_pair(robot, pair)
        model = robot.compiled
        return float(model.pair_friction[pair_index, 0]), model.pair_solref[pair_index]
    combined = combine_contact_parameters(robot.compiled, geoms)
    return float(combined.friction[0]), combined.solref


def add_contact_pairs(robot: RobotModel, pairs: Collection[str]) -> RobotModel:
    """Add elements `<pair>` to a robot, with the parameters that the contacts have already.

    A pair has its own parameters, so that an effect can change one contact without the others.
    Pairs refer to geoms by name, so geoms without one get a name.

    Args:
        robot: robot, whose elements keep their names and numbers.
        pairs: names of the pairs; those with an element are left out.
    """
    model = robot.compiled
    missing_pairs = [find_pair_geoms(robot, pair) for pair in sorted(set(pairs))]
    missing_pairs = [geoms for geoms in missing_pairs if not has_pair(robot, geoms)]
    if not missing_pairs:
        return robot
    spec = robot.spec.copy()
    if not all(geom.name for geom in spec.geoms):
        # Elements have numbers only after compilation, and lose them when one is edited, so the
        # numbers are listed before.
        with capture_mujoco_warnings():
            spec.compile()
        for geom, number in [(geom, geom.id) for geom in spec.geoms]:
            geom.name = geom.name or f"{UNNAMED_PREFIX}geom{number}"
    for geoms in missing_pairs:
        parameters = combine_contact_parameters(model, geoms)
        first_name, second_name = (
            model.geom(geom).name or UNNAMED_PREFIX + get_geom_name(model, geom) for geom in geoms
        )
        spec.add_pair(
            name=make_pair_name(model, geoms),
            geomname1=first_name,
            geomname2=second_name,
            **parameters._asdict(),
        )
    return replace(robot, spec=spec)


def find_contacts(
    kind: type[Simulator], positions: Mapping[str, Array]
) -> frozenset[tuple[int, int]]:
    """Find pairs of a robot's geoms (collision shapes) that touch during a motion.

    At most `CHECKED_INSTANTS` poses of the motion are evaluated.

    Args:
        kind: simulator class of the robot.
        positions: (N,) position of each joint at N times, rad or m, by channel; other joints keep
            their initial position.

    Returns:
        Pairs of the geoms' numbers in MuJoCo, the smaller one first.
    """
    pairs: set[tuple[int, int]] = set()
    for data in iterate_poses(kind, positions):
        pairs |= {(int(min(pair)), int(max(pair))) for pair in data.contact.geom[: data.ncon]}
    return frozenset(pairs)


def find_recorded_contacts(recording: Recording, kind: type[Simulator]) -> tuple[str, ...]:
    """Return the pairs of a robot's geoms (collision shapes) that touch in the recorded poses.

    Joints that are not recorded keep their initial position. Contacts that cannot act on a recorded
    joint, such as those of an object that rests on a table next to the robot, are left out.
    Held-out runs are not used.

    Args:
        recording: recording of the robot.
        kind: simulator class of the robot.

    Returns:
        Names of at most `MAX_CONTACTS` pairs, the most frequent ones, in alphabetical order.
    """
    model = kind.robot.compiled  # type: ignore[attr-defined]
    if not can_touch(model):
        return ()
    # Number of poses in which a pair of geoms touches.
    counts = Counter[tuple[int, int]]()
    for run in recording.training():
        for data in iterate_poses(kind, run.channels):
            is_touching = data.contact.dist[: data.ncon] <= 0.0
            touching_geoms = data.contact.geom[: data.ncon][is_touching]
            counts.update({(int(min(pair)), int(max(pair))) for pair in touching_geoms})
    acting_pairs = _select_acting_pairs(model, counts, list_recorded_trees(recording, kind))
    frequent_pairs = Counter({pair: counts[pair] for pair in acting_pairs}).most_common(
        MAX_CONTACTS
    )
    return tuple(sorted({make_pair_name(model, pair) for pair, _ in frequent_pairs}))


def list_recorded_trees(recording: Recording, kind: type[Simulator]) -> set[int]:
    """Return the kinematic trees (`MjModel.body_treeid`) in which some joint is recorded.

    A kinematic tree consists of bodies that joints connect. Held-out runs are not used.

    Args:
        recording: recording of the robot.
        kind: simulator class of the robot.
    """
    robot = kind.robot  # type: ignore[attr-defined]
    # The index of a joint's velocity is that of its degree of freedom.
    return {
        int(robot.compiled.dof_treeid[joint.velocity])
        for run in recording.training()
        for joint in robot.joints
        if f"q.{joint.name}" in run.channels
    }


def can_touch(model: Any) -> bool:
    """Return whether any contact can arise in a compiled model.

    Args:
        model: compiled model (mujoco.MjModel).
    """
    import mujoco

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
        model: compiled model (mujoco.MjModel).
        pairs: pairs of geoms that touch.
        recorded_trees: kinematic trees (`MjModel.body_treeid`) with recorded joints.

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
