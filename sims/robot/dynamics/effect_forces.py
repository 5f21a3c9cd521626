"""Evaluate effects on a batch of robots: forces and limits of dry friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sims.core.effect import ActiveEffects, Force, Friction
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import TIME_DEPENDENT_EFFECTS, is_in_drive
from sims.robot.robot_system import RobotSystem
from sims.robot.state_snapshots import RobotSnapshot


def make_snapshot(
    system: RobotSystem,
    t: Array,
    x: Array,
    v: Array,
    inputs: Mapping[str, Array],
    carried: Array,
    stiffness: Array | None = None,
) -> RobotSnapshot:
    """Make a snapshot: the state of L batch elements with D joints at which effects are evaluated.

    Args:
        system: system of the robot.
        t: (L, 1) time since the start in seconds.
        x: (L, D) positions.
        v: (L, D) velocities.
        inputs: applied inputs (L, 1) by name.
        carried: (2, L, D) forces on both sides of the transmissions.
        stiffness: (L, D) stiffness of position servos; no servo is active if None.
    """
    return RobotSnapshot(
        system=system,
        # The system has neither parameters nor constants: all numbers are in MuJoCo's model.
        theta=np.zeros((len(x), 0)),
        constants={},
        t=t,
        x=x,
        v=v,
        inputs=inputs,
        carried=carried,
        # Each joint as a system of its own, the inputs of its actuators, and that of its servo.
        alone=system.alone,
        drives=dict(system.drives),
        servos=dict(system.servos),
        stiffness=np.zeros((0, 0)) if stiffness is None else stiffness,
    )


def compute_time_dependent_forces(
    system: RobotSystem, acting: ActiveEffects, t: Array, size: int, batch_size: int
) -> Array:
    """Compute the forces (L, S, D) of effects that depend on time alone, for L batch elements.

    They are known before the simulation and applied as generalised forces on the D joints in S
    steps, so that the batch needs no evaluation of effects in each step.

    Args:
        system: system of the robot.
        acting: active effects with K coefficients each, (K, L, 1).
        t: (S,) beginnings of the steps in seconds; forces are evaluated half a step later.
        size: number D of coordinates.
        batch_size: number L of batch elements.
    """
    forces = np.zeros((batch_size, t.size, size))
    half_step = 0.5 * (t[1] - t[0]) if t.size > 1 else 0.0
    # The state does not matter; each step is one element of the snapshot. The force at the middle
    # of a step gives the momentum of the force over the step, to second order.
    at_rest = np.zeros((t.size, size))
    no_loads = np.stack([at_rest] * 2)
    snapshots = make_snapshot(system, (t + half_step)[:, None], at_rest, at_rest, {}, no_loads)
    for effect, c in acting:
        if effect.of not in TIME_DEPENDENT_EFFECTS or not isinstance(effect, Force):
            continue
        for batch_index in np.flatnonzero((c != 0).any(axis=0)[:, 0]):
            coefficients = np.repeat(c[:, batch_index : batch_index + 1], t.size, axis=1)
            forces[batch_index] += effect.force(coefficients, snapshots)
    return forces


def compute_drive_effect_forces(acting: ActiveEffects, snapshot: RobotSnapshot) -> Array:
    """Compute the forces (L, D) that effects in drives, such as a voltage drop, add to the drives.

    Effects that act elsewhere are ignored. Shapes: L batch elements, D joints, K coefficients. The
    unit is N or N m.

    Args:
        acting: effects with their coefficients (K, L, 1).
        snapshot: state of the batch at which the effects are evaluated.
    """
    return compute_effect_forces(
        [(e, c) for e, c in acting if isinstance(e, Force) and is_in_drive(e)], snapshot
    )


def compute_effect_forces(forces: Sequence[tuple[Force, Array]], snapshot: RobotSnapshot) -> Array:
    """Add up the forces of all effects, (L, D) in N or N m.

    Shapes: L batch elements, D joints, K coefficients.

    Args:
        forces: effects with their coefficients (K, L, 1).
        snapshot: state at which the effects are evaluated.
    """
    total = np.zeros_like(snapshot.x)
    for effect, c in forces:
        # Not in place, since the values may be symbols of a program that is compiled.
        total = total + effect.force(c, snapshot)
    return total


def compute_friction_limits(
    frictions: Sequence[tuple[Friction, Array]], snapshot: RobotSnapshot
) -> Array:
    """Add up the limits of dry friction of all effects, (L, D) in N or N m.

    MuJoCo's solver then finds the friction force within these limits.

    Shapes: L batch elements, D joints, K coefficients.

    Args:
        frictions: friction effects with their coefficients (K, L, 1).
        snapshot: state of the batch.
    """
    limit = np.zeros_like(snapshot.x)
    for effect, c in frictions:
        joint = effect.coordinate
        assert joint is not None  # dry friction always acts at a joint
        limit[:, joint] = limit[:, joint] + effect.limit(c, snapshot)[:, 0]
    return limit
