"""Finite-difference Jacobians of one step of a robot's simulation, at all points of a motion.

A step of MuJoCo is the map z_{t+1} = F(z_t, u_t, f_t; p) of the state z = (q, v, a), the controls
u, generalised forces f and model parameters p. Along one motion,

    A_t = dF/dz,   B_t = dF/df,   C_t = dF/du                                                  (1)

are difference quotients, computed for all points at once: each batch element makes a step from
another sample time. Derivatives of readings follow in the same way.

A step of the classical Runge-Kutta method with length h evaluates the dynamics four times. Its
quotients follow from those of the acceleration a(q, v, f, u). With

    K = [[0, I], [da/dq, da/dv]],   L = [[0], [da/df]]

held within a step, and the stability function of the method (E. Hairer, G. Wanner, Solving Ordinary
Differential Equations II, 1996, section IV.2, doi:10.1007/978-3-642-05221-7),

    A = I + P K,   B = P L,   P = h I + h^2 K / 2 + h^3 K^2 / 6 + h^4 K^3 / 24                 (2)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.dynamics.linearisation_points import Displacements, LimbNumbers, LinearisationPoints

POSITION_DIFFERENCE, VELOCITY_DIFFERENCE, CONTROL_DIFFERENCE, FORCE_DIFFERENCE_SHARE = (
    1e-6,
    1e-5,
    1e-5,
    1e-3,
)
"""Finite differences of a position (rad or m), a velocity, a control, and a force.

The difference of a force is a share of its typical size.
"""
SUSPECT_RATIO = 10.0
"""Ratio of a derivative to its median over all points above which its growth is computed."""
MAX_STEP_GROWTH = 2.0
"""Maximum growth of a deviation in one step: the spectral radius of A."""


class DifferenceQuotients(NamedTuple):
    """Difference quotients of (1) and of readings, for S linearisation points.

    There are Z state components, O readings, and E = D + F forces.

    Attributes:
        states: A (S, Z, Z).
        forces: B (S, Z, E).
        controls: C (S, Z, nu).
        read_states: (S, O, Z) derivatives of readings by states.
        read_forces: (S, O, E) derivatives of readings by forces.
        read_controls: (S, O, nu) derivatives of readings by controls.
    """

    states: Array
    forces: Array
    controls: Array
    read_states: Array
    read_forces: Array
    read_controls: Array


def compute_difference_quotients(
    points: LinearisationPoints,
    typical_forces: Array,
    get_base_step: Callable[[], tuple[Array, Array]],
) -> DifferenceQuotients:
    """Compute the derivatives of a step by states, forces and controls at all points.

    1. List the displacements of states, forces and controls.
    2. Compute forward differences of the state after a step. For the Runge-Kutta method,
       differentiate the accelerations instead. With contacts, which may begin or end within a
       difference, take the smaller ones of forward and backward differences by positions.
    3. For the Runge-Kutta method, compute the derivatives of the step from those of the
       accelerations.

    Args:
        points: N linearisation points of the motion.
        typical_forces: (E,) typical forces in N or N m, which set the finite differences of forces;
            E is the number of velocities, of joints and of floating bodies.
        get_base_step: function that returns the states (N, Z) after an unperturbed step from each
            point, and the readings (N, O).

    Returns:
        Derivatives of the state after a step by the Z state components (N, Z, Z), the forces
        (N, Z, E) and the controls (N, Z, nu); and those of the readings, (N, O, Z) and so on.
    """
    # 1. Displacements as quantity, index and size. The quantities are q position, v velocity,
    # a activation, w hidden state of an effect, p and r displacement and velocity of floating
    # bodies, f force, u control. The order is that of the components of a state.
    motion = points.motion
    joint_count = motion.x.shape[1]
    floating_count = typical_forces.size - joint_count
    na, nu = motion.act.shape[1], motion.controls.shape[1]
    displacements: dict[str, list[tuple[str, int, float]]] = {
        "state": [("q", j, POSITION_DIFFERENCE) for j in range(joint_count)]
        + [("v", j, VELOCITY_DIFFERENCE) for j in range(joint_count)]
        + [("a", j, CONTROL_DIFFERENCE) for j in range(na)]
        + [("w", k, CONTROL_DIFFERENCE) for k in points.hidden_state_effects]
        + [("p", j, POSITION_DIFFERENCE) for j in range(floating_count)]
        + [("r", j, VELOCITY_DIFFERENCE) for j in range(floating_count)],
        "force": [
            ("f", j, FORCE_DIFFERENCE_SHARE * float(typical_forces[j]))
            for j in range(joint_count + floating_count)
        ],
        "control": [("u", j, CONTROL_DIFFERENCE) for j in range(nu)],
    }
    # 2. Differences of the results: accelerations, or states after a step.
    if points.steps_joints_by_runge_kutta:
        # In the middle of the steps for which a derivative is used.
        evaluate = partial(points.compute_accelerations, points.acting, at_centres=True)
        unchanged_results, unchanged_readings = evaluate()
    else:
        evaluate = partial(points.step_displaced, acting=points.acting)
        unchanged_results, unchanged_readings = get_base_step()
    # Limbs that do not influence each other are displaced together (A. R. Curtis, M. J. D. Powell,
    # J. K. Reid, IMA J. Appl. Math. 13(1), 117, 1974, doi:10.1093/imamat/13.1.117).
    limbs = points.limbs
    # Derivatives of results and of readings, for each of the three groups of displacements.
    quotients: list[tuple[Array, Array]] = []
    for group in displacements.values():
        derivatives = np.zeros((*unchanged_results.shape, len(group)))
        reading_derivatives = np.zeros((*unchanged_readings.shape, len(group)))
        for columns in _list_simultaneous_displacements(group, limbs):
            moved = _make_displacement([group[column] for column in columns])
            results, readings = evaluate(moved=moved)
            for column in columns:
                name, j, difference = group[column]
                # A limb shows the derivatives by its own displacement.
                rows = outputs = np.s_[:]
                if limbs is not None:
                    limb = limbs.get_number(name, j)
                    rows, outputs = limbs.results == limb, limbs.outputs == limb
                change = (results - unchanged_results)[:, rows]
                derivatives[:, rows, column] = change / difference
                change = (readings - unchanged_readings)[:, outputs]
                reading_derivatives[:, outputs, column] = change / difference
            # With contacts, there is one displacement at a time.
            if name == "q" and points.has_contacts:
                # The force of a contact that begins or ends within the difference jumps.
                results, readings = evaluate(moved={name: (j, -difference)})
                backward = (unchanged_results - results) / difference
                is_smaller = np.abs(backward).max(1) < np.abs(derivatives[:, :, column]).max(1)
                derivatives[is_smaller, :, column] = backward[is_smaller]
                backward_readings = (unchanged_readings - readings) / difference
                reading_derivatives[is_smaller, :, column] = backward_readings[is_smaller]
        quotients.append((derivatives, reading_derivatives))
    (by_state, by_force, by_control), of_readings = zip(*quotients, strict=True)
    # 3. Derivatives of a Runge-Kutta step.
    if points.steps_joints_by_runge_kutta:
        by_state, by_force, by_control = compute_runge_kutta_step(
            by_state, by_force, by_control, motion.step
        )
    return replace_diverging_points(
        DifferenceQuotients(by_state, by_force, by_control, *of_readings)
    )


def _list_simultaneous_displacements(
    displacements: Sequence[tuple[str, int, float]], limbs: LimbNumbers | None
) -> list[list[int]]:
    """List the displacements that are made together: of one quantity, one in each limb.

    Args:
        displacements: quantity, index and size of each displacement.
        limbs: limb of each component of the robot; None if displacements are made one by one.

    Returns:
        Positions in `displacements` of those that are made together.
    """
    if limbs is None:
        return [[position] for position in range(len(displacements))]
    # The number of earlier displacements of the same quantity in the same limb is that of the step.
    counts: Counter[tuple[str, int]] = Counter()
    together: dict[tuple[str, int], list[int]] = {}
    for position, (name, index, _) in enumerate(displacements):
        key = name, limbs.get_number(name, index)
        together.setdefault((name, counts[key]), []).append(position)
        counts[key] += 1
    return list(together.values())


def _make_displacement(displacements: Sequence[tuple[str, int, float]]) -> Displacements:
    """Return displacements of one quantity, as `LinearisationPoints.step_displaced` takes them."""
    names, indices, sizes = zip(*displacements, strict=True)
    if len(displacements) == 1:
        return {names[0]: (indices[0], sizes[0])}
    return {names[0]: (np.array(indices), np.array(sizes))}


def compute_runge_kutta_step(
    by_state: Array, by_force: Array, by_control: Array, step: float
) -> tuple[Array, Array, Array]:
    """Compute the derivatives of a Runge-Kutta step from those of the acceleration.

    With positions q, velocities v, accelerations a and forces f, the derivative of the state's rate
    by the state (q, v) is K = [[0, I], [da/dq, da/dv]], and by a force L = [[0], [da/df]]. Held
    constant in a step of length h, they give the derivatives A = I + P K by the state and B = P L
    by forces, with P = h I + h^2 K / 2 + h^3 K^2 / 6 + h^4 K^3 / 24 (2).

    Args:
        by_state: (N, D, 2 D) derivatives of accelerations of D joints by positions and velocities,
            at N points.
        by_force: (N, D, E) derivatives by E forces.
        by_control: (N, D, nu) derivatives by controls.
        step: step length h in seconds.

    Returns:
        Derivatives (N, 2 D, 2 D), (N, 2 D, E) and (N, 2 D, nu) of the state after the step.
    """
    points, joints, size = by_state.shape
    rates = np.zeros((points, size, size))  # K
    rates[:, :joints, joints:] = np.eye(joints)
    rates[:, joints:] = by_state
    scaled = step * rates  # h K
    unit = np.eye(size)
    # P, by Horner's rule.
    propagator = step * (unit + scaled @ (unit / 2 + scaled @ (unit / 6 + scaled / 24)))
    of_velocity = propagator[:, :, joints:]  # L is zero for the positions
    return unit + propagator @ rates, of_velocity @ by_force, of_velocity @ by_control


def replace_diverging_points(quotients: DifferenceQuotients) -> DifferenceQuotients:
    """Replace derivatives that were computed across a jump by those of the nearest other point.

    Where a contact begins or ends within a finite difference, the difference quotient is a jump
    divided by the difference: it multiplies deviations by hundreds, although the real change is
    small, and a filter could not follow. Points with unusually large derivatives are suspects; they
    are replaced if a deviation would grow by more than `MAX_STEP_GROWTH` in one step. If all points
    diverge, nothing is replaced.

    Args:
        quotients: the derivatives of a step at all points, in the order of time; those of the state
            after it by the state before it are the matrices `states`.
    """
    largest = np.abs(quotients.states).max(axis=(1, 2), initial=0.0)
    # The comparison is false for NaN, so these points are suspects, too.
    suspects = np.flatnonzero(~(largest <= SUSPECT_RATIO * np.median(largest)))
    diverges = np.zeros(largest.size, dtype=bool)
    for point in suspects.tolist():
        # The growth in one step is the spectral radius of the matrix.
        matrix = quotients.states[point]
        diverges[point] = (
            not np.isfinite(matrix).all()
            or np.abs(np.linalg.eigvals(matrix)).max() > MAX_STEP_GROWTH
        )
    others = np.flatnonzero(~diverges)
    if not diverges.any() or not others.size:
        return quotients
    # Each point takes all derivatives from a source: itself, or the nearest point that is valid.
    sources = np.arange(largest.size)
    for point in np.flatnonzero(diverges).tolist():
        sources[point] = others[np.argmin(np.abs(others - point))]
    return DifferenceQuotients(*(values[sources] for values in quotients))
