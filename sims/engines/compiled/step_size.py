"""Step sizes of the elements of one block: from stiffness and damping, and after nonlinear steps.

Before the integration, steps are divided for stiff motion. Later, a step whose forces are too
nonlinear is rejected and shortened (`shorten_if_nonlinear`, by (7) of `element_stepping`).

At the initial state, and at rest at zero, the change of the forces with a small change of position
and of velocity is computed for some steps of the run. For x'' = -w^2 x - c x', the fourth-order
method with step h advances the phase by w h with an error of

    (w h)^5 / 120 + ...                                                    (1)

(the first omitted term of the exponential's series: E. Hairer, S. P. Norsett, G. Wanner, Solving
Ordinary Differential Equations I, 1993, section II.1). The phase may advance by
`MAX_PHASE_PER_STEP` radians per step, which keeps that error near 2e-7 of the phase; a decay may
have c h up to `MAX_DECAY_PER_STEP`.
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.accelerations import compute_norm, dot, evaluate_forces
from sims.engines.compiled.data_layout import (
    CONSTANTS,
    DIMENSIONS,
    ELEMENT,
    F1,
    F2,
    F3,
    F4,
    FORCES,
    HAS_FORCES,
    HAS_FRICTION,
    HAS_HIDDEN_STATES,
    IN_U,
    IN_V,
    IN_X,
    IS_STICKING,
    K1,
    K2,
    K3,
    K4,
    MASS,
    MAX_ACCELERATION,
    MAX_FRICTION,
    MAX_PHASE,
    MAX_STEP,
    SAMPLED_STEP,
    STEP_LIMIT,
    Block,
    H,
    V,
    X,
)
from sims.engines.compiled.element_loading_and_recording import load_element
from sims.engines.compiled.events import has_no_pending_event
from sims.engines.compiled.interpreter import nan_maximum, run_part

MAX_PHASE_PER_STEP = 0.07
"""Maximum phase of an oscillation per step, in radians: error (1) is then 2e-7 of the phase."""
MAX_DECAY_PER_STEP = 0.5
"""Maximum step size in time constants of a decay."""
MAX_STEP_DIVISIONS = 64.0
"""Maximum number of parts into which a step is divided."""
SAMPLED_INSTANTS = 6
"""Number of times in a run at which the forces are evaluated, evenly distributed over its steps."""
FINITE_DIFFERENCE_STEP = 1e-5
"""Finite difference of position (m or rad) and of velocity (m/s or rad/s) for slopes."""
PHASE_TO_DECAY_RATIO = MAX_PHASE_PER_STEP / MAX_DECAY_PER_STEP


def choose_step_divisions(block: Block) -> None:
    """Raise `block.divisions`, the number of parts into which each element's steps are divided.

    Stiff forces need short steps. The stiffness of the acceleration (1/s^2) gives the angular
    frequency of an oscillation, and its damping (1/s) the rate of a decay; their phase and decay
    per step must stay below a limit. They are computed at a few times of the run if inputs change
    with time, at the initial state and at rest. Elements are loaded in groups of one block.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
    """
    longest_steps = block.max_steps
    divisions = block.divisions
    instants = SAMPLED_INSTANTS if block.inputs.shape[0] > 0 else 1
    for first_order_index in range(0, block.order.size, block.w):
        for i in range(block.w):
            load_element(block, i, min(first_order_index + i, block.order.size - 1))
            if instants > 1:
                select_sampled_steps(block, i)
        run_part(block, CONSTANTS)
        for instant in range(instants):
            if instants > 1:
                set_inputs_at(block, instant)
            for at_rest in range(2):  # the initial state first
                compute_stiffness_and_damping(block, at_rest == 1)
                for i in range(min(block.w, block.order.size - first_order_index)):
                    element = block.n[ELEMENT, i]
                    # The stiffness is in row MAX_ACCELERATION, the damping in MAX_FRICTION. The
                    # decay is scaled, so that its limit is that of the phase.
                    step = longest_steps[element]
                    phase = np.sqrt(block.a[MAX_ACCELERATION, i]) * step
                    decay = block.a[MAX_FRICTION, i] * step * PHASE_TO_DECAY_RATIO
                    needed_divisions = np.ceil(nan_maximum(phase, decay) / block.limits[MAX_PHASE])
                    # NaN does not change the number of parts.
                    if needed_divisions > divisions[element]:
                        divisions[element] = min(needed_divisions, MAX_STEP_DIVISIONS)


def divide_steps(block: Block) -> None:
    """Divide the longest step of each element by its number of parts, `block.divisions`.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.flags` states what the system has, such as
            dry friction.
    """
    for element in block.order:
        division = block.divisions[element]
        if division > 1.0:
            # Slightly longer than the part, so that rounding does not leave a tiny step after the
            # last one.
            block.max_steps[element] = block.max_steps[element] / division * (1.0 + 1e-9)
        if block.flags[HAS_HIDDEN_STATES] != 0:
            # The number of steps of an element is limited to a multiple of the planned ones. The
            # fine steps that hidden states, and a system with sharp forces, need count as planned.
            block.planned_counts[element] *= division


def select_sampled_steps(block: Block, i: int) -> None:
    """Select the steps of an element at which stiffness and damping are computed.

    They are `SAMPLED_INSTANTS` steps, evenly distributed from the first to the last; steps of zero
    length do not count. If all elements have the same steps, those of slot 0 are copied.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`.
        i: index of the slot, the column of the batch element.
    """
    n = block.n
    are_steps_shared = block.steps.shape[0] == 1
    if are_steps_shared and i > 0:
        for k in range(SAMPLED_INSTANTS):
            n[SAMPLED_STEP + k, i] = n[SAMPLED_STEP + k, 0]
        return
    row = 0 if are_steps_shared else n[ELEMENT, i]
    step_count = block.steps.shape[1]
    nonzero_count = 0
    for s in range(step_count):
        nonzero_count += block.steps[row, s] > 0.0
    passed_count = 0
    k = 0
    for s in range(step_count):
        passed_count += block.steps[row, s] > 0.0
        # Selection k is after the share k / (SAMPLED_INSTANTS - 1) of the steps; in a short run,
        # several selections are one step.
        while k < SAMPLED_INSTANTS and passed_count >= np.ceil(
            k * (1.0 / (SAMPLED_INSTANTS - 1)) * nonzero_count
        ):
            n[SAMPLED_STEP + k, i] = s
            k += 1


def set_inputs_at(block: Block, instant: int) -> None:
    """Set the inputs of every element to those of one of its selected steps.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.rows[NAME]` is the register of an input or
            an output, the first one if there are several.
        instant: index of the selected step.
    """
    first = block.rows[IN_U]
    for i in range(block.w):
        # Inputs that are the same for all elements are stored in a single row.
        row = block.n[ELEMENT, i] if block.inputs.shape[1] > 1 else 0
        for u in range(block.inputs.shape[0]):
            block.r[first + u, i] = block.inputs[u, row, block.n[SAMPLED_STEP + instant, i]]


def compute_stiffness_and_damping(block: Block, at_rest: bool) -> None:
    """Compute the stiffness and damping of every element by finite differences.

    The stiffness is the largest change of a coordinate's acceleration with its position (1/s^2);
    it is stored in row MAX_ACCELERATION. The damping is that with its velocity (1/s), in row
    MAX_FRICTION. These rows are free before the integration begins.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.rows[NAME]` is the register of an input or an output, the
            first one if there are several. `block.out[k]` is the register of the force on
            coordinate k. `block.flags` states what the system has, such as dry friction.
        at_rest: whether to evaluate at rest at zero instead of the initial state.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    for i in range(block.w):
        a[MAX_ACCELERATION, i] = 0.0
        a[MAX_FRICTION, i] = 0.0
        for k in range(d):
            x = block.x[block.n[ELEMENT, i], k]
            v = block.v[block.n[ELEMENT, i], k]
            # 0.0 * x is zero, but NaN for an element whose state is NaN.
            a[X + k, i] = 0.0 * x if at_rest else x
            a[V + k, i] = 0.0 * v if at_rest else v
    evaluate_forces(block)
    # Rows K1 hold the forces at this state, from which those at changed states are subtracted.
    for k in range(d):
        for i in range(block.w):
            a[K1 + k, i] = block.r[block.out[k], i]
    for k in range(d):
        update_max_slope(block, k, block.rows[IN_X], MAX_ACCELERATION)
        update_max_slope(block, k, block.rows[IN_V], MAX_FRICTION)


def update_max_slope(block: Block, k: int, register: int, row_of_result: int) -> None:
    """Raise a row to the slope of a coordinate's acceleration with its position or velocity.

    The position or velocity is changed by `FINITE_DIFFERENCE_STEP`, the forces are computed again,
    and the former value is restored.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.out[k]` is the register of the force on coordinate k.
        k: index of the coordinate.
        register: first register of the positions or velocities.
        row_of_result: MAX_ACCELERATION for positions, or MAX_FRICTION for velocities: rows that
            hold slopes here, since they are free before the integration begins. The row stays
            unchanged where it is larger than the slope.
    """
    a = block.a
    if row_of_result == MAX_FRICTION:
        # Both velocities are on one side of rest: a discontinuity at rest is not a faster decay. So
        # rows K1 get the forces at the first changed velocity.
        for i in range(block.w):
            block.r[register + k, i] += FINITE_DIFFERENCE_STEP
        run_part(block, FORCES)
        for i in range(block.w):
            a[K1 + k, i] = block.r[block.out[k], i]
    for i in range(block.w):
        block.r[register + k, i] += FINITE_DIFFERENCE_STEP
    run_part(block, FORCES)
    for i in range(block.w):
        change = block.r[block.out[k], i] - a[K1 + k, i]
        slope = abs(change / (FINITE_DIFFERENCE_STEP * a[MASS, i]))
        if slope > a[row_of_result, i]:
            a[row_of_result, i] = slope
    # The rows X and V of the block still have the unchanged state.
    block_row = (X if row_of_result == MAX_ACCELERATION else V) + k
    for i in range(block.w):
        block.r[register + k, i] = a[block_row, i]


FRICTION_NONLINEARITY_TOLERANCE = 6.0 * 0.05
"""Tolerance of six times the nonlinearity (7) of dry friction.

It is a fraction of the largest friction so far: the tail of a Stribeck peak, almost zero at speed,
is strongly nonlinear in relation to itself.
"""
FORCE_NONLINEARITY_TOLERANCE = (6.0 * 0.005) ** 2
"""Tolerance of the square of six times the nonlinearity (7) of the acceleration.

It is a fraction of the square of the largest acceleration so far.
"""
NEGLIGIBLE_ACCELERATION_SHARE = 1e-5
"""Fraction of the largest acceleration so far below which friction is negligible.

Nonlinearity of negligible friction does not shorten a step.
"""
STEP_REDUCTION_FACTOR = 0.25
"""Reduction factor of the length of a step in which forces are too nonlinear."""
MIN_STEP_SHARE = 1.0 / 256.0
"""Fraction of a full step below which steps are not shortened."""


def shorten_if_nonlinear(block: Block, i: int) -> bool:
    """Shorten the step just tried if its forces are too nonlinear; return whether it is rejected.

    The measure is |k1 - k2 - k3 + k4| of the four Runge-Kutta accelerations, relative to the
    largest acceleration so far, and likewise for dry friction unless the element sticks. A step is
    not rejected if it is already very short or ends at a scheduled event. STEP_LIMIT, the longest
    allowed step, is reduced after a rejection, and doubles after an accepted step of that length.
    The rows K1 to K4 hold the accelerations, F1 to F4 the dry friction at the same stages.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.flags` states what the system has, such as dry friction.
        i: index of the slot, the column of the batch element.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    h = a[H, i]
    a[MAX_ACCELERATION, i] = nan_maximum(a[MAX_ACCELERATION, i], dot(a, K1, K1, d, i))
    is_nonlinear = False
    if block.flags[HAS_FORCES] != 0:
        squared_change = 0.0
        for k in range(d):
            outer_sum = a[K1 + k, i] + a[K4 + k, i]
            middle_sum = a[K2 + k, i] + a[K3 + k, i]
            squared_change += (outer_sum - middle_sum) * (outer_sum - middle_sum)
        # The tolerance and MAX_ACCELERATION are squares, too.
        is_nonlinear = squared_change > FORCE_NONLINEARITY_TOLERANCE * a[MAX_ACCELERATION, i]
    if block.flags[HAS_FRICTION] != 0:
        largest = nan_maximum(compute_norm(a, F1, d, i), compute_norm(a, F4, d, i))
        a[MAX_FRICTION, i] = nan_maximum(a[MAX_FRICTION, i], largest)
        negligible = NEGLIGIBLE_ACCELERATION_SHARE * np.sqrt(a[MAX_ACCELERATION, i]) * a[MASS, i]
        squared_change = 0.0
        for k in range(d):
            change = a[F1 + k, i] - a[F2 + k, i] - a[F3 + k, i] + a[F4 + k, i]
            squared_change += change * change
        # In one dimension, the root of the square would be rounded.
        change_size = abs(change) if d == 1 else np.sqrt(squared_change)
        tolerance = FRICTION_NONLINEARITY_TOLERANCE * nan_maximum(a[MAX_FRICTION, i], negligible)
        if block.n[IS_STICKING, i] == 0 and change_size > tolerance:
            is_nonlinear = True
    is_rejected = False
    if is_nonlinear:
        is_rejected = h > MIN_STEP_SHARE * a[MAX_STEP, i] and has_no_pending_event(block, i)
    if is_rejected:
        a[STEP_LIMIT, i] = STEP_REDUCTION_FACTOR * h
    elif h >= a[STEP_LIMIT, i]:
        # The limit doubles with each accepted step of that length, as the nonlinearity may still be
        # near.
        a[STEP_LIMIT, i] = min(2.0 * a[STEP_LIMIT, i], a[MAX_STEP, i])
    return is_rejected
