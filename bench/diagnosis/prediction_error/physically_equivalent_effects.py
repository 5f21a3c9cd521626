"""List the effects that may act like a given one, for physical reasons.

- A lag acts like a delay, and a command that comes late nearly like readings that come late.
- The armature of a joint acts like the inertia of the link that it moves, or like its mass if the
  axis is vertical, and a payload near the centre of mass like a heavier body.
- The damping of a servo acts like that of its joint.
- An effect at a joint may act like the same effect at another joint of its kinematic loop.
- A payload near the axis of a joint, or at a joint that hardly moves, acts nearly alike on both
  bodies of the joint.

Some of these responses are far from linear in the coefficients, so that a regression may miss the
equivalent effect. Its coefficients are therefore computed here.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.prediction_error.effects_at_joints import (
    acts_at_joint,
    get_joint_name,
    get_servo_input,
    is_time_shift,
    list_joints_of_effect,
    list_moved_bodies,
)
from sims.core.simulator import Array
from sims.robot.inertia_tensors import compute_inertia_tensors
from sims.robot.robot_simulator import RobotSimulator


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
    joints = list_joints_of_effect(evaluator, name)

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


def list_similar_inertias(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> list[tuple[str, Array]]:
    """Return the effects on mass and inertia that may act like the given one.

    - The armature of a joint may act like the inertia of the link that it moves, and the reverse,
      if nothing else turns the link. The moment of inertia about the axis a is a' I a, with the
      tensor I about the centre of mass.
    - A heavier link may act like the armature of a joint with a vertical axis, where gravity does
      not show the mass.
    - A payload near the centre of mass of a body acts like a heavier body.

    The response to a large inertia or to the place of a payload is far from linear, so that a
    regression may miss these effects.

    Args:
        evaluator: the runs.
        name: name of the effect, such as ``inertia.armature@elbow`` or ``payload@forearm``.
        coefficients: (k,) its coefficients; the first is an armature in kg·m², a relative change of
            the link's mass or inertia, or the mass of the payload in kg.

    Returns:
        Names and coefficients (1,) of effects in the evaluator; empty for any other effect.
    """
    simulator = evaluator.simulator
    if not isinstance(simulator, RobotSimulator):
        return []
    law, _, place = name.partition("@")
    model, similar = simulator.robot.compiled, list[tuple[str, Array]]()
    # The mass of a payload as a relative change of the mass of its body.
    if law == "payload":
        masses = {body.name: float(model.body_mass[body.id]) for body in simulator.robot.bodies}
        if masses.get(place, 0.0) > 0.0:
            similar.append((f"mass.scale@{place}", coefficients[:1] / masses[place]))
    for joint, body in zip(simulator.robot.file_joints, list_moved_bodies(evaluator), strict=True):
        armature, scale = f"inertia.armature@{joint.name}", f"inertia.scale@{body}"
        mass = f"mass.scale@{body}"
        if name not in (armature, scale, mass) or joint.kind != "hinge":
            continue
        link, axis = model.body(body), model.jnt_axis[joint.id]
        (tensor,) = compute_inertia_tensors(link.iquat[None], link.inertia[None])
        moment = float(axis @ tensor @ axis)
        # The armature adds to the moment of inertia, and the other effects change it by a share.
        if name == armature:
            similar.append((scale, coefficients / moment))
            continue
        # A heavier body also has a larger moment of its mass m about the axis, m |a x r|^2.
        if name == mass:
            offset = np.cross(axis, link.ipos - model.jnt_pos[joint.id])
            moment += float(link.mass.item() * offset @ offset)
        similar.append((armature, coefficients * moment))
    # Clip the coefficients to the bounds of the effects that the evaluator has.
    known = [(other, c) for other, c in similar if other in evaluator.coefficient_slices]
    bounds = [np.array(compute_coefficient_bounds(evaluator, other)).T for other, _ in known]
    return [(other, np.clip(c, *ends)) for (other, c), ends in zip(known, bounds, strict=True)]


def list_moved_payloads(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> list[tuple[str, Array]]:
    """Return a payload moved to the bodies that joints connect with its body.

    The response to a payload is not linear in its place, so a regression far from the right place
    does not show that the moved payload acts alike. The payload stays where it is in space in the
    mean pose in which the runs begin; its position is clipped to the bounds of the other body.

    Args:
        evaluator: the runs.
        name: name of the effect, such as ``payload@forearm``.
        coefficients: (4,) mass in kg, and position in m from the centre of mass of the body, in its
            frame.

    Returns:
        Names and coefficients (4,) of payloads in the evaluator; empty for any other effect.
    """
    law, _, place = name.partition("@")
    simulator = evaluator.simulator
    if law != "payload" or not isinstance(simulator, RobotSimulator):
        return []
    # This import is needed for robots only.
    import mujoco

    robot, model = simulator.robot, simulator.robot.compiled
    bodies = {body.name: body.id for body in robot.bodies}
    if place not in bodies:
        return []
    data, coordinates = mujoco.MjData(model), len(simulator.addresses.positions)
    begin = evaluator.initial_state_guesses[:, :coordinates].mean(axis=0)
    data.qpos[simulator.addresses.positions] = begin
    mujoco.mj_kinematics(model, data)
    # Frames of bodies have origin `xpos` and rotation `xmat`; `body_ipos` is the centre of mass.
    body = bodies[place]
    mass, position = coefficients[:1], coefficients[1:]
    # The point mass in the frame of the world.
    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ (model.body_ipos[body] + position)
    # Parent of each body. A body without joints moves with the body to which it is welded.
    parent = model.body_weldid[model.body_parentid]
    moved = []
    for other_name, other in bodies.items():
        effect = f"payload@{other_name}"
        are_linked = parent[other] == body or parent[body] == other
        if not are_linked or effect not in evaluator.coefficient_slices:
            continue
        rotation = data.xmat[other].reshape(3, 3)
        other_position = rotation.T @ (point - data.xpos[other]) - model.body_ipos[other]
        low, high = np.array(compute_coefficient_bounds(evaluator, effect)).T
        moved.append((effect, np.clip(np.concatenate([mass, other_position]), low, high)))
    return moved


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
    damping = simulator.robot.compute_servo_damping(simulator.robot.actuator(servo))
    return (name, damping) if damping > 0.0 else None


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
    # Each loop is a group of joint indices.
    groups = evaluator.simulator.system.loops
    others = {joint for group in groups if joints[place] in group for joint in group}
    names = [
        f"{law}@{get_joint_name(evaluator, joint)}" for joint in sorted(others - {joints[place]})
    ]
    return [other for other in names if other in evaluator.coefficient_slices]
