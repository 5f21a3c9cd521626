"""Exclude contacts that a URDF cannot mean, and find which geoms can collide.

The excluded contacts are those between the fixed base and the bodies attached to it, and those
between bodies that overlap at the zero position.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.robot.note_text import format_name_list

OVERLAP_DEPTH = 1e-4
"""Minimum overlap, in metres, at the zero position of two shapes that are not meant to touch."""


def exclude_spurious_contacts(spec: Any, model: Any) -> list[str]:
    """Exclude spurious contacts from a spec.

    MuJoCo itself excludes contacts between a body and its parent, except if the parent is the
    world; the root of a URDF is fused to the world.

    Args:
        spec: the mujoco.MjSpec; it is changed in place.
        model: the compiled model of `spec`.

    Returns:
        Notes, one for each kind of excluded contact.
    """
    import mujoco

    bodies = model.geom_bodyid
    touching = {int(body) for body, kind in zip(bodies, model.geom_contype, strict=True) if kind}
    beside = []
    if 0 in touching:
        beside = [i for i in sorted(touching) if i and int(model.body_parentid[i]) == 0]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inside = set()
    for contact in data.contact:
        pair = tuple(sorted(int(model.geom_bodyid[geom]) for geom in contact.geom))
        if contact.dist < -OVERLAP_DEPTH and not (pair[0] == 0 and pair[1] in beside):
            inside.add(pair)
    names = [model.body(i).name for i in range(model.nbody)]
    for one, other in [*((0, i) for i in beside), *sorted(inside)]:
        spec.add_exclude(bodyname1=names[one], bodyname2=names[other])
    notes = []
    if beside:
        listing = format_name_list([names[i] for i in beside])
        notes.append(f"no contacts between the fixed base and what hangs on it: {listing}")
    if inside:
        names[0] = "the base"
        pairs = [f"{names[one]} and {names[other]}" for one, other in sorted(inside)]
        notes.append(
            "no contacts between parts that overlap at the zero position: "
            f"{format_name_list(pairs)}"
        )
    return notes


def can_collide(model: Any) -> bool:
    """Return whether any two shapes of a compiled model can collide."""
    return bool(model.nflex or touching(model).any())


def touching(model: Any) -> NDArray[np.bool_]:
    """Find the geoms of a compiled model that can collide with another geom.

    The pairs are filtered by MuJoCo's own rules (its documentation, "Computation", collision
    detection).

    Args:
        model: the mujoco.MjModel, without flexes.

    Returns:
        (ngeom,) whether each geom can collide.
    """
    import mujoco

    weld = np.asarray(model.body_weldid)
    bodies = np.asarray(model.geom_bodyid)
    rows = (bodies, model.geom_contype, model.geom_conaffinity)
    # Many geoms of a body have equal masks; equal rows are merged to keep the matrices small.
    (body, kind, affinity), of = np.unique(np.stack(rows), axis=1, return_inverse=True)
    masks = kind[:, None] & affinity
    meet = (masks | masks.T) != 0
    own = weld[body]
    meet &= own[:, None] != own
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        # MuJoCo excludes contacts between a body and its parent, except if the parent is the world.
        carrier = weld[np.asarray(model.body_parentid)[own]]
        carried = (carrier[:, None] == own) & (own != 0) & (own[:, None] != 0)
        meet &= ~(carried | carried.T)
    first, second = np.minimum(body[:, None], body), np.maximum(body[:, None], body)
    meet &= ~np.isin((first << 16) + second, model.exclude_signature)
    result: NDArray[np.bool_] = meet.any(axis=1)[of.reshape(-1)]
    result[[*model.pair_geom1, *model.pair_geom2]] = True
    return result
