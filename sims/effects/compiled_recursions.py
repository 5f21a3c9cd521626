"""Recursions of effects with memory over the steps of a run, compiled once.

A step in Python takes some microseconds, and a recording has up to a hundred thousand steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.engines.compiled.compiled_functions import CompiledFunctions
from sims.engines.compiled.interpreter import nan_maximum, nan_minimum

LINEAR, CLAMP, RATE_LIMIT, ACCELERATION_LIMIT = range(4)
"""Recursions: y' = a y + b; y' = min(max(y, a), b); y' = y + min(max(a - y, -b), b).

The fourth one is `move_with_limited_acceleration`.
"""


def run_recursion(kind: int, a: Array, b: Array, start: Array) -> Array:
    """Run a recursion over S steps of L batch elements.

    Args:
        kind: `LINEAR`, `CLAMP`, `RATE_LIMIT` or `ACCELERATION_LIMIT`.
        a: (L, S) first operand of each step; for a limited acceleration the set point.
        b: (L, S) second operand of each step; for a limited acceleration the step length.
        start: (L, 1) value before the first step; for a limited acceleration (L, 2), the value and
            the limit.

    Returns:
        Values (L, S) after each step; for a limited acceleration means over each step.
    """
    first, second = (
        np.ascontiguousarray(values, dtype=np.float64) for values in np.broadcast_arrays(a, b)
    )
    begin = np.zeros((len(first), 2))
    begin[:, : start.shape[1]] = start
    (result,) = COMPILED.call(step_elements, kind, first, second, begin)
    return result


def step_elements(kind: int, a: Any, b: Any, start: Any, result: Any) -> None:
    """Write the values y of a recursion after each step into `result` (compiled).

    Kinds: `LINEAR`, y = a y + b; `CLAMP` to the range from a to b; `RATE_LIMIT`, towards a by at
    most b; `ACCELERATION_LIMIT`, see `move_with_limited_acceleration`.

    Shapes: L batch elements, S steps.

    Args:
        kind: Kind of the recursion.
        a: (L, S) first operand of each step.
        b: (L, S) second operand of each step.
        start: (L, 2) value before the first step, and for a limited acceleration the limit.
        result: (L, S) values after each step; for a limited acceleration means over each step.
    """
    for i in range(result.shape[0]):
        if kind == ACCELERATION_LIMIT:
            move_with_limited_acceleration(a[i], b[i], start[i], result[i])
            continue
        y = start[i, 0]
        for k in range(result.shape[1]):
            if kind == LINEAR:
                y = a[i, k] * y + b[i, k]
            elif kind == CLAMP:
                y = nan_minimum(nan_maximum(y, a[i, k]), b[i, k])
            else:  # RATE_LIMIT
                y = y + nan_maximum(nan_minimum(a[i, k] - y, b[i, k]), -b[i, k])
            result[i, k] = y


def move_with_limited_acceleration(commands: Any, steps: Any, start: Any, means: Any) -> None:
    """Write the means over each step of a set point that is limited in acceleration.

    At the end of a step of length h, which begins with speed v at a distance d from the command,
    the distance d - h (v + w) / 2 remains. The speed w is the largest with which this is enough for
    stopping: w h / 2 if one more step is enough, w^2 / (2 c) if it takes longer. It changes by at
    most c h in a step.

    Shapes: S steps.

    Args:
        commands: (S,) set point before the limit.
        steps: (S,) lengths h in seconds.
        start: (2,) position before the first step, and the limit c of the acceleration.
        means: (S,) result.
    """
    position, limit, speed = start[0], start[1], 0.0
    for k in range(commands.shape[0]):
        h = steps[k]
        max_change = limit * h
        deviation = commands[k] - position
        # Speeds towards the command are positive.
        direction = np.copysign(1.0, deviation)
        # In the equations: d is `distance`, v `old_speed`, w `new_speed`, c `limit`, p `position`.
        distance, old_speed = abs(deviation), direction * speed
        step_distance = h * old_speed
        # Solution of d - h (v + w) / 2 = w h / 2.
        one_step_speed = (distance - 0.5 * step_distance) / h if h > 0.0 else 0.0
        # Solution of d - h (v + w) / 2 = w^2 / (2 c); one step is enough up to the speed c h.
        square = 0.25 * max_change * max_change + limit * (2.0 * distance - step_distance)
        root = np.sqrt(nan_maximum(square, 0.0))
        braking_speed = nan_maximum(root - 0.5 * max_change, max_change)
        new_speed = nan_maximum(nan_minimum(one_step_speed, braking_speed), old_speed - max_change)
        next_speed = direction * nan_minimum(new_speed, old_speed + max_change)
        # The acceleration is constant in the step, which gives the mean p + h (2 v + w) / 6.
        travel = 0.5 * h * (speed + next_speed)
        means[k] = position + (travel + 0.5 * h * speed) / 3.0
        position, speed = position + travel, next_speed


COMPILED = CompiledFunctions(
    __name__,
    "the effects with memory",
    {step_elements: ("#", "ls", "ls", "l2", "ls")},
)
