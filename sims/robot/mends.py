"""What MuJoCo's compiler refuses and can be mended: moments of inertia, and massless bodies."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from sims.base import InputError
from sims.limits import cut
from sims.robot.quiet import one_line

MASS = 1e-6
"""kg of a body that states none and moves."""
MOMENT = 1e-9
"""kg m^2 of its principal moments."""
ROUNDING = 1e-9
"""Part of a moment by which sums are kept on the right side."""


def compiled(spec: Any, notes: list[str]) -> Any:
    """The compiled model; what is mended on the way is changed in the spec and noted.

    Raises:
        ValueError: MuJoCo refuses the model, in its own words.
    """
    for _ in range(len(spec.bodies) + 2):
        try:
            return spec.compile()
        except ValueError as error:
            if not _mended(spec, one_line(error), notes):
                raise
    raise InputError("too many bodies have neither mass nor inertia")


def _mended(spec: Any, said: str, notes: list[str]) -> bool:
    if "balanceinertia" in said:
        unbalanced = [body for body in spec.bodies if _lack(_moments(body)[0]) > 0]
        notes += [_balance(body) for body in unbalanced]
        return bool(unbalanced)
    named = re.search(r"Element name '([^']*)'", said)
    if "mass and inertia of moving bodies" in said and named:
        return _given_mass(spec, named[1], notes)
    return False


def _lack(moments: Any) -> float:
    """By how much the largest principal moment exceeds what the two others allow."""
    return float(2 * np.max(moments) - np.sum(moments))


def _balance(body: Any) -> str:
    """Take the nearest moments that a body can have: A + B = C."""
    moments, axes = _moments(body)
    third = (_lack(moments) + ROUNDING * np.max(moments)) / 3
    nearest = np.where(moments == np.max(moments), moments - third, moments + third)
    _state(body, nearest, axes)
    before, after = (", ".join(f"{m:.4g}" for m in sorted(row)) for row in (moments, nearest))
    return (
        f"{cut(body.name)}: no body has the principal moments {before} kg m^2 (A + B < C); the "
        f"nearest are taken, {after}"
    )


def _moments(body: Any) -> tuple[Any, Any]:
    """Principal moments as stated, kg m^2, and their axes; None where they are the body's own."""
    full = np.asarray(body.fullinertia, dtype=float)
    if np.isfinite(full).all() and full.any():
        xx, yy, zz, xy, xz, yz = full
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return moments, axes
    return np.nan_to_num(np.asarray(body.inertia, dtype=float)), None


def _state(body: Any, moments: Any, axes: Any) -> None:
    if axes is None:
        body.inertia = moments
        return
    tensor = axes @ np.diag(moments) @ axes.T
    body.fullinertia = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]


def _given_mass(spec: Any, name: str, notes: list[str]) -> bool:
    body = next((body for body in spec.bodies if body.name == name), None)
    if body is None:
        return False
    mass, (moments, axes) = float(np.nan_to_num(body.mass)), _moments(body)
    if mass >= MASS and min(moments) >= MOMENT:
        return False
    body.mass = max(mass, MASS)
    _state(body, np.maximum(moments, MOMENT), axes)
    body.explicitinertial = True
    what = f"a mass of {MASS:g} kg and moments" if mass < MASS else "moments"
    carries = "" if list(body.bodies) else "; nothing hangs on its joint"
    notes.append(f"{cut(name)}: moves without inertia; given {what} of {MOMENT:g} kg m^2{carries}")
    return True
