"""Compiled callback that adds the forces of effects within MuJoCo's own step, and its contexts.

MuJoCo calls it as `mjcb_control` in each evaluation of the dynamics, after the velocity-dependent
quantities and before the forces of actuators
(https://mujoco.readthedocs.io/en/stable/APIreference/APIglobals.html). So all steps of a simulation
run without Python. Forces and limits of dry friction are computed once in each step, at the
predicted middle of the step, with the position x, the velocity v and the previous acceleration a at
its beginning (`sims.robot.dynamics.midpoint_state`, eq. (1)).

The function (`add_effect_forces`) is plain Python that the compiler accepts
(`sims.engines.compiled.numba_compilation`). Addresses are 64-bit integers; the first number of
MuJoCo's user data is the address of the simulation's context, zero for simulations without effects.

`find_callback` returns the callback if it can compute the effects of a batch, and
`CallbackContexts` makes the contexts.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.engines.compiled.interpreter import run_instructions
from sims.engines.compiled.intrinsics import (
    carray,
    to_fixed_tuple,
    to_int_pointer,
    to_real_pointer,
    to_short_pointer,
)
from sims.engines.compiled.machine_code_cache import load_stored
from sims.robot.integrator_settings import RK4_INTEGRATOR_ID

# The process that compiles this module does not need these modules.
if TYPE_CHECKING:
    from sims.robot.dynamics.effect_force_program import StepForces
    from sims.robot.dynamics.mujoco_batch import MujocoBatch

QPOS = QVEL = QACC = QFRC_APPLIED = USERDATA = 0
EFC_TYPE = EFC_ID = EFC_FRICTIONLOSS = IEFC_FRICTIONLOSS = MAP_EFC2IEFC = 0
"""Offsets of fields in MuJoCo's data, in words of eight bytes.

The compiler replaces these numbers by those of the installed version of MuJoCo.
"""
DATA_FIELDS = (
    *("qpos", "qvel", "qacc", "qfrc_applied", "userdata"),
    *("efc_type", "efc_id", "efc_frictionloss", "iefc_frictionloss", "map_efc2iefc"),
)
"""Fields of `mujoco.MjData` that the callback uses."""
LAST_FIELD = "iefc_frictionloss"
"""Last of `DATA_FIELDS` in MuJoCo's data."""
MAX_DATA_WORDS = 1 << 20
"""Maximum offset of a field in MuJoCo's data, in words of eight bytes."""
EQUALITY_ROW, FRICTION_ROW = 0, 1
"""Types of rows of MuJoCo's constraints (mjtConstraint); rows are sorted by type."""
MIN_FRICTION = 1e-12
"""Dry friction in N or N·m of the model where effects add friction.

With it, MuJoCo makes a constraint whose limit the callback replaces.
"""
_PROBE_MODEL = """
<mujoco><size nuserdata="1"/><worldbody><body>
<joint name="slide" type="slide" axis="1 0 0" frictionloss="1"/><geom size="0.1" mass="1"/>
</body></worldbody></mujoco>
"""
"""Model in which each of `DATA_FIELDS` has numbers."""


class CallbackContext(NamedTuple):
    """Context of one simulation: integers, and addresses of arrays.

    Attributes:
        code: instructions (n, 5).
        code_rows: number of instructions.
        begin: first instruction of a step.
        end: index after the last instruction of a step.
        registers: registers (R, 1).
        register_count: number of registers.
        joints: number of joints D.
        positions: addresses (D,) of the joints in qpos.
        velocities: addresses (D,) of the joints in qvel.
        forces: registers (D,) of the forces.
        limits: registers (D,) of the limits of dry friction.
        losses: (D,) dry friction of the model, without effects.
        friction_rows: number of dry friction constraints; zero if no effect adds friction.
        states: number of hidden states H.
        next_states: registers (H,) of the hidden states after a step.
        first_state: first register of the hidden states.
        inputs: number of inputs U.
        input_values: (S, U) inputs in each step.
        first_input: first register of the inputs.
        t: register of the time at the beginning of a step.
        midpoint: register of the time at the middle of a step.
        past: register of the interval over which hidden states advance.
        x: first register of the positions.
        v: first register of the velocities.
        a: first register of the accelerations.
        steps: number of steps S.
        step: address of the step length in seconds.
        scratch: (D + H,) limits of the present step, and hidden states while they are copied.
        evaluations_per_step: number of evaluations of the dynamics in each step.
        evaluation: number of evaluations so far; the callback increases it.
        has_acceleration: 0 if the registers contain the previous acceleration, as at the beginning
            of a call of MuJoCo; 1 if it is in MuJoCo's data. The callback sets it to 1.
    """

    code: int
    code_rows: int
    begin: int
    end: int
    registers: int
    register_count: int
    joints: int
    positions: int
    velocities: int
    forces: int
    limits: int
    losses: int
    friction_rows: int
    states: int
    next_states: int
    first_state: int
    inputs: int
    input_values: int
    first_input: int
    t: int
    midpoint: int
    past: int
    x: int
    v: int
    a: int
    steps: int
    step: int
    scratch: int
    evaluations_per_step: int
    evaluation: int
    has_acceleration: int


CONTEXT_WORDS = len(CallbackContext._fields)
EVALUATION = CallbackContext._fields.index("evaluation")
HAS_ACCELERATION = CallbackContext._fields.index("has_acceleration")


def add_effect_forces(model_at: Any, data_at: Any) -> None:  # noqa: ARG001
    """Add the forces of effects to the present evaluation of the dynamics.

    MuJoCo calls this in each evaluation of a step. At the first evaluation of step k (`stage` 0),
    the force program computes forces and dry friction at the state in the middle of the step; the
    further evaluations of a Runge-Kutta step reuse them. The work is: read the simulation's
    context, copy time, state and inputs to the registers, run the program, add its forces to
    MuJoCo's applied forces, advance hidden states, and set the limits of dry friction.

    The function is compiled, so memory is read by addresses: `carray` is the array at an address.
    The address of the `CallbackContext` is in MuJoCo's user data; its fields are integers in their
    order. Zero marks a simulation without effects.

    Args:
        model_at: pointer to MuJoCo's model; not used.
        data_at: pointer to MuJoCo's data, which is read as words of eight bytes.
    """
    data = carray(data_at, (MAX_DATA_WORDS,))
    context_address = carray(to_real_pointer(data[USERDATA]), (1,))[0]
    if context_address == 0.0:
        return
    words = carray(to_int_pointer(np.int64(context_address)), (CONTEXT_WORDS,))
    context = CallbackContext(*to_fixed_tuple(words, CONTEXT_WORDS))
    k, stage = divmod(context.evaluation, context.evaluations_per_step)
    words[EVALUATION] += 1
    # There are no inputs for an evaluation after the last step.
    if k >= context.steps:
        return
    joints = context.joints
    scratch = carray(to_real_pointer(context.scratch), (joints + context.states,))
    if stage == 0:
        positions = carray(to_int_pointer(context.positions), (joints,))
        velocities = carray(to_int_pointer(context.velocities), (joints,))
        qpos = carray(to_real_pointer(data[QPOS]), (MAX_DATA_WORDS,))
        qvel = carray(to_real_pointer(data[QVEL]), (MAX_DATA_WORDS,))
        qacc = carray(to_real_pointer(data[QACC]), (MAX_DATA_WORDS,))
        applied = carray(to_real_pointer(data[QFRC_APPLIED]), (MAX_DATA_WORDS,))
        step = carray(to_real_pointer(context.step), (1,))[0]
        r = carray(to_real_pointer(context.registers), (context.register_count, 1))
        r[context.t, 0] = k * step
        r[context.midpoint, 0] = (k + 0.5) * step
        # Time since the last evaluation, over which hidden states advance: from midpoint to
        # midpoint, and in the first step from its beginning.
        r[context.past, 0] = step if k > 0 else 0.5 * step
        for j in range(joints):
            r[context.x + j, 0] = qpos[positions[j]]
            r[context.v + j, 0] = qvel[velocities[j]]
            if context.has_acceleration == 1:
                r[context.a + j, 0] = qacc[velocities[j]]
        words[HAS_ACCELERATION] = 1
        input_values = carray(
            to_real_pointer(context.input_values), (context.steps, context.inputs)
        )
        for i in range(context.inputs):
            r[context.first_input + i, 0] = input_values[k, i]
        code = carray(to_int_pointer(context.code), (context.code_rows, 5))
        run_instructions(code, context.begin, context.end, r, 1)
        # Registers of each joint's force and dry friction limit, and the model's own
        # `frictionloss`.
        force = carray(to_int_pointer(context.forces), (joints,))
        limit = carray(to_int_pointer(context.limits), (joints,))
        losses = carray(to_real_pointer(context.losses), (joints,))
        for j in range(joints):
            applied[velocities[j]] += r[force[j], 0]
            added_limit = r[limit[j], 0]
            scratch[j] = losses[j] + (added_limit if added_limit > 0.0 else 0.0)
        # The registers after a step may be those before it, so the states are copied twice.
        next_states = carray(to_int_pointer(context.next_states), (context.states,))
        for i in range(context.states):
            scratch[joints + i] = r[next_states[i], 0]
        for i in range(context.states):
            r[context.first_state + i, 0] = scratch[joints + i]
    # An address of zero means that there are no constraints now.
    if context.friction_rows > 0 and data[EFC_TYPE] != 0:
        set_friction_limits(data, context, scratch)


def set_friction_limits(data: Any, context: Any, limits: Any) -> None:
    """Write limits of dry friction into the constraints of the present evaluation.

    MuJoCo's solver treats dry friction as constraints, one row each. The rows are sorted by type:
    those of equalities come first and are skipped; those of friction follow. Each names the
    velocity coordinate on which it acts, by which its joint is found.

    Args:
        data: MuJoCo's data as words of eight bytes.
        context: the context of the simulation.
        limits: (D,) limits of dry friction of the D joints, in N or N m.
    """
    velocities = carray(to_int_pointer(context.velocities), (context.joints,))
    kinds = carray(to_short_pointer(data[EFC_TYPE]), (MAX_DATA_WORDS,))
    ids = carray(to_short_pointer(data[EFC_ID]), (MAX_DATA_WORDS,))
    loss = carray(to_real_pointer(data[EFC_FRICTIONLOSS]), (MAX_DATA_WORDS,))
    first = 0
    while kinds[first] == EQUALITY_ROW:
        first += 1
    for row in range(first, first + context.friction_rows):
        # Rows of other types must not be changed, should there be fewer rows of friction.
        if kinds[row] != FRICTION_ROW:
            break
        for j in range(context.joints):
            if velocities[j] != ids[row]:
                continue
            loss[row] = limits[j]
            # MuJoCo copies the rows of independent groups of bodies before it calls the callback.
            if data[IEFC_FRICTIONLOSS] != 0:
                places = carray(to_short_pointer(data[MAP_EFC2IEFC]), (MAX_DATA_WORDS,))
                island_loss = carray(to_real_pointer(data[IEFC_FRICTIONLOSS]), (MAX_DATA_WORDS,))
                island_loss[places[row]] = limits[j]


class CallbackContexts:
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
            # Number of constraints of dry friction of each batch element.
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


@cache
def _get_callback() -> Any:
    """Return the compiled callback; None if it is not available."""
    offsets = find_data_offsets()
    return None if offsets is None else load_callback(offsets)


def load_callback(offsets: Mapping[str, int]) -> Callable[..., None]:
    """Return the compiled callback of MuJoCo's steps, compiled on first use.

    Args:
        offsets: offset of each field in MuJoCo's data, in words of eight bytes.

    Raises:
        InputError: the compiler or its machine code cannot be used.
    """
    # The compiler replaces the module's constants, such as QPOS, by these offsets.
    constants = {name.upper(): offset for name, offset in offsets.items()}
    return load_stored(
        __name__,
        "add_effect_forces",
        "the forces of effects",
        pointers=2,  # MuJoCo's model and data
        constants=constants,
    )


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
