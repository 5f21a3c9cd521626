"""Effects active on a batch: written into the model, evaluated per step, or precomputed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sims.core.effect import ActiveEffects, Effect
from sims.robot.dynamics.effect_forces import TIME_DEPENDENT_EFFECTS
from sims.robot.dynamics.midpoint_state import IndexArray, Mask
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS


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


def find_active_elements(
    acting: ActiveEffects, count: int, which: Callable[[Effect], bool]
) -> Mask:
    """Find the batch elements in which a selected effect is active.

    It is called to decide which batch elements can be simulated together, for example those in
    which an effect depends on the state. An effect with only zero coefficients counts as
    absent.

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
