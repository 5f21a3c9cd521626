"""Joints coupled by constraints: joints of a closed loop, and joints of a joint equality."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def coupled_joints(model: Any, dofs: Sequence[int]) -> list[set[int]]:
    """Return the groups of joints that constraints of a MuJoCo model couple.

    A `connect` or `weld` constraint couples the joints between its two bodies and their common
    ancestor. A joint equality couples its two joints.

    Args:
        model: the mujoco.MjModel.
        dofs: index of the degree of freedom of each joint.

    Returns:
        Sets of joint numbers (indices into `dofs`), each with at least two joints. Sets that share
        a joint are merged.
    """
    import mujoco

    joint_of_dof = {int(dof): joint for joint, dof in enumerate(dofs)}
    constraint_types, object_types = mujoco.mjtEq, mujoco.mjtObj
    groups: list[set[int]] = []
    for k in range(model.neq):
        kind = int(model.eq_type[k])
        first, second = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        if kind == int(constraint_types.mjEQ_JOINT):
            coupled_dofs = [int(model.jnt_dofadr[joint]) for joint in (first, second) if joint >= 0]
        elif kind in (int(constraint_types.mjEQ_CONNECT), int(constraint_types.mjEQ_WELD)):
            if int(model.eq_objtype[k]) == int(object_types.mjOBJ_SITE):
                first, second = (int(model.site_bodyid[site]) for site in (first, second))
            first_ancestors, second_ancestors = (
                _list_ancestors(model, first),
                _list_ancestors(model, second),
            )
            coupled_dofs = [
                dof
                for body in set(first_ancestors) ^ set(second_ancestors)
                for dof in _get_dofs(model, body)
            ]
        else:
            continue
        group = {joint_of_dof[dof] for dof in coupled_dofs if dof in joint_of_dof}
        overlapping_groups = [other_group for other_group in groups if other_group & group]
        groups = [other_group for other_group in groups if not other_group & group]
        groups.append(group.union(*overlapping_groups))
    return [group for group in groups if len(group) > 1]


def _list_ancestors(model: Any, body: int) -> list[int]:
    """Return a body and all its ancestors, including the world."""
    bodies = [body]
    while body > 0:
        body = int(model.body_parentid[body])
        bodies.append(body)
    return bodies


def _get_dofs(model: Any, body: int) -> range:
    """Return the velocity addresses of a body's own joints; empty if it has none."""
    first = int(model.body_dofadr[body])
    return range(first, first + int(model.body_dofnum[body])) if first >= 0 else range(0)
