"""Steps of a batch with effect forces that are evaluated in every step.

If possible, the program of the effects runs in MuJoCo's callback
(`sims.engines.compiled.mujoco_callback`). Otherwise MuJoCo returns to Python in each step, with the
same numbers, which takes ten times as long as a step of a small robot.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.engines.compiled.kernel import load_callback
from sims.engines.compiled.mujoco_callback import (
    DATA_FIELDS,
    HAS_ACCELERATION,
    MAX_DATA_WORDS,
    CallbackContext,
)
from sims.robot.dynamics.disabled_drives import iterate_constant_stretches
from sims.robot.dynamics.effect_force_program import StepForces
from sims.robot.dynamics.midpoint_state import Mask, MidpointPredictor
from sims.robot.dynamics.mujoco_batch import MujocoBatch
from sims.robot.integrator_settings import RK4_INTEGRATOR_ID

MIN_FRICTION = 1e-12
"""Dry friction in N or N·m of the model where effects add friction.

With it, MuJoCo makes a constraint whose limit the callback replaces.
"""
LAST_FIELD = "iefc_frictionloss"
"""Last of `DATA_FIELDS` in MuJoCo's data."""
_PROBE_MODEL = """
<mujoco><size nuserdata="1"/><worldbody><body>
<joint name="slide" type="slide" axis="1 0 0" frictionloss="1"/><geom size="0.1" mass="1"/>
</body></worldbody></mujoco>
"""
"""Model in which each of `DATA_FIELDS` has numbers."""


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
        contexts = _CallbackContexts(mujoco_batch, step_forces, file_friction, controls.shape[1])
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
            # Later joint states are those of the preceding step.
            mujoco_batch.batch.forward(mujoco_batch.get_element_ids(n))
        force, limit = step_forces.compute(k, predictor.read_joint_states(changes[:, k]))
        all_forces[:, k, dofs] += force
        if has_friction.any():
            friction_field[:n, predictor.dof_indices] = file_friction + np.maximum(limit, 0.0)

    return mujoco_batch.step(controls, all_forces, record, off, set_forces, steps_per_call=1)


def find_callback(mujoco_batch: MujocoBatch, step_forces: StepForces) -> Any:
    """Return the compiled callback that computes effect forces within MuJoCo's steps.

    The result is None if it cannot compute these forces in this batch, or is not available.

    Args:
        mujoco_batch: the batch.
        step_forces: effects to evaluate.
    """
    import mujoco

    disable = mujoco.mjtDisableBit
    required_parts = int(disable.mjDSBL_ACTUATION) | int(disable.mjDSBL_FRICTIONLOSS)
    # The callback is impossible with effects that are not compiled, with switched servos, and with
    # loads of transmissions, which require evaluations within a step. MuJoCo must compute
    # actuators, in which it calls the callback, and dry friction. A callback that the user has set
    # is not replaced.
    if (
        not step_forces.prepared.program.is_traced
        or step_forces.depends_on_switches
        or step_forces.loaded.any()
        or mujoco_batch.model.opt.disableflags & required_parts
        or mujoco.get_mjcb_control() is not None
    ):
        return None
    return _get_callback()


class _CallbackContexts:
    """Contexts of the callback for all batch elements, and the arrays that they refer to."""

    def __init__(
        self, mujoco_batch: MujocoBatch, step_forces: StepForces, losses: Array, steps: int
    ) -> None:
        """Write one context for each batch element: addresses and sizes for the compiled callback.

        The table of contexts has one row of 64-bit integers for each element. It has the addresses
        of arrays: some are common to all elements (`shared`), others belong to one. The callback
        finds its row by the first number of an element in MuJoCo's user data.

        Args:
            mujoco_batch: the batch.
            step_forces: effects, with the hidden states of the beginning.
            losses: (n, D) dry friction of the model at the D joints without effects, for n batch
                elements.
            steps: number of steps S.
        """
        self._mujoco_batch = mujoco_batch
        # The program computes with registers. Its outputs are the numbers of the registers with
        # forces, limits of dry friction, and hidden states.
        layout, prepared = step_forces.layout, step_forces.prepared
        ((force, limit, next_states),) = prepared.program.outputs
        self._dofs = step_forces.addresses.velocities
        joints, states = self._dofs.size, next_states.size
        shared: dict[str, NDArray[Any]] = {
            "code": prepared.code,
            "forces": force,
            "limits": limit,
            "next_states": next_states,
            "positions": step_forces.addresses.positions.astype(np.int64),
            "velocities": self._dofs.astype(np.int64),
            "step": np.array([step_forces.step]),
        }
        # Keeps all arrays alive, because the callback knows only their addresses.
        self._arrays = list(shared.values())
        self._registers: list[Array] = []
        self._acceleration_registers = slice(layout.a, layout.a + joints)
        self._accelerations: Array = mujoco_batch.batch.bind("qacc")
        inputs = step_forces.input_values
        has_friction = step_forces.has_dry_friction
        if has_friction.any():
            # MuJoCo makes a constraint only where the model has dry friction.
            batch_indices, joint_indices = np.nonzero(has_friction)
            friction = mujoco_batch.fields["dof_frictionloss"]
            dofs = self._dofs[joint_indices]
            friction[batch_indices, dofs] = np.maximum(friction[batch_indices, dofs], MIN_FRICTION)
            friction_rows = (friction > 0).sum(axis=1).tolist()
        else:
            friction_rows = [0] * len(losses)
        # The instructions from `begin` to `end` are those of a step; those before prepare elements.
        _, begin, end, _ = prepared.program.ends.tolist()
        common = layout._asdict() | {name: values.ctypes.data for name, values in shared.items()}
        is_rk4 = mujoco_batch.model.opt.integrator == RK4_INTEGRATOR_ID
        table = []
        for batch_index in range(len(losses)):
            registers = np.ascontiguousarray(prepared.r[:, batch_index : batch_index + 1])
            element_arrays = {
                "registers": registers,
                "losses": np.ascontiguousarray(losses[batch_index]),
                "input_values": np.ascontiguousarray(inputs[:, :, batch_index]),
                # Memory for limits and hidden states within a step, of at least one number.
                "scratch": np.zeros(joints + states + 1),
            }
            self._registers.append(registers)
            self._arrays += element_arrays.values()
            addresses = {name: values.ctypes.data for name, values in element_arrays.items()}
            context = CallbackContext(
                **common,
                **addresses,
                begin=begin,
                end=end,
                code_rows=len(prepared.code),
                register_count=len(registers),
                joints=joints,
                friction_rows=friction_rows[batch_index],
                states=states,
                inputs=inputs.shape[1],
                steps=steps,
                evaluations_per_step=4 if is_rk4 else 1,
                # The callback changes these two: evaluations so far, and whether MuJoCo's data has
                # the previous acceleration.
                evaluation=0,
                has_acceleration=0,
            )
            table.append(context)
        self._table = np.array(table, dtype=np.int64)

    @contextlib.contextmanager
    def use(self, callback: Any) -> Iterator[None]:
        """Have MuJoCo call the callback with these contexts in a `with` block.

        The callback is that of the whole process. It finds the context of a batch element by its
        address, the first number of the element's user data.

        Args:
            callback: compiled callback, as from `find_callback`.
        """
        import mujoco

        user_data = self._mujoco_batch.batch.bind("userdata")
        # The table has one row for each element.
        row_bytes, _ = self._table.strides
        rows = np.arange(len(self._table))
        user_data[: rows.size, 0] = self._table.ctypes.data + row_bytes * rows
        mujoco.set_mjcb_control(callback)
        try:
            yield
        finally:
            mujoco.set_mjcb_control(None)
            user_data[:] = 0.0

    def reset_accelerations(self, first: int) -> None:
        """Set the previous accelerations of all batch elements before a call of MuJoCo.

        The callback predicts the middle of a step with the acceleration of the previous one. MuJoCo
        may not keep it between two calls, so it is copied to the registers here, an array
        (registers, 1) for each batch element.

        Args:
            first: number of the first step of the call. Before step 0 the acceleration is set to
                zero, because MuJoCo's initial one lacks the applied forces.
        """
        # 0 in this column of all contexts tells the callback to take the acceleration from the
        # registers at the first step of the call, not from MuJoCo's data.
        self._table[:, HAS_ACCELERATION] = 0
        for batch_index, registers in enumerate(self._registers):
            # The last index adds the axis of length 1 that registers have.
            registers[self._acceleration_registers] = (
                self._accelerations[batch_index, self._dofs, None] if first else 0.0
            )


@cache
def _get_callback() -> Any:
    """Return the compiled callback; None if it is not available."""
    offsets = find_data_offsets()
    return None if offsets is None else load_callback(offsets)


def find_data_offsets() -> dict[str, int] | None:
    """Find where MuJoCo's data stores the addresses of its arrays, in words of eight bytes.

    The compiled callback reads arrays of MuJoCo through these addresses. Where they are depends on
    MuJoCo's version, so they are sought: in the data of a small model, whose arrays are not empty,
    each word is compared with the known addresses of the arrays. An empty array before one has the
    same address, so the last word that matches counts.

    Returns:
        The offsets by the name of the field; None if a field is not found.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(_PROBE_MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    field_at_address = {getattr(data, name).ctypes.data: name for name in DATA_FIELDS}
    # Without the address of the data, or with two arrays at one address, no search is possible.
    if not hasattr(data, "_address") or len(field_at_address) < len(DATA_FIELDS):
        return None
    # The memory of MuJoCo's data, as integers of eight bytes.
    data_words = (ctypes.c_int64 * MAX_DATA_WORDS).from_address(data._address)
    offsets: dict[str, int] = {}
    for word in range(MAX_DATA_WORDS):
        name = field_at_address.get(data_words[word])
        if name is not None:
            offsets[name] = word
        # Nothing is read beyond the last of the fields.
        if name == LAST_FIELD:
            break
    return offsets if len(offsets) == len(DATA_FIELDS) else None
