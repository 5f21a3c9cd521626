"""Selection of the effects that are active on a batch, by how and where they act."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sims.core.effect import ActiveEffects, Effect, Force, Friction, HiddenStateEffect
from sims.core.simulator import Array
from sims.robot.dynamics.midpoint_state import IndexArray, Mask
from sims.robot.model_field_effects import is_model_field_effect
from sims.robot.places.placed_effect_classes import SHARED_ACTUATOR_EFFECTS

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


def is_in_drive(effect: Effect) -> bool:
    """Return whether the force of an effect is part of the drive force that a sensor reads."""
    return isinstance(effect, Force) and (
        effect.at == "actuator" or effect.of in SHARED_ACTUATOR_EFFECTS
    )


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
        """Select the effects that must be evaluated in every step, and sort them by their kind.

        Each of them is of one of the three kinds: force, dry friction, or hidden state.

        Args:
            acting: effects at one place each, with K coefficients for L batch elements, (K, L, 1).
        """
        selected = [(e, c) for e, c in acting if is_evaluated_per_step(e)]
        return cls(
            tuple((e, c) for e, c in selected if isinstance(e, Force)),
            tuple((e, c) for e, c in selected if isinstance(e, Friction)),
            tuple((e, c) for e, c in selected if isinstance(e, HiddenStateEffect)),
        )

    @property
    def coefficients(self) -> Array:
        """Coefficients (K, L) of all effects, one after the other."""
        return np.concatenate([c[:, :, 0] for group in self for _, c in group])

    def with_coefficients(self, rows: Any) -> StepEffects:
        """Return the effects with other coefficients.

        The groups (forces, frictions, hidden) and the order of the effects are those of this
        object.

        Args:
            rows: (L, K) K coefficients of all effects together for L batch elements, in the order
                of `coefficients`.
        """
        # Columns after the last coefficient of each effect.
        ends = np.cumsum([len(effect.coefficients) for group in self for effect, _ in group])
        columns_of_effects = iter(np.split(rows, ends[:-1], axis=1))
        groups: Any = (
            # An effect has coefficients of the shape (its number, L, 1).
            tuple((effect, next(columns_of_effects).T[:, :, None]) for effect, _ in group)
            for group in self
        )
        return StepEffects(*groups)


def find_active_elements(
    acting: ActiveEffects, count: int, which: Callable[[Effect], bool]
) -> Mask:
    """Find the batch elements in which an effect of some kind is active.

    An effect is active in an element if any of its coefficients is not zero there.

    Args:
        acting: effects with K coefficients each, (K, L, 1).
        count: number L of batch elements.
        which: returns whether an effect is of this kind, such as `is_evaluated_per_step`.

    Returns:
        (L,) whether any effect of this kind is active.
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

    Shapes: K coefficients of an effect, n batch elements in use.

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
