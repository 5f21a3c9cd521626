"""Joints at which effects act, and the effects that act alike at a joint.

The effects of the standard joint and servo models are those that are tried first at a joint. Others
imitate one another: delays of commands and of sensors, or an effect at the joints of a closed loop.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import Effect, members_of
from sims.core.simulator import Array
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.inertia_tensors import compute_inertia_tensors
from sims.robot.robot_simulator import RobotSimulator

JOINT_MODEL = ("friction.coulomb", "drag.linear", "inertia.armature")
"""Effects of the standard joint model, tried at the joint with the largest missing force."""
LINK_MODEL = ("inertia.scale",)
"""Effects of the link that the joint moves, whose inertia acts nearly as the armature does."""
SERVO_MODEL = ("actuator.stiffness", "actuator.damping")
"""Effects of the standard servo model, tried at the servo of the same joint."""
SET_POINT_MODEL = ("servo.derivative",)
"""Effects of the set point of the same servo: whether its D term acts on the error, as in a PID."""
MANY_SHAPES = frozenset(
    {
        "force.periodic",
        "force.ripple",
        "friction.position",
        "friction.stribeck",
        "friction.warming",
        "sensor.slip",
        "state.limit",
    }
)
"""Effects with many candidate shapes, tried only if simpler effects leave a force missing."""
EFFECTS_AT_SEVERAL_JOINTS = frozenset({"joint.axis", "joint.coupling", "joint.zero"})
"""Effects at a joint that change the forces at other joints as well."""


def get_joint_name(evaluator: RunEvaluator, joint: int) -> str:
    """Return the name of a joint, that of its coordinate ``q.NAME`` without the prefix.

    After the joints with one coordinate, the filter has the directions in which floating joints
    move, such as ``base.wx``. No effect has such a place.

    Args:
        evaluator: the runs.
        joint: index of the joint, or of the direction after the joints.
    """
    system = evaluator.simulator.system
    if joint < len(system.coordinates):
        return str(system.coordinates[joint]).removeprefix("q.")
    directions = [name for name in system.floating_state_units if name.startswith("qd.")]
    return directions[joint - len(system.coordinates)].removeprefix("qd.")


def get_servo_input(evaluator: RunEvaluator, joint: int) -> str:
    """Return the name of the input of a joint's position servo, such as ``u.elbow``; empty if none.

    Args:
        evaluator: the runs.
        joint: index of the joint.
    """
    return str(getattr(evaluator.simulator.system, "servos", {}).get(joint, ""))


def acts_at_joint(evaluator: RunEvaluator, name: str, joints: Collection[int]) -> bool:
    """Return whether an effect acts at one of the given joints.

    Args:
        evaluator: the runs.
        name: name of the effect.
        joints: indices of the joints.
    """
    names = {get_joint_name(evaluator, joint) for joint in joints}
    # Effects at sensors have no coordinate, but a signal such as ``q.elbow``.
    return any(
        member.coordinate in joints or member.signal.partition(".")[2] in names
        for member in members_of(evaluator.available_effects[name])
    )


def _list_joints(evaluator: RunEvaluator, name: str) -> set[int]:
    """Return the indices of the joints at which an effect acts."""
    count = len(evaluator.simulator.system.coordinates)
    return {joint for joint in range(count) if acts_at_joint(evaluator, name, {joint})}


def get_only_joint(evaluator: RunEvaluator, name: str) -> int | None:
    """Return the index of the single joint at which an effect changes the generalised force.

    The result is None for

    - effects at bodies (without a coordinate) and at sensors;
    - families, which act at every place, and effects that change forces at other joints as well;
    - joints in series with others, and joints of a kinematic loop.

    Args:
        evaluator: the runs.
        name: name of the effect.
    """
    member, *others = members_of(evaluator.available_effects[name])
    if (
        others
        or member.coordinate is None
        or member.hook == "sensor"
        or member.of in EFFECTS_AT_SEVERAL_JOINTS
        or is_series_effect(member)
        or any(member.coordinate in group for group in evaluator.simulator.system.loops)
    ):
        return None
    joint: int = member.coordinate
    return joint


def list_joint_model_effects(evaluator: RunEvaluator, name: str) -> set[str]:
    """Return the effects of the joint and servo models at the joints where an effect acts.

    These simple effects (Coulomb friction, drag, armature, stiffness and damping of the servo)
    often imitate another effect at the same joint. Families (effects at every place, ``@*``) are
    left out, unless the effect is one.

    Args:
        evaluator: the runs.
        name: name of the effect; at a body, the joints are those that move this body against its
            parent.
    """
    joints = _list_joints(evaluator, name)
    if evaluator.available_effects[name].at == "body":
        body = name.partition("@")[2]
        joints = {
            joint for joint, moved in enumerate(list_moved_bodies(evaluator)) if moved == body
        }
    return {
        other
        for other in evaluator.library
        if other.partition("@")[0] in JOINT_MODEL + SERVO_MODEL
        and (name.endswith("@*") or not other.endswith("@*"))
        and acts_at_joint(evaluator, other, joints)
    }


def list_similar_shifts(evaluator: RunEvaluator, name: str) -> list[str]:
    """Return the delays and lags that may change the readings as a given delay or lag does.

    A command that comes late changes the readings nearly as sensors that read late do. Similar to
    an effect at a joint are those at the same joint, and to one at all places (``@*``) those at all
    places. An effect that exists at a single place only, as the command of a robot with one drive,
    is similar to both.

    Args:
        evaluator: the runs.
        name: name of the effect; the result is empty if it is neither a delay nor a lag.
    """
    if not is_time_shift(evaluator.available_effects[name]):
        return []
    joints = _list_joints(evaluator, name)

    def has_one_place(effect: str) -> bool:
        """Return whether the effect has no family ``@*``, because it has a single place."""
        return f"{effect.partition('@')[0]}@*" not in evaluator.library

    return [
        other
        for other in evaluator.library
        if other != name
        and is_time_shift(evaluator.available_effects[other])
        and acts_at_joint(evaluator, other, joints)
        and (
            other.endswith("@*") == name.endswith("@*")
            or has_one_place(other)
            or has_one_place(name)
        )
    ]


def is_time_shift(effect: Effect) -> bool:
    """Return whether an effect is a delay or a lag, with one coefficient."""
    return [c.of for c in effect.coefficients] == ["shift"]


def list_moved_bodies(evaluator: RunEvaluator) -> list[str]:
    """Return the name of the body that each joint moves against its parent body.

    The inertia of such a body and the armature of its joint may have the same effect.

    Args:
        evaluator: the runs of a robot.
    """
    assert isinstance(evaluator.simulator, RobotSimulator)
    model = evaluator.simulator.robot.compiled
    return [model.body(b).name for b in model.dof_bodyid[evaluator.simulator.addresses.velocities]]


def list_similar_inertias(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> list[tuple[str, Array]]:
    """Return the effects on mass and inertia that may act like the given one.

    - The armature of a joint may act like the inertia of the link that it moves, and the reverse,
      if nothing else turns the link. The moment of inertia about the axis a is a' I a, with the
      tensor I about the centre of mass.
    - A payload near the centre of mass of a body acts like a heavier body.

    The response to a large inertia or to the place of a payload is far from linear, so that a
    regression may miss these effects.

    Args:
        evaluator: the runs.
        name: name of the effect, such as ``inertia.armature@elbow`` or ``payload@forearm``.
        coefficients: (k,) its coefficients; the first is an armature in kg·m², a relative change of
            the link's inertia, or the mass of the payload in kg.

    Returns:
        Names and coefficients (1,) of effects in the evaluator; empty for any other effect.
    """
    simulator = evaluator.simulator
    if not isinstance(simulator, RobotSimulator):
        return []
    law, _, place = name.partition("@")
    model, similar = simulator.robot.compiled, list[tuple[str, Array]]()
    if law == "payload":
        masses = {body.name: float(model.body_mass[body.id]) for body in simulator.robot.bodies}
        if masses.get(place, 0.0) > 0.0:
            similar.append((f"mass.scale@{place}", coefficients[:1] / masses[place]))
    for joint, body in zip(simulator.robot.file_joints, list_moved_bodies(evaluator), strict=True):
        armature, scale = f"inertia.armature@{joint.name}", f"inertia.scale@{body}"
        if name not in (armature, scale) or joint.kind != "hinge":
            continue
        link, axis = model.body(body), model.jnt_axis[joint.id]
        (tensor,) = compute_inertia_tensors(link.iquat[None], link.inertia[None])
        moment = float(axis @ tensor @ axis)
        other, factor = (scale, 1.0 / moment) if name == armature else (armature, moment)
        similar.append((other, coefficients * factor))
    # Clip the coefficients to the bounds of the effects that the evaluator has.
    known = [(other, c) for other, c in similar if other in evaluator.coefficient_slices]
    bounds = [np.array(compute_coefficient_bounds(evaluator, other)).T for other, _ in known]
    return [(other, np.clip(c, *ends)) for (other, c), ends in zip(known, bounds, strict=True)]


def get_servo_damping(evaluator: RunEvaluator, joint: int) -> tuple[str, float] | None:
    """Return the effect that scales a servo's damping, and the damping of its joint per unit of it.

    Args:
        evaluator: the runs of a robot.
        joint: index of the joint.

    Returns:
        Name of the effect, and the damping in N·m·s/rad (N·s/m for a slider) that it adds to the
        joint by a relative change of 1; None if no servo with a known damping drives the joint.
    """
    simulator = evaluator.simulator
    servo = get_servo_input(evaluator, joint).removeprefix("u.")
    name = f"actuator.damping@{servo}"
    if not isinstance(simulator, RobotSimulator) or name not in evaluator.library:
        return None
    # The third bias parameter of MuJoCo's servo is minus its damping.
    actuator, model = simulator.robot.actuator(servo).id, simulator.robot.compiled
    gear, servo_damping = model.actuator_gear[actuator, 0], -model.actuator_biasprm[actuator, 2]
    damping = float(gear**2 * servo_damping)
    return (name, damping) if damping > 0.0 else None


def list_similar_dampings(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> list[tuple[str, Array]]:
    """Return the damping of the servo for that of its joint, and the reverse.

    Both are the same force unless the servo is at its force limit. There the joint may chatter, so
    that a regression finds a wrong coefficient of one of them.

    Args:
        evaluator: the runs.
        name: name of the effect, such as ``drag.linear@elbow`` or ``actuator.damping@servo``.
        coefficients: (1,) its coefficient.

    Returns:
        Name and coefficient (1,) of the other effect, if the evaluator has it.
    """
    for joint in range(len(evaluator.simulator.system.coordinates)):
        servo_damping = get_servo_damping(evaluator, joint)
        if servo_damping is None:
            continue
        servo_effect, damping = servo_damping
        joint_effect = f"drag.linear@{get_joint_name(evaluator, joint)}"
        if name == servo_effect and joint_effect in evaluator.coefficient_slices:
            return [(joint_effect, coefficients * damping)]
        if name == joint_effect:
            return [(servo_effect, coefficients / damping)]
    return []


def list_at_coupled_joints(evaluator: RunEvaluator, name: str) -> list[str]:
    """Return the names of an effect at the other joints of its kinematic loop.

    It may act equivalently there: the joints of a loop move together, and some are not measured.

    Args:
        evaluator: the runs.
        name: name of the effect.

    Returns:
        Names of effects with coefficients in the evaluator; empty if the effect does not act at a
        joint, or if no constraint of the model couples the joint to others.
    """
    law, _, place = name.partition("@")
    count = len(evaluator.simulator.system.coordinates)
    joints = {get_joint_name(evaluator, joint): joint for joint in range(count)}
    if place not in joints:
        return []
    groups = evaluator.simulator.system.loops
    others = {joint for group in groups if joints[place] in group for joint in group}
    names = [
        f"{law}@{get_joint_name(evaluator, joint)}" for joint in sorted(others - {joints[place]})
    ]
    return [other for other in names if other in evaluator.coefficient_slices]


def has_series(evaluator: RunEvaluator, names: Iterable[str]) -> bool:
    """Return whether some effects are joints in series with others, which have their own states.

    Args:
        evaluator: the runs, with all available effects.
        names: names of effects.
    """
    return any(is_series_effect(evaluator.available_effects[name]) for name in names)


def has_many_shapes(name: str) -> bool:
    """Return whether an effect is one of `MANY_SHAPES`."""
    return name.partition("@")[0] in MANY_SHAPES
