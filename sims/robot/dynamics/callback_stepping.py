"""Steps of a batch with effect forces that MuJoCo's callback computes, without Python in between.

`MujocoBatch.step_with_forces` returns to Python in each step, which takes ten times as long as a
step of a small robot. Here the compiled program of the effects runs in the callback
(`sims.engines.compiled.mujoco_callback`) with the same numbers.
"""

from __future__ import annotations

import ctypes
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
from sims.robot.dynamics.compiled_forces import CompiledForces
from sims.robot.dynamics.midpoint_state import MidpointPredictor
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


def step_in_callback(
    mujoco_batch: MujocoBatch,
    controls: Array,
    forces: Array,
    compiled: CompiledForces,
    record: list[str],
) -> dict[str, Array] | None:
    """Step n batch elements S times, with effect forces computed in MuJoCo's callback.

    MuJoCo then makes all steps without returning to Python. The result equals that of
    `MujocoBatch.step_with_forces`, which returns in each step; the caller uses it if this function
    returns None. Before the steps, dry friction of effects is prepared, the first controls and the
    hidden states are set, and each batch element gets a context for the callback.

    Args:
        mujoco_batch: the batch, with initial states and effects in its model.
        controls: (n, S, nu) controls.
        forces: (n, S, nv) generalised forces.
        compiled: compiled forces of effects.
        record: fields of MuJoCo's data to record.

    Returns:
        Recorded fields (n, S, ...) by name; None if the callback cannot compute these forces.
    """
    import mujoco

    disable = mujoco.mjtDisableBit
    required_parts = int(disable.mjDSBL_ACTUATION) | int(disable.mjDSBL_FRICTIONLOSS)
    # Loads of transmissions require evaluations within a step. MuJoCo must compute actuators, in
    # which it calls the callback, and dry friction.
    if compiled.loaded.any() or mujoco_batch.model.opt.disableflags & required_parts:
        return None
    callback = _get_callback()
    # A callback that the user has set is not replaced.
    if callback is None or mujoco.get_mjcb_control() is not None:
        return None
    batch_size, steps, _ = controls.shape
    friction_without_effects = mujoco_batch.begin_dry_friction(compiled, batch_size)
    has_friction = compiled.has_dry_friction
    if has_friction.any():
        loss = mujoco_batch.fields["dof_frictionloss"]
        batch_indices, joints = np.nonzero(has_friction)
        dofs = compiled.addresses.velocities[joints]
        loss[batch_indices, dofs] = np.maximum(loss[batch_indices, dofs], MIN_FRICTION)
    mujoco_batch.batch.bind("ctrl")[:batch_size] = controls[:, 0]
    predictor = MidpointPredictor(
        mujoco_batch.batch,
        compiled.addresses.positions,
        compiled.addresses.velocities,
        compiled.loaded,
    )
    mujoco_batch.batch.forward(None if batch_size == mujoco_batch.count else np.arange(batch_size))
    compiled.begin(predictor.read_joint_states(np.zeros(batch_size, dtype=bool)))
    contexts = _CallbackContexts(mujoco_batch, compiled, friction_without_effects, steps)
    user = mujoco_batch.batch.bind("userdata")
    user[:batch_size, 0] = contexts.addresses
    mujoco.set_mjcb_control(callback)
    try:
        return mujoco_batch.step(controls, forces, record, before_call=contexts.reset_accelerations)
    finally:
        mujoco.set_mjcb_control(None)
        user[:] = 0.0


class _CallbackContexts:
    """Contexts of the callback for all batch elements, and the arrays that they refer to."""

    def __init__(
        self, mujoco_batch: MujocoBatch, compiled: CompiledForces, losses: Array, steps: int
    ) -> None:
        """Write one context for each batch element: addresses and sizes for the compiled callback.

        The table of contexts has one row of 64-bit integers for each element. Arrays in `shared`
        are common to all elements, and those in `element_arrays` belong to one. `self._arrays`
        keeps all of them alive, because the callback knows only their addresses. The callback finds
        its row by the entry of `self.addresses` in MuJoCo's user data.

        Shapes: D joints.

        Args:
            mujoco_batch: the batch.
            compiled: compiled forces of effects, begun.
            losses: (n, D) dry friction of the model without effects.
            steps: number of steps S.
        """
        layout = compiled.layout
        self._dofs = compiled.addresses.velocities
        joints, states = self._dofs.size, layout["next_states"].size
        shared: dict[str, NDArray[Any]] = {
            name: np.ascontiguousarray(
                values, dtype=np.float64 if values.dtype.kind == "f" else np.int64
            )
            for name, values in layout.items()
            if isinstance(values, np.ndarray)
        }
        self._arrays = list(shared.values())
        self._registers: list[Array] = []
        self._acceleration_registers = slice(layout["a"], layout["a"] + joints)
        self._accelerations: Array = mujoco_batch.batch.bind("qacc")
        common = layout | {name: values.ctypes.data for name, values in shared.items()}
        has_friction = bool(compiled.has_dry_friction.any())
        inputs = compiled.input_values
        loss = mujoco_batch.fields["dof_frictionloss"]
        table = []
        for batch_index in range(len(losses)):
            registers = np.ascontiguousarray(compiled.registers[:, batch_index : batch_index + 1])
            element_arrays = {
                "registers": registers,
                "losses": np.ascontiguousarray(losses[batch_index]),
                "input_values": np.ascontiguousarray(inputs[:, :, batch_index]),
                "scratch": np.zeros(joints + states + 1),
            }
            self._registers.append(registers)
            self._arrays += element_arrays.values()
            addresses = {name: values.ctypes.data for name, values in element_arrays.items()}
            context = CallbackContext(
                **common,
                **addresses,
                code_rows=len(layout["code"]),
                register_count=len(registers),
                joints=joints,
                friction_rows=int((loss[batch_index] > 0).sum()) if has_friction else 0,
                states=states,
                inputs=inputs.shape[1],
                steps=steps,
                evaluations_per_step=4
                if mujoco_batch.model.opt.integrator == RK4_INTEGRATOR_ID
                else 1,
                evaluation=0,
                has_acceleration=0,
            )
            table.append(context)
        self._table = np.array(table, dtype=np.int64)
        row = self._table.strides[0]
        self.addresses: Array = self._table.ctypes.data + row * np.arange(float(len(table)))

    def reset_accelerations(self, first: int) -> None:
        """Set the previous accelerations of all batch elements before a call of MuJoCo.

        The callback predicts the middle of a step with the acceleration of the previous one. MuJoCo
        may not keep it between two calls, so it is copied to the registers here.

        Args:
            first: number of the first step of the call. The initial acceleration lacks the applied
                forces, so it is not used.
        """
        self._table[:, HAS_ACCELERATION] = 0
        for batch_index, registers in enumerate(self._registers):
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
    if not hasattr(data, "_address") or len(field_at_address) < len(DATA_FIELDS):
        return None
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
