"""Replace floating joints of a model: fix the bodies, or add slides and hinges for recorded poses.

With slides and hinges, the motion is the same, but each coordinate is one that a channel shows, so
that initial states are estimated and the body is a place of causes like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sims.core.simulator import InputError, make_unknown_name_error
from sims.recording.recorded_poses import ANGLES, POSITION_AXES


def separate_floating_joints(
    spec: Any, bases: Sequence[str], source: str
) -> tuple[tuple[str, ...], list[str]]:
    """Replace free joints by three slides and three hinges, and ball joints by three hinges.

    A quaternion is not a coordinate that can be recorded, varied or fitted like that of another
    joint. The new joints allow the same motion with such coordinates, which are those of
    `sims.recording.recorded_poses`: slides along the axes of the world (only for a free joint) have
    the position of the body in the world, and hinges about z, y and x, in this order, are zero in
    the orientation of the file. Keyframes (stored states) are left out, since they have the former
    coordinates.

    Args:
        spec: a mujoco.MjSpec whose joints have names; it is changed in place.
        bases: names of free or ball joints whose pose is recorded.
        source: beginning of error messages.

    Returns:
        Names of the replaced joints, and notes about them and about omitted keyframes.

    Raises:
        InputError: there is no such joint, or it has damping, armature or friction.
    """
    import mujoco

    kinds = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    floating = {joint.name: joint for joint in spec.joints if joint.type in kinds}
    names = {joint.name for joint in spec.joints}
    # The file may have hinges with the names of the new ones already; these are kept.
    bases = [base for base in bases if base in floating or f"{base}.{ANGLES[0]}" not in names]
    if not bases:
        return (), []
    # The compiled model has the poses of the bodies in one form, whatever form the file uses.
    model = spec.copy().compile()
    for base in bases:
        if base not in floating:
            raise InputError(
                f"{source}: pose of {base}: "
                f"{make_unknown_name_error('floating joint', base, sorted(floating))}"
            )
        joint = floating[base]
        # The new joints would have no such forces.
        stated = [
            name
            for name in ("damping", "armature", "frictionloss", "stiffness")
            if np.any(getattr(joint, name))
        ]
        if stated:
            value = np.ravel(getattr(joint, stated[0]))[0]
            raise InputError(
                f"{source}: joint {base}: expected no {stated[0]} at a floating joint whose pose "
                f"is a channel, found {value:g}; remove it, or state "
                f'the first pose of each run as [extra."q.{base}.qw"] instead of a channel'
            )
        body, is_free = joint.parent, joint.type == mujoco.mjtJoint.mjJNT_FREE
        anchor = np.array(joint.pos)
        compiled_body = model.body(body.name)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, compiled_body.quat)
        # Columns of the transpose are the world's axes in the frame of the body.
        axes_in_body = rotation.reshape(3, 3).T
        spec.delete(joint)
        for k, name in enumerate(POSITION_AXES if is_free else ()):
            slide = _add_joint(
                body, f"{base}.{name}", mujoco.mjtJoint.mjJNT_SLIDE, axes_in_body[:, k]
            )
            # The position at which the body is in the file, so that the slide shows its place.
            slide.ref = float(compiled_body.pos[k])
        # Yaw about z, pitch about y, roll about x.
        for k, name in zip((2, 1, 0), ANGLES, strict=True):
            hinge = _add_joint(
                body, f"{base}.{name}", mujoco.mjtJoint.mjJNT_HINGE, axes_in_body[:, k]
            )
            # A ball joint turns about its anchor, a free body about its origin.
            hinge.pos = np.zeros(3) if is_free else anchor
    return tuple(bases), [f"the pose is recorded: {', '.join(bases)}{remove_keyframes(spec)}"]


def _add_joint(body: Any, name: str, kind: Any, axis: Any) -> Any:
    """Add a joint without forces or limits of its own, whatever the defaults of the file are.

    Args:
        body: body of MuJoCo's spec that gets the joint.
        name: name of the joint.
        kind: joint type of MuJoCo.
        axis: axis of the joint in the body.
    """
    joint = body.add_joint(name=name, type=kind, axis=axis)
    for attribute in ("damping", "armature", "frictionloss", "stiffness", "springref", "margin"):
        # Some attributes are numbers, and some are arrays of coefficients.
        setattr(joint, attribute, 0.0 * np.asarray(getattr(joint, attribute)))
    joint.limited = 0
    joint.actfrclimited = 0
    joint.actgravcomp = 0
    return joint


def fix_bases(spec: Any) -> list[str]:
    """Fix all free bodies where the model file has them, and return notes about it.

    Keyframes are left out, since they have the coordinates of free joints.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
    """
    import mujoco

    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        return ["fix_base: no body of the model file floats"]
    names = [joint.parent.name for joint in free]
    for joint in free:
        spec.delete(joint)
    return [f"fixed in the pose of the model file: {', '.join(names)}{remove_keyframes(spec)}"]


def remove_keyframes(spec: Any) -> str:
    """Remove the keyframes (stored states) of a model, and return the end of a note about them.

    A caller that changes joints must remove them, because they have values for the former
    coordinates. The text is empty without them.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
    """
    keyframes = list(spec.keys)
    for keyframe in keyframes:
        spec.delete(keyframe)
    return f"; {len(keyframes)} keyframes are left out" if keyframes else ""
