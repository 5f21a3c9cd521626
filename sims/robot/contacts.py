"""Contacts that a URDF cannot mean: between the fixed base and what hangs on it, and between parts
that stand within each other; and whether a model can have any.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.robot.words import listed

DEEP = 1e-4
"""m by which shapes overlap at the zero position that are never meant to touch."""


def without(spec: Any, model: Any) -> list[str]:
    """Exclude such contacts from a spec; one line for each kind.

    MuJoCo leaves out contacts between a body and the one that carries it, but for the world, to
    which it fuses a URDF's root.
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
        if contact.dist < -DEEP and not (pair[0] == 0 and pair[1] in beside):
            inside.add(pair)
    names = [model.body(i).name for i in range(model.nbody)]
    for one, other in [*((0, i) for i in beside), *sorted(inside)]:
        spec.add_exclude(bodyname1=names[one], bodyname2=names[other])
    notes = []
    if beside:
        listing = listed([names[i] for i in beside])
        notes.append(f"no contacts between the fixed base and what hangs on it: {listing}")
    if inside:
        names[0] = "the base"
        pairs = [f"{names[one]} and {names[other]}" for one, other in sorted(inside)]
        notes.append(
            f"no contacts between parts that overlap at the zero position: {listed(pairs)}"
        )
    return notes


def possible(model: Any) -> bool:
    """Whether any two shapes of a compiled model may ever touch."""
    return bool(model.nflex or touching(model).any())


def touching(model: Any) -> NDArray[np.bool_]:
    """Find the geoms of a compiled model that may ever touch another one, by MuJoCo's own rules of
    which pairs are looked at (its documentation, "Computation", collision detection).

    Args:
        model: the mujoco.MjModel, without flexes.

    Returns:
        (ngeom,) whether each may.
    """
    import mujoco

    weld = np.asarray(model.body_weldid)
    bodies = np.asarray(model.geom_bodyid)
    rows = (bodies, model.geom_contype, model.geom_conaffinity)
    # many shapes of a body have the same masks
    (body, kind, affinity), of = np.unique(np.stack(rows), axis=1, return_inverse=True)
    masks = kind[:, None] & affinity
    meet = (masks | masks.T) != 0
    own = weld[body]
    meet &= own[:, None] != own
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        # A body and the one that carries it do not touch, but for the world.
        carrier = weld[np.asarray(model.body_parentid)[own]]
        carried = (carrier[:, None] == own) & (own != 0) & (own[:, None] != 0)
        meet &= ~(carried | carried.T)
    first, second = np.minimum(body[:, None], body), np.maximum(body[:, None], body)
    meet &= ~np.isin((first << 16) + second, model.exclude_signature)
    result: NDArray[np.bool_] = meet.any(axis=1)[of.reshape(-1)]
    result[[*model.pair_geom1, *model.pair_geom2]] = True
    return result
