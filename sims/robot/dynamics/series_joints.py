"""Flexible joints and joints with backlash, as a second joint in series in the same body.

Let x be the joint's position on the side of its drive, where the actuator, encoder, specified
damping and dry friction are, y the position of the links that it carries, J the drive's inertia
(the armature) and T the transmitted force:

    J x'' = U - T                                                          (1)
    (M(q) q'' + n(q, q'))_j = T,  q_j = y                                  (2)

(M. W. Spong, J. Dyn. Syst. Meas. Control 109(4), 310 (1987), doi:10.1115/1.3143860). A second joint
d = y - x about the same axis makes y the body's position, and

    T = -k d - c d'         for a spring with a damper                     (3)
    |d| <= gap / 2          for rigid flanks, by MuJoCo's joint limit      (4)
    T = -k e - c d'         for compliant flanks; e is d beyond the gap    (5)

The shares of inertia and damping refer to M_jj in the pose that the file specifies (q = 0 by
default). So MuJoCo integrates the second joint like any other, and a model file can state it. In
(5), T only pushes, and is zero between the flanks. A limit of MuJoCo with impedance s exerts

    -(K e + C d') / (A + R), R = (1 - s) A0 / s                            (6)

for `solref` (-K s, -C s), with the inverse inertia A along d, and its value A0 in the pose of the
file (MuJoCo's documentation, "Computation", constraint model). At the smallest s, 1e-4, this is a
spring of stiffness K s / A0 with a relative error of the order of s.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects, Effect, HiddenStateEffect, SeriesElement
from sims.core.simulator import Array
from sims.effects.transmission import combine_elements, make_series_element
from sims.robot.dynamics.inverse_dynamics import inertia_matrix
from sims.robot.integrator_settings import RK4_INTEGRATOR_ID
from sims.robot.robot_model import RobotModel, cache_per_robot

MIN_DRIVE_INERTIA_SHARE = 0.01
"""Minimum inertia of a drive, as a share of the joint's inertia.

Without inertia of the drive, x in (1) is undetermined.
"""
COMPILE_INERTIA_SHARE = 1e-4
"""Minimum inertia of a drive while a model is compiled, as a share of the joint's inertia."""
MAX_PHASE, MAX_PHASE_RK4 = 1.2, 2.0
"""Maximum phase, in radians per step, of the oscillation between drive and links.

The second value applies to the Runge-Kutta 4 integrator, the first one to all others.
"""
RIGID_FLANK_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Parameter `solimp` of rigid flanks: the hardest value that MuJoCo allows."""
COMPLIANT_FLANK_SOLIMP = (1e-4, 1e-4, 0.001, 0.5, 2.0)
"""Parameter `solimp` of compliant flanks: the softest value that MuJoCo allows, see (6)."""
UNLOADED_FORCE_SHARE = 1e-3
"""Load, as a multiple of the inertia, below which the links rest between the flanks."""
WRITTEN_FIELDS = (
    "dof_armature",
    "jnt_stiffness",
    "dof_damping",
    "jnt_range",
    "jnt_solref",
    "jnt_solimp",
)
"""Model fields that are written for joints in series."""
USED_FIELDS = (*WRITTEN_FIELDS, "dof_invweight0")
"""Model fields that are written for joints in series, and those derived by MuJoCo that are read."""

Flags = NDArray[np.bool_]

SeriesJoints = tuple[tuple[str, str], ...]
"""Effects in series with joints, as pairs of joint and effect name; a joint may have several."""


def make_series_joint_name(joint: str, effects: Collection[str]) -> str:
    """Make the name of the joint that is added in series with a joint for some effects.

    It is ``elbow_flexibility`` for the effect ``joint.flexibility`` alone, and
    ``elbow_transmission`` for several effects.

    Args:
        joint: name of the joint with which it is in series.
        effects: names of the effects that it combines.
    """
    if len(effects) == 1:
        (effect,) = effects
        kind = effect.rpartition(".")[2]  # the part after the dot
    else:
        kind = "transmission"
    return f"{joint}_{kind}"


def find_series_joint(robot: RobotModel, joint: str) -> str:
    """Return the name of the joint in series with a joint; empty if there is none.

    Args:
        robot: the robot with its added joints.
        joint: name of the joint.
    """
    return next((name for name in robot.series if name.rpartition("_")[0] == joint), "")


def group_by_joint(added: SeriesJoints) -> dict[str, list[str]]:
    """Group the effects in series by joint."""
    effects: dict[str, list[str]] = {}
    for joint, effect in added:
        effects.setdefault(joint, []).append(effect)
    return effects


def add_series_joints(robot: RobotModel, added: SeriesJoints) -> RobotModel:
    """Add a second joint in series with some joints of a robot, for flexible or slack drives.

    The first joint then moves the drive, and the second one the links against the drive. It is in
    the same body, with the axis and position of the first one. All its numbers are zero;
    `write_series_element` sets them for each batch element. With backlash it has a limited range.
    Existing names do not change. Keyframes are removed.

    Args:
        robot: robot as read from its model file.
        added: pairs of a joint, the last one of its body, and the name of an effect in series with
            it, such as ``joint.flexibility``. A joint with several effects gets one second joint.

    Returns:
        The robot, whose `series` has the inertia about each added joint by name, in kg or kg m^2.
    """
    import mujoco

    spec = robot.spec.copy()
    inertias = _compute_joint_inertias(robot)
    effects_by_joint = group_by_joint(added)
    for name, effects in effects_by_joint.items():
        first_joint = spec.joint(name)
        second_joint = first_joint.parent.add_joint(
            name=make_series_joint_name(name, effects),
            type=first_joint.type,
            axis=first_joint.axis,
            pos=first_joint.pos,
        )
        # Values of default classes of the file apply to the first joint only.
        for attribute in ("damping", "frictionloss", "armature", "stiffness"):
            setattr(second_joint, attribute, np.zeros_like(getattr(second_joint, attribute)))
        second_joint.springdamper = (0.0, 0.0)
        second_joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        has_backlash = any(effect.endswith("backlash") for effect in effects)
        second_joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        if has_backlash:
            second_joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            second_joint.range = (-1.0, 1.0)  # a placeholder, which lets the model compile
        # The simulation writes the actual armature; this minimum makes the model compile.
        first_joint.armature = max(first_joint.armature, COMPILE_INERTIA_SHARE * inertias[name])
    # Keyframes lack the new coordinates.
    for key in list(spec.keys):
        spec.delete(key)
    series = {
        make_series_joint_name(name, effects): inertias[name]
        for name, effects in effects_by_joint.items()
    }
    return replace(robot, spec=spec, series=series)


@cache_per_robot
def _compute_joint_inertias(robot: RobotModel) -> dict[str, float]:
    """Return the inertia about each joint, in the pose that the file specifies."""
    inertias = np.diagonal(inertia_matrix(robot.compiled)).tolist()
    return {j.name: inertias[j.velocity] for j in robot.joints if j.has_one_coordinate}


def is_series_effect(effect: Effect | type[Effect]) -> bool:
    """Return whether an effect is an element in series with a joint."""
    kind = effect if isinstance(effect, type) else type(effect)
    return issubclass(kind, HiddenStateEffect) and bool(kind.between)


def write_series_effects(
    fields: Mapping[str, Any], robot: RobotModel, acting: ActiveEffects
) -> None:
    """Write effects in series with joints, such as backlash, into the model fields of a batch.

    Several effects at one joint are combined to one element: a spring, a gap, or both. For gaps,
    `convert_flank_parameters` must be called after MuJoCo has derived its constants.

    Args:
        fields: model fields of the batch elements.
        robot: robot of `add_series_joints`.
        acting: effects with K coefficients for each of L batch elements, (K, L, 1); other effects
            are ignored.
    """
    elements_by_joint: dict[str, list[SeriesElement]] = {}
    for effect, c in acting:
        # Such an effect is off where its first coefficient is not above zero.
        if not is_series_effect(effect) or not (c[0] > 0).any():
            continue
        coefficient_names = [coefficient.name for coefficient in effect.coefficients]
        numbers = dict(zip(coefficient_names, c[:, :, 0], strict=True))
        # The place of the effect is the name of its joint.
        elements_by_joint.setdefault(effect.place, []).append(
            make_series_element(type(effect), numbers)
        )
    for joint, elements in elements_by_joint.items():
        write_series_element(fields, robot, joint, combine_elements(elements))


def write_series_element(
    fields: Mapping[str, Any], robot: RobotModel, place: str, element: SeriesElement
) -> None:
    """Write the numbers of the element between drive and links, of L batch elements, into fields.

    Let d be the deflection between drive and links, the position of the joint that was added in
    series. The element is one of these cases:

    * A spring with a damper exerts -k d - c d' (3). It is the stiffness and damping of the joint.
    * Rigid flanks of a gap limit |d| to gap / 2 (4). They are limits of the joint.
    * Compliant flanks exert -k e - c d', where e is d beyond the gap (5). They are soft limits.

    The drive gets its share of the joint's inertia as armature. Stiffness and damping are limited
    to what the time step can integrate.

    Args:
        fields: model fields of the batch elements, changed in place.
        robot: robot of `add_series_joints`.
        place: name of the joint of the drive.
        element: numbers (L,) of the element: stiffness, damping ratio, gap in m or rad, and the
            drive's share of the joint's inertia.
    """
    second = robot.joint(find_series_joint(robot, place))
    inertia = robot.series[second.name]
    # Inertia of the drive, (L,).
    dof = robot.joint(place).velocity
    armature = fields["dof_armature"][:, dof]
    drive = np.maximum(armature + element.drive * inertia, MIN_DRIVE_INERTIA_SHARE * inertia)
    fields["dof_armature"][:, dof] = drive
    # Stiffness and damping of a spring, or of compliant flanks. Fields may have other options than
    # the model.
    option = robot.compiled.opt
    step = float(fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep)
    integrator = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    # Runge-Kutta 4 treats damping explicitly.
    stiffness, damping = _limit_to_stable_values(
        element, inertia, drive, step, explicit=int(integrator) == RK4_INTEGRATOR_ID
    )
    is_compliant = is_compliant_flank(element)
    fields["jnt_stiffness"][:, second.id] = np.where(is_compliant, 0.0, stiffness)
    fields["dof_damping"][:, second.velocity] = np.where(is_compliant, 0.0, damping)
    # Limits of flanks.
    if "jnt_range" in fields:
        half_gap = 0.5 * element.gap
        fields["jnt_range"][:, second.id] = np.stack([-half_gap, half_gap], axis=1)
        # Negative values of `solref` mean a stiffness and a damping, instead of a time constant and
        # a damping ratio. They are converted to MuJoCo's units by `convert_flank_parameters`.
        compliant_solref = np.stack([-stiffness, -damping], axis=1)
        fields["jnt_solref"][:, second.id] = np.where(
            is_compliant[:, None], compliant_solref, _compute_rigid_solref(step)
        )
        fields["jnt_solimp"][:, second.id] = np.where(
            is_compliant[:, None], COMPLIANT_FLANK_SOLIMP, RIGID_FLANK_SOLIMP
        )


def is_compliant_flank(elements: SeriesElement) -> Flags:
    """Return whether elements (L,) are compliant flanks: a gap with a spring."""
    return (elements.gap > 0) & (elements.stiffness > 0)


def convert_flank_parameters(fields: Mapping[str, Any], robot: RobotModel) -> None:
    """Convert stiffness and damping of compliant flanks to `solref` of MuJoCo's joint limit.

    A limit with `solref` (-K s, -C s) and impedance s exerts -(K e + C d') / (A + R) with
    R = (1 - s) A0 / s (6), where d is the deflection between drive and links, e its part beyond
    the gap, A the inverse inertia along the joint, and A0 its value in the pose of the file. At the
    small s that is used here, this is -(K e + C d') s / A0. So stiffness and damping, which
    `write_series_element` has written, are multiplied by A0, which MuJoCo has derived since.

    Args:
        fields: model fields of the batch elements, changed in place.
        robot: robot of `add_series_joints`.
    """
    for name in robot.series:
        second = robot.joint(name)
        # Compliant flanks are recognised by the parameter that was written for them.
        is_compliant = fields["jnt_solimp"][:, second.id, 0] == COMPLIANT_FLANK_SOLIMP[0]
        inverse_inertia = fields["dof_invweight0"][is_compliant, second.velocity, None]  # A0
        fields["jnt_solref"][is_compliant, second.id] *= inverse_inertia


def _compute_rigid_solref(step: float) -> tuple[float, float]:
    """Return `solref` of rigid flanks: the stiffest value that is stable for a time step."""
    return 2.0 * step, 1.0


def prepare_flanks_for_file(
    robot: RobotModel, elements: Mapping[str, SeriesElement], model: Any = None
) -> RobotModel:
    """Set the limits of added joints that represent the flanks of gaps, for writing a model file.

    A gap is a joint limit of ± half its width. Limits must be set before the model is compiled,
    and those of compliant flanks (a gap with a spring) depend on the compiled inertia. So with
    compliant flanks the function is called again with the compiled model.

    Args:
        robot: robot of `add_series_joints`.
        elements: elements in series with joints, by the joint; numbers have the shape (1,).
        model: model compiled from the robot with all effects; required for compliant flanks.

    Returns:
        The robot with these limits.
    """
    spec, option = robot.spec.copy(), (model or robot.compiled).opt
    joints = {joint.name: joint for joint in spec.joints}
    step = float(option.timestep)
    is_explicit = int(option.integrator) == RK4_INTEGRATOR_ID
    for place, element in elements.items():
        joint = joints[find_series_joint(robot, place)]
        half_gap = 0.5 * float(element.gap[0])
        if not half_gap:  # a spring without a gap
            continue
        is_in_degrees = robot.joint(joint.name).kind == "hinge" and spec.compiler.degree
        half_gap = float(np.rad2deg(half_gap)) if is_in_degrees else half_gap
        joint.range = (-half_gap, half_gap)
        joint.solref_limit, joint.solimp_limit = _compute_rigid_solref(step), RIGID_FLANK_SOLIMP
        if model is not None and is_compliant_flank(element)[0]:
            inertia = robot.series[joint.name]
            drive_inertia = model.dof_armature[[robot.joint(place).velocity]]  # (1,)
            (stiffness,), (damping,) = _limit_to_stable_values(
                element, inertia, drive_inertia, step, is_explicit
            )
            # Negative values mean a stiffness and a damping, per unit of inertia (6).
            inverse_inertia = model.dof_invweight0[robot.joint(joint.name).velocity]
            joint.solref_limit = -np.array([stiffness, damping]) * inverse_inertia
            joint.solimp_limit = COMPLIANT_FLANK_SOLIMP
    return replace(robot, spec=spec)


def _limit_to_stable_values(
    elements: SeriesElement, inertia: float, drive: Array, step: float, explicit: bool
) -> tuple[Array, Array]:
    """Return stiffness and damping (L,) of elements, limited to what is stable for a time step.

    The oscillation between drive and links may advance by at most `MAX_PHASE` radians per step,
    which limits the stiffness; damping has a similar limit. The cases are:

    * If the integrator treats damping explicitly (Runge-Kutta 4), both limits apply.
    * Otherwise both limits apply to compliant flanks, whose limit of MuJoCo is explicit.
    * A spring of a joint keeps its stiffness, and gets more damping in its place.

    Args:
        elements: elements in series of L batch elements; their damping is a damping ratio.
        inertia: inertia of the joint in kg m^2 or kg.
        drive: (L,) inertia of the drive in the same unit.
        step: time step in seconds.
        explicit: whether the integrator treats damping explicitly.

    Returns:
        Stiffness in N m/rad or N/m, and damping in N m s/rad or N s/m.
    """
    # Drive and links swing against each other: their squared angular frequency is the stiffness
    # times the sum of both inverse inertias.
    inverse_inertia = 1.0 / drive + 1.0 / inertia
    max_phase = MAX_PHASE_RK4 if explicit else MAX_PHASE
    max_stiffness = (max_phase / step) ** 2 / inverse_inertia
    stiffness = np.minimum(elements.stiffness, max_stiffness)
    damping = 2.0 * elements.damping * np.sqrt(stiffness * inertia)
    stable_damping = np.minimum(damping, MAX_PHASE / step / inverse_inertia)
    if explicit:
        return stiffness, stable_damping
    # Implicit damping makes a spring implicit, too, by the backward Euler rule k (d + h d') with
    # the deflection d and the step h: the stiffness beyond the limit, times h, is added to the
    # damping.
    is_compliant = is_compliant_flank(elements)
    implicit_damping = damping + step * (elements.stiffness - stiffness)
    return np.where(is_compliant, stiffness, elements.stiffness), np.where(
        is_compliant, stable_damping, implicit_damping
    )


def compute_rest_positions(
    fields: Mapping[str, Any], robot: RobotModel, loads: Sequence[Array]
) -> list[Array]:
    """Compute the rest positions (n,) of joints in series while their drives are held.

    They are the first states of links behind flexible or slack drives, which recordings do not
    contain. A load, such as gravity, deflects a spring by load / stiffness. In a gap it moves the
    links to the flank in its direction, or leaves them between the flanks if it is very small;
    compliant flanks (a gap with a spring) are deflected, too. Their stiffness is read back from the
    parameters of MuJoCo's joint limit: -`solref` times the inertia.

    Args:
        fields: model fields of the batch elements.
        robot: robot of `add_series_joints`.
        loads: load (n,) in N m or N at each of these joints, for the first n batch elements.
    """
    positions = []
    for (name, inertia), load in zip(robot.series.items(), loads, strict=True):
        second, n = robot.joint(name), len(load)
        # Stiffness of the spring, or of compliant flanks; zero for rigid flanks.
        spring_stiffness = fields["jnt_stiffness"][:n, second.id]
        is_compliant = fields["jnt_solimp"][:n, second.id, 0] == COMPLIANT_FLANK_SOLIMP[0]
        inverse_inertia = fields["dof_invweight0"][:n, second.velocity]
        flank_stiffness = -fields["jnt_solref"][:n, second.id, 0] / inverse_inertia
        stiffness = np.where(is_compliant, flank_stiffness, spring_stiffness)
        # Position in the gap: at a flank, or between the flanks for a very small load.
        half_gap = fields["jnt_range"][:n, second.id, 1]
        in_gap = half_gap * np.clip(load / (UNLOADED_FORCE_SHARE * inertia), -1.0, 1.0)
        has_gap = is_compliant | (spring_stiffness <= 0)
        # The tiny divisor only avoids a division by zero where there is no spring; `np.where` does
        # not use this quotient.
        deflection = np.where(stiffness > 0, load / np.maximum(stiffness, 1e-300), 0.0)
        positions.append(deflection + np.where(has_gap, in_gap, 0.0))
    return positions
