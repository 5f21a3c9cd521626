"""Step the elements of one program, a block of them together, each with its own clock.

The method is the classical Runge-Kutta method of fourth order, written for x'' = a(t, x, v) (E.
Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sections II.1
and, for second order, II.14, doi:10.1007/978-3-540-78862-1). With step h,

    k1 = a(t, x, v)                                                        (1)
    k2 = a(t + h/2, x + h/2 v, v + h/2 k1)                                 (2)
    k3 = a(t + h/2, x + h/2 v + h^2/4 k1, v + h/2 k2)                      (3)
    k4 = a(t + h, x + h v + h^2/2 k2, v + h k3)                            (4)
    x' = x + h v + h^2/6 (k1 + k2 + k3)                                    (5)
    v' = v + h/6 (k1 + 2 k2 + 2 k3 + k4)                                   (6)

The nonlinearity of the acceleration within the step is estimated by the difference between (6) and
the midpoint rule, v + h/2 (k2 + k3), per second:

    b = (k1 - k2 - k3 + k4) / 6                                            (7)

Steps are the planned ones, divided where the motion of an element is too fast for them
(`step_size`). Steps in which friction or the forces of effects are too nonlinear (Stribeck's peak,
the ripples of a fast motor) are rejected and shortened, and steps that contain an event are cut
(`events`). The slot of a finished element is given to the next one, so that slots stay in use
although elements need different numbers of steps. The result of an element does not depend on any
other.

`COMPILED` is the machine code of the batch engine: `step_elements`, and `run_instructions` of
`interpreter`, with which a program also runs alone.
"""

from __future__ import annotations

from sims.engines.compiled.accelerations import begin_step, compute_acceleration, evaluate_forces
from sims.engines.compiled.compiled_functions import CompiledFunctions
from sims.engines.compiled.data_layout import (
    BLOCK_SHAPES,
    BOUNCES,
    CONSTANTS,
    DIMENSIONS,
    ELEMENT,
    EVENT_COUNT,
    EVENT_DELAY,
    F1,
    HAS_FORCES,
    HAS_FRICTION,
    IN_T,
    IN_V,
    IN_X,
    IS_IDLE,
    IS_RESTING,
    IS_STEP_START,
    K1,
    K2,
    K3,
    K4,
    MAX_COORDINATES,
    NEXT_V,
    NEXT_X,
    NO_EVENT,
    ORDER_INDEX,
    PENDING_EVENT,
    REMAINING_TIME,
    STEP_INDEX,
    STEP_LIMIT,
    STEP_START,
    Block,
    H,
    T,
    V,
    X,
)
from sims.engines.compiled.element_loading_and_recording import (
    load_element,
    record_and_check_remaining,
    set_inputs,
)
from sims.engines.compiled.events import detect_and_schedule_event, handle_event
from sims.engines.compiled.ground_impacts import resolve_initial_ground_contact
from sims.engines.compiled.interpreter import nan_maximum, run_instructions, run_part
from sims.engines.compiled.step_size import (
    choose_step_divisions,
    divide_steps,
    shorten_if_nonlinear,
)


def step_elements(block: Block) -> None:
    """Integrate all elements, a block of them together, each with its own clock.

    Each slot has its own time and step length, so that impacts and reversals of one element do not
    delay others. In every turn of the loop, all slots compute their forces, record their states at
    sample times, and try one step; slots of finished elements get the next ones. A tried step is
    accepted if it contains no event (such as an impact) and its forces are smooth enough; otherwise
    it is shortened and repeated in the next turn. Elements are loaded in the sequence of
    `block.order`, which lists their indices.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.flags` states what the system has, such as
            dry friction.
    """
    # Elements that move fast get shorter steps.
    choose_step_divisions(block)
    divide_steps(block)
    loaded_count = 0
    active_count = 0
    for i in range(block.w):
        if loaded_count < block.order.size:
            load_element(block, i, loaded_count)
            loaded_count += 1
            active_count += 1
        else:
            # There are more slots than elements: this one computes valid numbers, but is not used,
            # which an index of -1 marks.
            load_element(block, i, block.order.size - 1)
            block.n[ORDER_INDEX, i] = -1
    has_new_elements = True
    while active_count > 0:
        if has_new_elements:
            # Values that depend on an element's parameters alone.
            run_part(block, CONSTANTS)
            if block.flags[BOUNCES] != 0:
                resolve_initial_ground_contact(block)
            has_new_elements = False
        evaluate_forces(block)
        begin_step(block)
        for i in range(block.w):
            # An idle slot takes no step in this turn: it is unused, or its element has finished.
            block.n[IS_IDLE, i] = block.n[ORDER_INDEX, i] < 0
            is_used = block.n[ORDER_INDEX, i] >= 0
            # A finished element gives its slot to the next one, which begins in the next turn.
            if is_used and not record_and_check_remaining(block, i):
                active_count -= 1
                block.n[ORDER_INDEX, i] = -1
                if loaded_count < block.order.size:
                    load_element(block, i, loaded_count)
                    loaded_count += 1
                    active_count += 1
                    has_new_elements = True
                block.n[IS_IDLE, i] = 1
            a = block.a
            # The step ends at the planned one's end, its limit, or the next known event.
            a[H, i] = min(min(a[REMAINING_TIME, i], a[STEP_LIMIT, i]), a[EVENT_DELAY, i])
            if block.n[IS_IDLE, i] != 0:
                a[H, i] = 0.0
        try_step(block)
        for i in range(block.w):
            if block.n[IS_IDLE, i] == 0:
                accept_or_retry(block, i)


def try_step(block: Block) -> None:
    """Try a step of H seconds of every element by the classical Runge-Kutta method.

    The acceleration k1 at the beginning is in rows K1. Stages 1 and 2 evaluate k2 and k3 in the
    middle of the step, stage 3 evaluates k4 at its end. With the acceleration a(t, x, v) and the
    step h,

        k2 = a(t + h/2, x + h/2 v, v + h/2 k1)               (2)
        k3 = a(t + h/2, x + h/2 v + h^2/4 k1, v + h/2 k2)    (3)
        k4 = a(t + h, x + h v + h^2/2 k2, v + h k3)          (4)
        x' = x + h v + h^2/6 (k1 + k2 + k3)                  (5)
        v' = v + h/6 (k1 + 2 k2 + 2 k3 + k4)                 (6)

    The new state is stored in rows NEXT_X and NEXT_V; the element moves there only if the step is
    accepted.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.rows[NAME]` is the register of an input or an output, the
            first one if there are several. `block.flags` states what the system has, such as dry
            friction.
    """
    a = block.a
    r = block.r
    d = block.flags[DIMENSIONS]
    t = block.rows[IN_T]
    for stage in range(1, 4):
        # Time of the stage as a share of the step, and the acceleration of the previous stage.
        share = 0.5 if stage < 3 else 1.0
        # Each of the vectors K1 to K4, and F1 to F4 of dry friction, has MAX_COORDINATES rows.
        acceleration_row = K1 + (stage - 1) * MAX_COORDINATES
        for i in range(block.w):
            r[t, i] = a[T, i] + share * a[H, i]
        for k in range(d):
            x = block.rows[IN_X] + k
            v = block.rows[IN_V] + k
            if stage == 1:
                for i in range(block.w):
                    r[x, i] = a[X + k, i] + 0.5 * a[H, i] * a[V + k, i]  # (2)
            elif stage == 2:  # the register still has x + h/2 v
                for i in range(block.w):
                    half_step = 0.5 * a[H, i]
                    r[x, i] = r[x, i] + (half_step * half_step) * a[K1 + k, i]  # (3)
            else:  # h times v + h/2 k2, which the register of the velocity still has
                for i in range(block.w):
                    r[x, i] = a[X + k, i] + a[H, i] * r[v, i]  # (4)
            for i in range(block.w):
                r[v, i] = a[V + k, i] + share * a[H, i] * a[acceleration_row + k, i]
        compute_acceleration(block, K1 + stage * MAX_COORDINATES, F1 + stage * MAX_COORDINATES)
    for k in range(d):
        for i in range(block.w):
            h = a[H, i]
            sixth = h / 6.0
            middle_sum = a[K2 + k, i] + a[K3 + k, i]
            outer = a[K1 + k, i] + a[K4 + k, i]
            v = a[V + k, i]
            a[NEXT_X + k, i] = a[X + k, i] + h * (v + sixth * (a[K1 + k, i] + middle_sum))  # (5)
            a[NEXT_V + k, i] = v + sixth * (outer + 2.0 * middle_sum)  # (6)


def accept_or_retry(block: Block, i: int) -> None:
    """Examine the step just tried of one element: accept it, or prepare to repeat it.

    It is repeated with a shorter length if its forces are too nonlinear, or up to the event that it
    contains. An accepted step that leads to a scheduled event is followed by that event.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.flags` states what the system has, such as dry friction.
        i: index of the slot, the column of the batch element.
    """
    a = block.a
    n = block.n
    d = block.flags[DIMENSIONS]
    can_be_nonlinear = block.flags[HAS_FRICTION] != 0 or block.flags[HAS_FORCES] != 0
    if can_be_nonlinear and shorten_if_nonlinear(block, i):
        return
    can_have_event = block.flags[HAS_FRICTION] != 0 or block.flags[BOUNCES] != 0
    if can_have_event and detect_and_schedule_event(block, i):
        return
    for k in range(d):
        a[X + k, i] = a[NEXT_X + k, i]
        a[V + k, i] = a[NEXT_V + k, i]
    h = a[H, i]
    a[T, i] += h
    # By rounding, parts of a step may add up to more than its length; a negative remaining time
    # would run backwards.
    a[REMAINING_TIME, i] = nan_maximum(a[REMAINING_TIME, i] - h, 0.0)
    if n[PENDING_EVENT, i] != NO_EVENT:
        handle_event(block, i)
    # An element that moves up has left the ground.
    if n[IS_RESTING, i] != 0 and not a[V + d - 1, i] <= 0.0:
        n[IS_RESTING, i] = 0
    if a[REMAINING_TIME, i] <= 0.0:
        next_step(block, i)


def next_step(block: Block, i: int) -> None:
    """Begin the next planned step of the element in slot i, with the inputs of that step.

    A planned step is one of the batch's steps; it may be divided at events such as impacts. The
    time is set to the sum of the planned steps, which removes the rounding of divided ones. After
    the last planned step, the remaining time is zero.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.
    """
    a = block.a
    n = block.n
    # Steps that are the same for all elements are stored in a single row.
    row = n[ELEMENT, i] if block.steps.shape[0] > 1 else 0
    step = n[STEP_INDEX, i] + 1
    n[STEP_INDEX, i] = step
    n[IS_STEP_START, i] = 1
    n[EVENT_COUNT, i] = 0
    a[STEP_START, i] += block.steps[row, step - 1]
    a[T, i] = a[STEP_START, i]
    a[REMAINING_TIME, i] = block.steps[row, step] if step < block.steps.shape[1] else 0.0
    set_inputs(block, i)


COMPILED = CompiledFunctions(
    __name__,
    "the batch engine",
    {
        step_elements: BLOCK_SHAPES,
        run_instructions: ("#i5", "#", "#", "rw", "#"),
    },
)
"""Machine code of the batch engine."""
