"""Move a payload to a neighbouring body.

A point mass near the axis of a joint, or at a joint that hardly moves, acts nearly alike on both
bodies of the joint. The response to a payload is not linear in its place, so a regression far from
the right place does not show this; the moved payload does.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.simulator import Array
from sims.robot.robot_simulator import RobotSimulator


def list_moved_payloads(
    evaluator: RunEvaluator, name: str, coefficients: Array
) -> list[tuple[str, Array]]:
    """Return a payload moved to the bodies that joints connect with its body.

    The payload stays where it is in space in the mean pose in which the runs begin; its position is
    clipped to the bounds of the other body.

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
