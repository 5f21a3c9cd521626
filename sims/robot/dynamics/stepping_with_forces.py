"""Steps of a batch with effect forces that are evaluated in every step.

If possible, the program of the effects runs in MuJoCo's callback
(`sims.robot.dynamics.mujoco_callback`). Otherwise MuJoCo returns to Python in each step, with the
same numbers, which takes ten times as long as a step of a small robot.
"""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array
from sims.robot.dynamics.disabled_drives import iterate_constant_stretches
from sims.robot.dynamics.effect_force_program import StepForces
from sims.robot.dynamics.midpoint_state import Mask, MidpointPredictor
from sims.robot.dynamics.mujoco_batch import MujocoBatch
from sims.robot.dynamics.mujoco_callback import CallbackContexts, find_callback


def step_with_forces(
    mujoco_batch: MujocoBatch,
    controls: Array,
    forces: Array,
    step_forces: StepForces,
    record: list[str],
    off: Mask,
) -> dict[str, Array]:
    """Step n batch elements S times with effects that are evaluated in every step.

    1. Set the solver parameters of dry friction of effects.
    2. If possible, let MuJoCo call the compiled program of the effects (a callback) within all
       steps.
    3. Otherwise let MuJoCo make one step at a time, and evaluate the effects before it.

    In both cases MuJoCo evaluates the initial state with the first controls before the first step.

    Args:
        mujoco_batch: the batch, with initial states and effects in its model.
        controls: (n, S, nu) controls.
        forces: (n, S, nv) generalised forces.
        step_forces: effects to evaluate.
        record: fields of MuJoCo's data to record.
        off: (n, S, K) whether each of K actuators is switched off.

    Returns:
        Recorded fields (n, S, ...) by name.
    """
    # 1. Dry friction: (n, D) whether effects add it, and the friction of the model without them.
    n, has_friction = len(controls), step_forces.has_dry_friction
    positions, dofs = step_forces.addresses.positions, step_forces.addresses.velocities
    file_friction = mujoco_batch.fields["dof_frictionloss"][:n, dofs].copy()
    if has_friction.any():
        batch_indices, joints = np.nonzero(has_friction)
        mujoco_batch.prepare_dry_friction(batch_indices, dofs[joints])
    ctrl = mujoco_batch.batch.bind("ctrl")
    # This precedes MuJoCo's first evaluation, since fields that are bound later would not contain
    # it.
    predictor = MidpointPredictor(mujoco_batch.batch, positions, dofs, step_forces.loaded)
    # 2. Callback.
    callback = find_callback(mujoco_batch, step_forces)
    if callback is not None:
        ctrl[:n] = controls[:, 0]
        mujoco_batch.batch.forward(mujoco_batch.get_element_ids(n))
        step_forces.begin(predictor.read_joint_states(np.zeros(n, dtype=bool)))
        contexts = CallbackContexts(mujoco_batch, step_forces, file_friction, controls.shape[1])
        with contexts.use(callback):
            return mujoco_batch.step(
                controls, forces, record, before_call=contexts.reset_accelerations
            )
    # 3. Single steps.
    friction_field = mujoco_batch.fields["dof_frictionloss"]
    all_forces = forces.copy()
    # Where a control changes, or an actuator is switched, at the beginning of a step (n, S).
    changes: Mask = np.any(np.diff(controls, axis=1, prepend=controls[:, :1]) != 0, axis=2)
    changes[:, [stretch.start for stretch in iterate_constant_stretches(off)]] = True

    def set_forces(k: int) -> None:
        """Evaluate the effects at the predicted middle of step k, and add their forces to it."""
        ctrl[:n] = controls[:, k]
        if k == 0:
            # Before other steps, MuJoCo's data has the joint states after the preceding step.
            mujoco_batch.batch.forward(mujoco_batch.get_element_ids(n))
        force, limit = step_forces.compute(k, predictor.read_joint_states(changes[:, k]))
        all_forces[:, k, dofs] += force
        if has_friction.any():
            friction_field[:n, predictor.dof_indices] = file_friction + np.maximum(limit, 0.0)

    return mujoco_batch.step(controls, all_forces, record, off, set_forces, steps_per_call=1)
