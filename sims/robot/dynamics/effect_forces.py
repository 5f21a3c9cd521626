"""Effects that are active on a batch of a robot, and their forces, precomputed or in every step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sims.core.effect import ActiveEffects, Effect, Force, Friction, HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.robot.dynamics.midpoint_state import (
    IndexArray,
    Mask,
    advance_state,
)
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS
from sims.robot.places.effect_places import SHARED_ACTUATOR_EFFECTS
from sims.robot.robot_system import RobotSystem
from sims.robot.state_snapshots import RobotSnapshot

TIME_DEPENDENT_EFFECTS = frozenset({"force.bias", "force.periodic"})
"""Effects whose force depends on time alone."""

LOAD_DEPENDENT_EFFECTS = frozenset(
    {
        "friction.load",
        "friction.load_direction",
        "friction.load_quadratic",
        "supply.braking",
        "supply.sag",
    }
)
"""Effects that depend on the loads of transmissions."""


def make_snapshot(
    system: RobotSystem,
    t: Array,
    x: Array,
    v: Array,
    inputs: Mapping[str, Array],
    carried: Array,
    stiffness: Array | None = None,
) -> RobotSnapshot:
    """Make a snapshot of batch elements, the state at which effects are evaluated.

    The system of a robot has neither parameters nor constants: all its numbers are in MuJoCo's
    model.

    Shapes: L batch elements, D joints.

    Args:
        system: system of the robot.
        t: (L, 1) time since the start in seconds.
        x: (L, D) positions.
        v: (L, D) velocities.
        inputs: applied inputs (L, 1) by name.
        carried: (2, L, D) forces on both sides of the transmissions.
        stiffness: (L, D) stiffness of position servos; no servo is active if None.
    """
    theta = np.zeros((len(x), 0))
    stiff = np.zeros((0, 0)) if stiffness is None else stiffness
    drives, servos = dict(system.drives), dict(system.servos)
    joints = system.alone, drives, servos, stiff
    return RobotSnapshot(system, theta, {}, t, x, v, inputs, carried, *joints)


def compute_time_dependent_forces(
    system: RobotSystem, acting: ActiveEffects, t: Array, size: int, batch_size: int
) -> Array:
    """Compute the forces (L, S, D) of effects that depend on time alone.

    They are known before the simulation and applied as generalised forces, so that the batch
    needs no evaluation of effects in each step.

    Shapes: S steps, K coefficients.

    Args:
        system: system of the robot.
        acting: active effects with their coefficients (K, L, 1).
        t: (S,) beginnings of the steps in seconds; forces are evaluated half a step later.
        size: number D of coordinates.
        batch_size: number L of batch elements.
    """
    forces = np.zeros((batch_size, t.size, size))
    half = 0.5 * (t[1] - t[0]) if t.size > 1 else 0.0
    at_rest = np.zeros((t.size, size))
    # The force at the middle of a step gives the momentum of the force over the step, to second
    # order.
    snapshots = make_snapshot(
        system, (t + half)[:, None], at_rest, at_rest, {}, np.stack([at_rest] * 2)
    )
    for effect, c in acting:
        if effect.of not in TIME_DEPENDENT_EFFECTS or not isinstance(effect, Force):
            continue
        for batch_index in np.flatnonzero((c != 0).any(axis=0)[:, 0]):
            coefficients = np.repeat(c[:, batch_index : batch_index + 1], t.size, axis=1)
            forces[batch_index] += effect.force(coefficients, snapshots)
    return forces


def is_in_drive(effect: Effect) -> bool:
    """Return whether the force of an effect is part of the drive force that a sensor reads."""
    return isinstance(effect, Force) and (
        effect.at == "actuator" or effect.of in SHARED_ACTUATOR_EFFECTS
    )


def compute_drive_effect_forces(acting: ActiveEffects, snapshot: RobotSnapshot) -> Array:
    """Compute the forces (L, D) that effects in drives add to the drives.

    Shapes: L batch elements, D joints, K coefficients.

    Args:
        acting: effects with their coefficients (K, L, 1).
        snapshot: state of the batch.
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
        assert joint is not None
        limit[:, joint] = limit[:, joint] + effect.limit(c, snapshot)[:, 0]
    return limit


def compute_hidden_state_forces(
    hidden: Sequence[tuple[HiddenStateEffect, Array]],
    snapshots: tuple[RobotSnapshot, RobotSnapshot],
    states: Sequence[HiddenState],
    step: float,
) -> tuple[Array, list[HiddenState]]:
    """Advance hidden states of effects, and compute their forces afterwards.

    A hidden state is a variable that an effect has beyond the joints, such as the deflection of
    bristles in a friction model. An effect whose first coefficient is zero exerts no force.

    Shapes: L batch elements, D joints.

    Args:
        hidden: effects with their coefficients.
        snapshots: snapshots at the middle and at the end of the interval.
        states: hidden states at the beginning.
        step: length of the interval in seconds.

    Returns:
        Total force (L, D) and hidden states at the end of the interval.
    """
    midpoint, end = snapshots
    total = np.zeros_like(end.x)
    later_states = []
    for (effect, c), state in zip(hidden, states, strict=True):
        after = advance_state(effect, c, midpoint, state, step)
        force, _ = effect.act(c, end, after)
        total = total + np.where(c[0] > 0, force, 0.0)
        later_states.append(after)
    return total, later_states


def is_model_field_effect(effect: Effect) -> bool:
    """Return whether the engine writes the effect into fields of the MuJoCo model."""
    has_field = (effect.of or effect.name) in MODEL_FIELD_EFFECTS
    return is_series_effect(effect) or (has_field and effect.hook in ("value", "force", "contact"))


def changes_derived_constants(effect: Effect) -> bool:
    """Return whether MuJoCo derives constants from the model fields that the effect changes."""
    return is_model_field_effect(effect) and (
        is_series_effect(effect)
        or MODEL_FIELD_EFFECTS[effect.of or effect.name].changes_derived_constants
    )


def select_model_field_effects(acting: ActiveEffects) -> ActiveEffects:
    """Select the effects that are written into fields of the MuJoCo model."""
    return tuple((e, c) for e, c in acting if is_model_field_effect(e))


def is_evaluated_per_step(effect: Effect) -> bool:
    """Return whether the force of the effect depends on the state of the robot.

    Such a force is evaluated in every step.
    """
    if effect.hook not in ("force", "hidden"):
        return False
    return not is_model_field_effect(effect) and effect.of not in TIME_DEPENDENT_EFFECTS


class StepEffects(NamedTuple):
    """Effects whose forces are evaluated in every step, with their coefficients (K, L, 1).

    Attributes:
        forces: effects with a force.
        frictions: effects with dry friction.
        hidden: effects with hidden states.
    """

    forces: tuple[tuple[Force, Array], ...]
    frictions: tuple[tuple[Friction, Array], ...]
    hidden: tuple[tuple[HiddenStateEffect, Array], ...]

    @classmethod
    def from_active(cls, acting: ActiveEffects) -> StepEffects:
        """Select and sort effects at one place each; see `is_evaluated_per_step`."""
        own = [(e, c) for e, c in acting if is_evaluated_per_step(e)]
        return cls(
            tuple((e, c) for e, c in own if isinstance(e, Force)),
            tuple((e, c) for e, c in own if isinstance(e, Friction)),
            tuple((e, c) for e, c in own if isinstance(e, HiddenStateEffect)),
        )

    @property
    def coefficients(self) -> Array:
        """Coefficients (K, L) of all effects, one after the other."""
        return np.concatenate([c[:, :, 0] for group in self for _, c in group])

    def with_coefficients(self, rows: Any) -> StepEffects:
        """Return the effects with other coefficients (L, K), in the order of `coefficients`."""
        ends = np.cumsum([len(effect.coefficients) for group in self for effect, _ in group])
        parts = iter(np.split(rows, ends[:-1], axis=1))
        groups: Any = (
            tuple((effect, next(parts).T[:, :, None]) for effect, _ in group) for group in self
        )
        return StepEffects(*groups)


def find_active_elements(
    acting: ActiveEffects, count: int, which: Callable[[Effect], bool]
) -> Mask:
    """Find the batch elements in which a selected effect is active.

    It is called to decide which batch elements can be simulated together, for example those in
    which an effect depends on the state. An effect with only zero coefficients counts as
    absent.

    Shapes: K coefficients.

    Args:
        acting: effects with their coefficients (K, L, 1).
        count: number L of batch elements.
        which: returns whether an effect is selected.

    Returns:
        (L,) whether any selected effect has a nonzero coefficient.
    """
    is_active = np.zeros(count, dtype=bool)
    for effect, c in acting:
        if which(effect):
            is_active |= (c != 0).any(axis=0)[:, 0]
    return is_active


def slice_active_effects(acting: ActiveEffects, batch_indices: IndexArray) -> ActiveEffects:
    """Restrict active effects to some batch elements, and drop effects that are zero there.

    Shapes: L batch elements, K coefficients.

    Args:
        acting: effects with their coefficients (K, L, 1).
        batch_indices: indices of the batch elements.

    Returns:
        The effects that are active there, with their coefficients for these batch elements.
    """
    parts = tuple((e, c[:, batch_indices]) for e, c in acting)
    return tuple((e, c) for e, c in parts if c.any())


def pad_coefficients(acting: ActiveEffects, n: int, count: int) -> ActiveEffects:
    """Pad coefficients with zeros to the size of a batch.

    Shapes: K coefficients.

    Args:
        acting: effects with their coefficients (K, n, 1).
        n: number of batch elements that are in use.
        count: number of all batch elements.

    Returns:
        The effects with their coefficients (K, count, 1).
    """
    return tuple(
        (e, np.concatenate([c, np.zeros((len(c), count - n, 1))], axis=1)) for e, c in acting
    )
