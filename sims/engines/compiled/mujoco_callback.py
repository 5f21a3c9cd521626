"""Compiled callback that adds the forces of effects within MuJoCo's own step.

MuJoCo calls it as `mjcb_control` in each evaluation of the dynamics, after the velocity-dependent
quantities and before the forces of actuators
(https://mujoco.readthedocs.io/en/stable/APIreference/APIglobals.html). So all steps of a simulation
run without Python. Forces and limits of dry friction are computed once in each step, at the
predicted middle of the step, with the position x, the velocity v and the previous acceleration a at
its beginning (`sims.robot.dynamics.midpoint_state`, eq. (1)).

The function is plain Python that the compiler accepts (`sims.engines.compiled.kernel_build`).
Addresses are 64-bit integers; the first number of MuJoCo's user data is the address of the
simulation's context, zero for simulations without effects.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sims.engines.compiled.interpreter import run_instructions
from sims.engines.compiled.intrinsics import (
    carray,
    to_fixed_tuple,
    to_int_pointer,
    to_real_pointer,
    to_short_pointer,
)

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
MAX_DATA_WORDS = 1 << 20
"""Maximum offset of a field in MuJoCo's data, in words of eight bytes."""
EQUALITY_ROW, FRICTION_ROW = 0, 1
"""Types of rows of MuJoCo's constraints (mjtConstraint); rows are sorted by type."""


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
