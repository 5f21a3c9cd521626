"""Find the geoms that can collide, and exclude contacts that exist in the model file only.

The excluded contacts are those between the fixed base and the bodies attached to it, and those
between bodies that overlap at the zero position.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.robot.mujoco_messages import format_name_list

OVERLAP_DEPTH = 1e-4
"""Minimum overlap, in metres, at the zero position of two shapes that are not meant to touch."""


def exclude_spurious_contacts(spec: Any, model: Any) -> list[str]:
    """Exclude contacts between bodies that overlap in the model file, but not in reality.

    Shapes of neighbouring links often overlap at their joint, and would push each other apart with
    large forces. Two kinds of contacts are excluded:

    * Between the fixed base and the bodies attached to it. MuJoCo itself excludes contacts between
      a body and its parent, except if the parent is the world, to which the root of a URDF is
      fused.
    * Between bodies that overlap at the zero position by more than `OVERLAP_DEPTH`.

    Args:
        spec: editable MuJoCo model (`mujoco.MjSpec`), changed in place.
        model: compiled model of `spec`.

    Returns:
        Notes, one for each kind of excluded contact.
    """
    import mujoco

    # Children of the base with a geom that collides: its contact type is not 0. MuJoCo's body 0 is
    # the world, and so the fixed base.
    colliding_bodies = {
        int(body)
        for body, contact_type in zip(model.geom_bodyid, model.geom_contype, strict=True)
        if contact_type
    }
    base_children = []
    if 0 in colliding_bodies:
        base_children = [
            i for i in sorted(colliding_bodies) if i and int(model.body_parentid[i]) == 0
        ]
    # Overlaps at the zero position.
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    overlapping_pairs = set()
    for contact in data.contact:
        first, second = sorted(int(model.geom_bodyid[geom]) for geom in contact.geom)
        is_with_base = first == 0 and second in base_children
        if contact.dist < -OVERLAP_DEPTH and not is_with_base:
            overlapping_pairs.add((first, second))
    # Exclusions and notes. Body 0 is the base.
    names = [model.body(i).name for i in range(model.nbody)]
    for first, second in [*((0, i) for i in base_children), *sorted(overlapping_pairs)]:
        spec.add_exclude(bodyname1=names[first], bodyname2=names[second])
    notes = []
    if base_children:
        listing = format_name_list([names[i] for i in base_children])
        notes.append(f"no contacts between the fixed base and the bodies attached to it: {listing}")
    if overlapping_pairs:
        names[0] = "the base"
        pairs = [
            f"{names[first]} and {names[second]}" for first, second in sorted(overlapping_pairs)
        ]
        notes.append(
            "no contacts between parts that overlap at the zero position: "
            f"{format_name_list(pairs)}"
        )
    return notes


def can_collide(model: Any) -> bool:
    """Return whether any two shapes of a compiled model can collide."""
    return bool(model.nflex or find_colliding_geoms(model).any())


def find_colliding_geoms(model: Any) -> NDArray[np.bool_]:
    """Find the geoms (shapes) of a compiled model that can collide with another geom.

    All others can be left out to save memory. Pairs are filtered by MuJoCo's own rules (its
    documentation, "Computation", collision detection):

    * The bit masks contype and conaffinity of the two geoms must match.
    * Their bodies must not be welded together, nor parent and child, nor excluded by the file.
    * Pairs that the file lists explicitly always collide.

    Args:
        model: the mujoco.MjModel, without flexes.

    Returns:
        (ngeom,) whether each geom can collide.
    """
    import mujoco

    # Number of the topmost body to which each body is welded, that is, attached without a joint.
    weld = np.asarray(model.body_weldid)
    bodies = np.asarray(model.geom_bodyid)
    geom_rows = (bodies, model.geom_contype, model.geom_conaffinity)
    # Many geoms of a body have equal masks; equal rows are merged to keep the matrices small.
    (body, contype, affinity), row_indices = np.unique(
        np.stack(geom_rows), axis=1, return_inverse=True
    )
    # Matrices of all pairs of rows: which pairs can collide.
    masks = contype[:, None] & affinity
    can_collide = (masks | masks.T) != 0
    weld_ids = weld[body]
    can_collide &= weld_ids[:, None] != weld_ids
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        # MuJoCo excludes contacts between a body and its parent, except if the parent is the world.
        parent_weld = weld[np.asarray(model.body_parentid)[weld_ids]]
        is_parent_pair = (
            (parent_weld[:, None] == weld_ids) & (weld_ids != 0) & (weld_ids[:, None] != 0)
        )
        can_collide &= ~(is_parent_pair | is_parent_pair.T)
    # MuJoCo stores an excluded pair of bodies as one number, the smaller body in the upper bits.
    first, second = np.minimum(body[:, None], body), np.maximum(body[:, None], body)
    can_collide &= ~np.isin((first << 16) + second, model.exclude_signature)
    # From rows back to geoms; those in listed pairs always collide.
    result: NDArray[np.bool_] = can_collide.any(axis=1)[row_indices.reshape(-1)]
    result[[*model.pair_geom1, *model.pair_geom2]] = True
    return result
