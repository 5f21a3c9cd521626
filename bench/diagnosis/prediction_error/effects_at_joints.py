"""Joints at which effects act, and the effects that are tried first at a joint.

These are the effects of the standard joint and servo models. They often imitate other effects at
the same joint.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import Effect, members_of
from sims.robot.dynamics.series_joints import is_series_effect
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

    A family, one effect at all places, acts there if one of its members does.

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


def list_joints_of_effect(evaluator: RunEvaluator, name: str) -> set[int]:
    """Return the indices of the joints at which an effect acts.

    Args:
        evaluator: the runs.
        name: name of the effect.
    """
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
    # Only a family has other members.
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
    joints = list_joints_of_effect(evaluator, name)
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
