"""Contacts that a URDF cannot mean: between the fixed base and what hangs on it, and between parts
that stand within each other.
"""

from __future__ import annotations

from typing import Any

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
