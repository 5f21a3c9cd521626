"""Effects at the joints of a robot: where they act, and which are equivalent."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import members_of
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.places.coupled_joints import coupled_joints
from sims.robot.robot_simulator import RobotSimulator

JOINT_MODEL = ("friction.coulomb", "drag.linear", "inertia.armature")
"""Effects of the standard joint model, tried at the joint with the largest missing force."""
SERVO_MODEL = ("actuator.stiffness", "actuator.damping")
"""Effects of the standard servo model, tried at the servo of the same joint."""
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
OFFSET_THRESHOLD = 10.0
"""Minimum difference of positions, as a multiple of the noise, that is an encoder offset."""


def get_joint_name(evaluator: RunEvaluator, joint: int) -> str:
    """Return the name of a joint.

    Args:
        evaluator: the runs.
        joint: index of the joint.
    """
    coordinate: str = evaluator.simulator.system.coordinates[joint]
    return coordinate.removeprefix("q.")


def get_servo_input(evaluator: RunEvaluator, joint: int) -> str:
    """Return the input of the position servo of a joint; empty if it has none.

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
    return any(
        member.coordinate in joints or member.signal.partition(".")[2] in names
        for member in members_of(evaluator.available_effects[name])
    )


def list_joint_model_effects(evaluator: RunEvaluator, name: str) -> set[str]:
    """Return the effects of the joint and servo models at the joint where an effect acts.

    Args:
        evaluator: the runs.
        name: name of the effect.
    """
    count = len(evaluator.simulator.system.coordinates)
    joints = {joint for joint in range(count) if acts_at_joint(evaluator, name, {joint})}
    return {
        other
        for other in evaluator.library
        if other.partition("@")[0] in JOINT_MODEL + SERVO_MODEL
        and not other.endswith("@*")
        and acts_at_joint(evaluator, other, joints)
    }


def list_at_coupled_joints(evaluator: RunEvaluator, name: str) -> list[str]:
    """Return the names of an effect at the other joints of its kinematic loop.

    It may act equivalently there, because a filter gives little information on unmeasured joints.

    Args:
        evaluator: the runs.
        name: name of the effect.
    """
    law, _, place = name.partition("@")
    count = len(evaluator.simulator.system.coordinates)
    joints = {get_joint_name(evaluator, joint): joint for joint in range(count)}
    if place not in joints:
        return []
    assert isinstance(evaluator.simulator, RobotSimulator)
    velocities = evaluator.simulator.addresses.velocities.tolist()
    groups = coupled_joints(evaluator.simulator.make_linearisation_batch().model, velocities)
    others = {joint for group in groups if joints[place] in group for joint in group}
    names = [
        f"{law}@{get_joint_name(evaluator, joint)}" for joint in sorted(others - {joints[place]})
    ]
    return [other for other in names if other in evaluator.coefficient_slices]


def has_series(evaluator: RunEvaluator, names: Iterable[str]) -> bool:
    """Return whether some effects are joints in series with others, which have their own states."""
    return any(is_series_effect(evaluator.available_effects[name]) for name in names)


def has_many_shapes(name: str) -> bool:
    """Return whether an effect is one of `MANY_SHAPES`."""
    return name.partition("@")[0] in MANY_SHAPES


def offset_from_command(evaluator: RunEvaluator, noise: NoiseModel, joint: int) -> float:
    """Return the mean difference of a joint's readings from the command of its position servo.

    Args:
        evaluator: the runs.
        noise: sensor noise.
        joint: index of the joint.

    Returns:
        The difference; zero without a servo, or if the difference is small.
    """
    system, servo = evaluator.simulator.system, get_servo_input(evaluator, joint)
    channel = system.coordinates[joint]
    if not servo or channel not in evaluator.channels:
        return 0.0
    column = evaluator.channels.index(channel)
    differences = [
        track.observed[:, column] - system.gear(joint) * track.scenario.inputs[servo]
        for track in evaluator.prepared_runs
        if servo in track.scenario.inputs
    ]
    offset = float(np.nanmean(np.concatenate(differences))) if differences else 0.0
    return offset if abs(offset) > OFFSET_THRESHOLD * noise.sigma[column] else 0.0
