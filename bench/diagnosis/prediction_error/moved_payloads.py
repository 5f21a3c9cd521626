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


def list_moved_payloads(evaluator: RunEvaluator, name: str, c: Array) -> list[tuple[str, Array]]:
    """Return a payload moved to the bodies at the joints of its body.

    The payload stays where it is in space in the mean pose in which the runs begin.

    Args:
        evaluator: the runs.
        name: name of the effect, such as ``payload@forearm``.
        c: (4,) mass in kg, and position in m from the centre of mass of the body.

    Returns:
        Names and coefficients of payloads in the evaluator; empty for any other effect.
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
    body = bodies[place]
    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ (model.body_ipos[body] + c[1:])
    # Bodies without joints move with the body that carries them.
    carrier = model.body_weldid[model.body_parentid]
    moved = []
    for other, number in bodies.items():
        effect = f"payload@{other}"
        is_linked = carrier[number] == body or carrier[body] == number
        if not is_linked or effect not in evaluator.coefficient_slices:
            continue
        frame = data.xmat[number].reshape(3, 3)
        offset = frame.T @ (point - data.xpos[number]) - model.body_ipos[number]
        low, high = np.array(compute_coefficient_bounds(evaluator, effect)).T
        moved.append((effect, np.clip(np.concatenate([c[:1], offset]), low, high)))
    return moved
