"""Accelerations of the elements in a block, with dry friction and ground support.

Dry friction opposes motion with its full limit. Its direction is fixed during a step, so that the
step is smooth. An element at rest sticks while the pulling force is within the limit, otherwise it
slips in the direction of that force. With generalised inertia M, pulling force F (all forces except
dry friction), limit L and the unit vector d of the motion,

    M a = F - L d          while it moves, d = v / |v|                     (1)
    a = 0                  at rest, as long as |F| <= L                    (2)
    M a = F - L F / |F|    at rest, where |F| > L                          (3)

(C. Coulomb's law; see E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations
I, 1993, section II.6, on such discontinuities: a step must not extend across one).
"""

from __future__ import annotations

import numpy as np

from sims.engines.compiled.data_layout import (
    BOUNCES,
    DIMENSIONS,
    DIRECTION,
    EXCESS_AFTER,
    EXCESS_BEFORE,
    F1,
    FORCES,
    FRICTION_COORDINATE_COUNT,
    HAS_FRICTION,
    IN_T,
    IN_V,
    IN_X,
    IS_RESTING,
    IS_STICKING,
    K1,
    MASS,
    OUT_LIMIT,
    Block,
    FloatArray,
    T,
    V,
    X,
)
from sims.engines.compiled.interpreter import nan_maximum, run_part


def evaluate_forces(block: Block) -> None:
    """Copy time, position and velocity of every element to the registers, and compute its forces.

    Afterwards register `block.out[k]` has the force on coordinate k, without dry friction.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.rows[NAME]` is the register of an input or an output, the
            first one if there are several. `block.flags` states what the system has, such as dry
            friction.
    """
    d = block.flags[DIMENSIONS]
    rows = block.rows
    r = block.r
    a = block.a
    for i in range(block.w):
        r[rows[IN_T], i] = a[T, i]
    for k in range(d):
        for i in range(block.w):
            r[rows[IN_X] + k, i] = a[X + k, i]
            r[rows[IN_V] + k, i] = a[V + k, i]
    run_part(block, FORCES)


def begin_step(block: Block) -> None:
    """Compute the accelerations at the beginning of a step, in rows K1, with dry friction.

    With the mass M, the pulling force F (all forces except dry friction), the limit L of dry
    friction and the velocity v,

        M a = F - L v / |v|    while it moves                (1)
        a = 0                  at rest, as long as |F| <= L  (2)
        M a = F - L F / |F|    at rest, where |F| > L        (3)

    The forces must be evaluated before. Two results stay the same during the step, so that the
    step is smooth: which elements stick (2), and the direction v / |v| or F / |F| of the others.
    The excess |F| - L is stored, too: where it becomes positive, a sticking element breaks away.
    Friction acts on the first coordinates only; systems without friction, and those with one such
    coordinate, have faster versions.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.rows[NAME]` is the register of an input or an output, the
            first one if there are several. `block.flags` states what the system has, such as dry
            friction.
    """
    if block.flags[HAS_FRICTION] == 0:
        compute_frictionless_acceleration(block, K1)
        return
    friction_coordinate_count = block.flags[FRICTION_COORDINATE_COUNT]
    # The faster version does not know the ground, which may support an element.
    if friction_coordinate_count == 1 and block.flags[BOUNCES] == 0:
        begin_step_1d(block)
        return
    a = block.a
    r = block.r
    limits = block.rows[OUT_LIMIT]
    for i in range(block.w):
        limit = r[limits, i]
        compute_force_without_friction(block, i, K1)
        force_size = compute_norm(a, K1, friction_coordinate_count, i)
        speed = compute_norm(a, V, friction_coordinate_count, i)
        # The later stages of the step overwrite EXCESS_AFTER.
        a[EXCESS_BEFORE, i] = force_size - limit
        a[EXCESS_AFTER, i] = force_size - limit
        is_still = speed == 0.0
        is_sticking = is_still and force_size <= limit  # (2)
        block.n[IS_STICKING, i] = is_sticking
        # (1) and (3): along the motion, or at rest along the pulling force.
        divisor = speed
        if is_still:
            divisor = force_size if force_size > 0.0 else 1.0
        for k in range(friction_coordinate_count):
            force = a[K1 + k, i]
            direction = (force if is_still else a[V + k, i]) / divisor
            friction = limit * direction
            a[DIRECTION + k, i] = direction
            a[F1 + k, i] = friction
            a[K1 + k, i] = 0.0 if is_sticking else (force - friction) / a[MASS, i]
        compute_acceleration_without_friction(block, i, K1, F1)


def begin_step_1d(block: Block) -> None:
    """Compute the accelerations of all slots at the beginning of a step, in rows K1.

    This is the version of `begin_step` for dry friction on the first coordinate only, without
    ground; the numbers are the same. With the force F, the friction limit L and the velocity v, it
    is M a = F - L v / |v| in motion (1); at rest a = 0 if |F| <= L (2), else M a = F - L F / |F|
    (3). All cases are computed and one is selected, without branches, so that the compiler can
    vectorise the loop over slots.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.rows[NAME]` is the register of an input or
            an output, the first one if there are several. `block.out[k]` is the register of the
            force on coordinate k.
    """
    a = block.a
    r = block.r
    limits = block.rows[OUT_LIMIT]
    force_row = block.out[0]
    for i in range(block.w):
        force = r[force_row, i]
        limit = r[limits, i]
        v = a[V, i]
        force_size = abs(force)
        excess = force_size - limit
        is_still = v == 0.0
        # (1) and (3): along the motion, or at rest along the pulling force.
        direction_source = force if is_still else v
        rest_divisor = force_size if force_size > 0.0 else 1.0
        divisor = rest_divisor if is_still else abs(v)
        direction = direction_source / divisor
        friction = limit * direction
        slip_acceleration = (force - friction) / a[MASS, i]
        is_held = is_still and force_size <= limit
        # The later stages of the step overwrite EXCESS_AFTER.
        a[EXCESS_BEFORE, i] = excess
        a[EXCESS_AFTER, i] = excess
        a[DIRECTION, i] = direction
        a[F1, i] = friction
        a[K1, i] = 0.0 if is_held else slip_acceleration
        block.n[IS_STICKING, i] = 1 if is_held else 0
    compute_further_coordinates(block, K1, F1)


def compute_acceleration(block: Block, row_of_result: int, friction_row: int) -> None:
    """Compute the accelerations of all slots at a later stage of a Runge-Kutta step.

    The registers hold the time, positions and velocities of that stage. The force program runs for
    all slots together, then dry friction is subtracted: `begin_step` determined which elements
    stick, and the direction of friction for the others. There are three cases: no dry friction;
    dry friction on one coordinate of a system without ground, computed for all slots together; and
    any other, computed for one element after the other.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.flags` states what the system has, such as
            dry friction.
        row_of_result: first row of `block.a` for the accelerations, one of K2, K3 and K4.
        friction_row: first row of `block.a` for the dry friction, one of F2, F3 and F4.
    """
    run_part(block, FORCES)
    if block.flags[HAS_FRICTION] == 0:
        compute_frictionless_acceleration(block, row_of_result)
        return
    # The faster version does not know the ground, which may support an element.
    if block.flags[FRICTION_COORDINATE_COUNT] == 1 and block.flags[BOUNCES] == 0:
        compute_acceleration_1d(block, row_of_result, friction_row)
        return
    for i in range(block.w):
        compute_acceleration_nd(block, i, row_of_result, friction_row)


def compute_acceleration_1d(block: Block, row_of_result: int, friction_row: int) -> None:
    """Compute the accelerations of all slots at a later stage of a Runge-Kutta step.

    This is the version for dry friction on the first coordinate only, without ground. The direction
    of friction, and which elements stick, are those of the beginning of the step. It also stores
    the excess of the force without dry friction over the friction limit, from which a break-away is
    detected.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.rows[NAME]` is the register of an input or
            an output, the first one if there are several. `block.out[k]` is the register of the
            force on coordinate k.
        row_of_result: first row of the accelerations in `block.a`, one of K1 to K4.
        friction_row: first row of the dry friction in `block.a`, one of F1 to F4.
    """
    a = block.a
    r = block.r
    limits = block.rows[OUT_LIMIT]
    force_row = block.out[0]
    for i in range(block.w):
        force = r[force_row, i]
        limit = r[limits, i]
        friction = limit * a[DIRECTION, i]
        slip_acceleration = (force - friction) / a[MASS, i]
        a[EXCESS_AFTER, i] = abs(force) - limit
        a[friction_row, i] = friction
        a[row_of_result, i] = 0.0 if block.n[IS_STICKING, i] != 0 else slip_acceleration
    compute_further_coordinates(block, row_of_result, friction_row)


def compute_further_coordinates(block: Block, row_of_result: int, friction_row: int) -> None:
    """Compute the accelerations of the coordinates after the first, which have no dry friction.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.out[k]` is the register of the force on coordinate k.
            `block.flags` states what the system has, such as dry friction.
        row_of_result: first row of the accelerations in `block.a`, one of K1 to K4.
        friction_row: first row of the dry friction in `block.a`, one of F1 to F4.
    """
    a = block.a
    for k in range(1, block.flags[DIMENSIONS]):
        force_row = block.out[k]
        for i in range(block.w):
            a[DIRECTION + k, i] = 0.0
            a[friction_row + k, i] = 0.0
            a[row_of_result + k, i] = block.r[force_row, i] / a[MASS, i]


def compute_acceleration_nd(block: Block, i: int, row_of_result: int, friction_row: int) -> None:
    """Compute one element's acceleration if friction acts on several coordinates, or with ground.

    Friction points against the velocity of this stage, unless that has reversed since the beginning
    of the step; then friction keeps its side. An element that sticks has zero acceleration along
    the coordinates with dry friction.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.rows[NAME]` is the register of an input or an output, the
            first one if there are several. `block.flags` states what the system has, such as dry
            friction.
        i: index of the slot, the column of the batch element.
        row_of_result: first row of the accelerations in `block.a`, one of K1 to K4.
        friction_row: first row of the dry friction in `block.a`, one of F1 to F4.
    """
    a = block.a
    friction_coordinate_count = block.flags[FRICTION_COORDINATE_COUNT]
    velocity = block.rows[IN_V]
    limit = block.r[block.rows[OUT_LIMIT], i]
    # At first, the rows of the result hold forces; below, they are divided by the mass.
    compute_force_without_friction(block, i, row_of_result)
    # Where the excess becomes positive, a sticking element breaks away.
    a[EXCESS_AFTER, i] = compute_norm(a, row_of_result, friction_coordinate_count, i) - limit
    # The direction may turn within the step, but must not reverse: a reversal is an event at which
    # the step is cut.
    squared_speed = 0.0
    for k in range(friction_coordinate_count):
        squared_speed += block.r[velocity + k, i] * block.r[velocity + k, i]
    speed = np.sqrt(squared_speed)
    # The rows of friction hold the unit vector of the velocity first.
    projection = 0.0
    for k in range(friction_coordinate_count):
        direction = a[DIRECTION + k, i]
        component = block.r[velocity + k, i] / speed if speed > 0.0 else direction
        a[friction_row + k, i] = component
        projection += component * direction
    sign = -1.0 if projection < 0.0 else 1.0
    for k in range(friction_coordinate_count):
        friction = limit * (a[friction_row + k, i] * sign)
        a[friction_row + k, i] = friction
        slip_acceleration = (a[row_of_result + k, i] - friction) / a[MASS, i]
        a[row_of_result + k, i] = 0.0 if block.n[IS_STICKING, i] != 0 else slip_acceleration
    compute_acceleration_without_friction(block, i, row_of_result, friction_row)


def compute_acceleration_without_friction(
    block: Block, i: int, row_of_result: int, friction_row: int
) -> None:
    """Divide forces by the mass, for the coordinates without dry friction.

    Dry friction acts on the first coordinates only, those along guides or along the ground. The
    rows of friction and of its direction are zero for the others.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.flags` states what the system has, such as dry friction.
        i: index of the slot, the column of the batch element.
        row_of_result: first row of the accelerations, which contains the forces before.
        friction_row: first row of dry friction.
    """
    a = block.a
    for k in range(block.flags[FRICTION_COORDINATE_COUNT], block.flags[DIMENSIONS]):
        a[DIRECTION + k, i] = 0.0
        a[friction_row + k, i] = 0.0
        a[row_of_result + k, i] = a[row_of_result + k, i] / a[MASS, i]


def compute_force_without_friction(block: Block, i: int, row_of_result: int) -> None:
    """Copy the forces on an element, except dry friction, from the registers to rows of `block.a`.

    If the element rests on the ground, which balances its weight, a downward force counts as zero.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. A vector has one row per coordinate: `X + k` is
            that of coordinate k. `block.out[k]` is the register of the force on coordinate k.
            `block.flags` states what the system has, such as dry friction.
        i: index of the slot, the column of the batch element.
        row_of_result: first row of the forces.
    """
    d = block.flags[DIMENSIONS]
    for k in range(d):
        block.a[row_of_result + k, i] = block.r[block.out[k], i]
    if block.n[IS_RESTING, i] != 0:
        # The ground pushes but does not pull: an upward force remains.
        last_row = row_of_result + d - 1
        block.a[last_row, i] = nan_maximum(block.a[last_row, i], 0.0)


def compute_frictionless_acceleration(block: Block, row_of_result: int) -> None:
    """Compute the accelerations of all slots if the system has no dry friction: force / mass.

    If an element rests on the ground, which balances its weight, a downward force counts as zero.

    Args:
        block: force program, simulations (elements) of a batch, and their buffers. Each of the
            `block.w` slots in use holds one element: slot i its numbers in `block.a[ROW, i]`, its
            integers in `block.n[ROW, i]`, and the registers of the force program, inputs and forces
            among them, in `block.r[REGISTER, i]`. `block.out[k]` is the register of the force on
            coordinate k. `block.flags` states what the system has, such as dry friction.
        row_of_result: first row of the accelerations.
    """
    a = block.a
    d = block.flags[DIMENSIONS]
    for k in range(d):
        force_row = block.out[k]
        row = row_of_result + k
        for i in range(block.w):
            a[row, i] = block.r[force_row, i] / a[MASS, i]
    if block.flags[BOUNCES] != 0:
        # The last coordinate is the height. The ground pushes but does not pull: an upward force
        # remains.
        last_row = row_of_result + d - 1
        for i in range(block.w):
            if block.n[IS_RESTING, i] != 0:
                a[last_row, i] = nan_maximum(block.r[block.out[d - 1], i], 0.0) / a[MASS, i]


def dot(a: FloatArray, first_vector: int, second_vector: int, d: int, i: int) -> float:
    """Return the inner product of two vectors.

    Args:
        a: (rows, slots) numbers; a vector is in consecutive rows of one column.
        first_vector: first row of the first vector.
        second_vector: first row of the second vector.
        d: number of dimensions.
        i: index of the slot, the column of the batch element.
    """
    total = a[first_vector, i] * a[second_vector, i]
    for k in range(1, d):
        total += a[first_vector + k, i] * a[second_vector + k, i]
    return total  # type: ignore[no-any-return]


def compute_norm(a: FloatArray, first_vector: int, d: int, i: int) -> float:
    """Return the magnitude of a vector.

    Args:
        a: (rows, slots) numbers; a vector is in consecutive rows of one column.
        first_vector: first row of the vector.
        d: number of dimensions.
        i: index of the slot, the column of the batch element.
    """
    if d == 1:
        return abs(a[first_vector, i])  # type: ignore[no-any-return]
    return np.sqrt(dot(a, first_vector, first_vector, d, i))  # type: ignore[no-any-return]
