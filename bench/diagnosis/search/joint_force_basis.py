"""Hat basis forces along single joints, for the lack-of-fit test of systems with several joints.

A hat is a triangular basis function of time, position or speed: eq. (1) of
`bench.diagnosis.search.lack_of_fit`. The forces here are for systems in which each coordinate has
its own drive and friction.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import Coefficient, Force
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

TIME, POSITION, SPEED = 0, 1, 2
"""Variables of a hat: time, position or speed of the joint."""
ALONG, AGAINST, DRY = 0, 1, 2
"""Directions of a hat: along the joint, against its motion in proportion to speed, or dry."""


class JointHatForce(Force):
    """A force within an interval of time, position or speed of one joint."""

    name = "probe.joint_hat"
    says = "a force acts in an interval of time, position or speed"
    source = "this module"
    of = "probe.joint_hat"
    is_traceable = False  # joint, variable and direction are chosen by the values of coefficients
    coefficients = tuple(
        Coefficient(name, ("1", "1", "1"), ((-1, 1), (-1, 1), (-1, 1)))
        for name in ("strength", "joint", "variable", "centre", "width", "direction", "slow")
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return strength times a triangle around the centre.

        All batch elements of a call have the same joint, variable and direction.
        """
        strength, joint, variable, centre, width, direction, reversal_speed = c
        active_elements = np.flatnonzero(strength[:, 0])
        if not active_elements.size:
            return np.zeros_like(moment.x)
        j = int(joint[active_elements[0], 0])
        x, v = moment.x[:, j, None], moment.v[:, j, None]
        variable_index = int(variable[active_elements[0], 0])
        value = (moment.t, x, np.abs(v))[variable_index]
        # A hat that is off has zero width, which must not be a divisor.
        height = np.maximum(1.0 - np.abs(value - centre) / np.maximum(width, 1e-12), 0.0)
        dry_direction = -v / (np.abs(v) + np.maximum(reversal_speed, 1e-9))
        force_direction = (np.ones_like(v), -v, dry_direction)[
            int(direction[active_elements[0], 0])
        ]
        result = np.zeros_like(moment.x)
        result[:, j] = (strength * height * force_direction)[:, 0]
        return result


class JointHatFamily(NamedTuple):
    """Hats over the range of one variable of one joint, with one direction."""

    label: str
    joint: int
    variable: int
    direction: int
    low: float
    high: float
    slow: float


def list_joint_families(evaluator: RunEvaluator, speed_share: float) -> Iterator[JointHatFamily]:
    """Yield every family of hats that the recording can show.

    Args:
        evaluator: the runs.
        speed_share: speed over which dry friction reverses its sign, as a share of the high speed
            of a joint.
    """
    longest_run = evaluator.longest_duration
    for joint, name in enumerate(evaluator.simulator.system.coordinates):
        if name not in evaluator.channels:
            continue
        values = evaluator.observed[:, :, evaluator.channels.index(name)]
        # Quantiles instead of extremes, so that single outliers do not widen the range.
        low, high = (float(v) for v in np.nanquantile(values, [0.01, 0.99]))
        speed = _compute_high_speed(evaluator, evaluator.channels.index(name))
        reversal_speed = speed_share * speed
        yield JointHatFamily(
            f"time, along {name}", joint, TIME, ALONG, 0.0, longest_run, reversal_speed
        )
        if high > low:
            for direction, direction_text in (
                (ALONG, "along it"),
                (AGAINST, "against it"),
                (DRY, "dry"),
            ):
                label = f"position {name}, {direction_text}"
                yield JointHatFamily(label, joint, POSITION, direction, low, high, reversal_speed)
        if speed > 0:
            for direction, direction_text in ((AGAINST, "against it"), (DRY, "dry")):
                label = f"speed of {name}, {direction_text}"
                yield JointHatFamily(label, joint, SPEED, direction, 0.0, speed, reversal_speed)


def _compute_high_speed(evaluator: RunEvaluator, channel: int) -> float:
    """Return the 98 % quantile of the speed of a joint, from differences of its recorded position.

    The quantile is used instead of the maximum, because single differences may be noise.
    """
    rates = [np.zeros(1)]
    for track in evaluator.prepared_runs:
        if len(track.observed) > 3:
            # Use every third sample, because differences of neighbours are mostly noise.
            step = np.diff(track.scenario.times[::3])
            rates.append(np.diff(track.observed[::3, channel]) / step)
    return float(np.nanquantile(np.abs(np.concatenate(rates)), 0.98))
