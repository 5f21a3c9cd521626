"""Effects that MuJoCo has in its model: which fields of a compiled model each of them changes, and
how, for many lanes at once.

With c the coefficient, and what the model file states before it, at a joint, an actuator or a body:

* (1) added: stated + c, never below zero: dampings, dry friction, stiffness, armature
* (2) scaled: stated times 1 + c, with 1 + c never below `SMALLEST`
* (3) moved: the centre of mass by c (3 numbers, m) in the body's frame
* (4) tilted: gravity plus g x along x and g y along y, g what the file states, as a size
* (5) limited: the file's range cut to -c ... c; a limit of zero is none
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sims.base import Array
from sims.robot.model import TENDON, Robot

SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""`solimp` of stiff dry friction: the hardest that MuJoCo allows, so that a joint at rest hardly
creeps.
"""
SOFT = -1e-9
"""In place of a stiffness, which dry friction has none of: so that MuJoCo reads the second number
as a damping.
"""
RK4 = 1
"""MuJoCo's number of the integrator."""

SMALLEST = 1e-6
"""The least share of a mass or a gain that is left, so that none is zero or negative."""

Fields = Mapping[str, Any]
"""Model fields by name, arrays (L, ...) of the lanes."""

Write = Callable[[Fields, Robot, str, Array], None]
"""Changes fields in place: of the robot, at the place, by coefficients (K, L)."""


@dataclass(frozen=True)
class Native:
    """An effect that is written into the model.

    Attributes:
        fields: that it writes, as ``mujoco.batch.Batch.expand`` names them.
        write: what it does to them; the fields hold what the file states, or what another effect
            has made of it.
        derived: whether constants are derived from the fields, so that ``set_const`` must follow;
            it does so only in a model of `lanes_model`.
    """

    fields: tuple[str, ...]
    write: Write
    derived: bool = False


def lanes_model(robot: Robot) -> Any:
    """The compiled model whose masses and centres of mass may be changed lane by lane.

    MuJoCo stores less for a body that turns about its centre of mass, and refuses to move that
    centre afterwards; here it stores all. The motion is the same.
    """
    return robot.compile(lanes_spec(robot))


def lanes_spec(robot: Robot) -> Any:
    """The mujoco.MjSpec of `lanes_model`."""
    spec = robot.spec.copy()
    for body in spec.bodies:
        body.simple = False
    return spec


def stiff(timestep: float, integrator: int) -> tuple[float, float]:
    """What dry friction has for `solref`: it takes the velocity away within a step, and no more.

    Friction acts with a time constant 1 / b. A step of Euler or of the implicit integrators has it
    all with b = 1 / h, beyond which it overshoots; the four looks of RK4 bear b = 2.5 / h, and 3
    chatters. MuJoCo's own, 0.02 s, creeps at rest.
    """
    return (SOFT, -2.5 / timestep) if integrator == RK4 else (2.0 * timestep, 1.0)


def stiff_of(fields: Fields, robot: Robot) -> tuple[float, float]:
    """The same of lanes, whose step stands among the fields or is the file's."""
    option = robot.compiled.opt
    step = fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep
    kind = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    return stiff(float(step), int(kind))


def write_friction_form(fields: Fields, robot: Robot, lanes: Any, dofs: Any) -> None:
    """Set the solver parameters of dry friction that effects add, in the form of the robot.

    Args:
        fields: model fields of the lanes, changed in place.
        robot: its `friction_form` decides; ``soft`` leaves the parameters of the file.
        lanes: index of the lanes.
        dofs: index of the joints' velocities.
    """
    if robot.friction_form == "soft":
        return
    fields["dof_solref"][lanes, dofs] = stiff_of(fields, robot)
    fields["dof_solimp"][lanes, dofs] = SOLIMP


def added(stated: Any, c: Any) -> Any:
    """(1); a number below zero that the file states may stay."""
    return np.maximum(stated + c, np.minimum(stated, 0.0))


def share(c: Any) -> Any:
    """1 + c of (2)."""
    return np.maximum(1.0 + c, SMALLEST)


def _add_dof(field: str) -> Write:
    """Adds to a number of a joint's velocity."""

    def write(fields: Fields, robot: Robot, place: str, c: Array) -> None:
        column = robot.joint(place).velocity
        fields[field][:, column] = added(fields[field][:, column], c[0])

    return write


def _add_quadratic(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    # The polynomial's first number is that of |v| v.
    column = fields["dof_dampingpoly"][:, robot.joint(place).velocity]
    column[:, 0] = added(column[:, 0], c[0])


def _add_friction(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    column = robot.joint(place).velocity
    loss = fields["dof_frictionloss"]
    # Less friction than the file states has the file's form.
    rubs = c[0] > 0
    loss[:, column] = added(loss[:, column], c[0])
    write_friction_form(fields, robot, rubs, column)


def _add_spring(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    column = fields["jnt_stiffness"]
    number = robot.joint(place).id
    column[:, number] = added(column[:, number], c[0])


def _add_cubic(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    # The polynomial's second number is that of x^3; a spring may soften, so it has no floor.
    fields["jnt_stiffnesspoly"][:, robot.joint(place).id, 1] += c[0]


def _scale_mass(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    number = robot.body(place).id
    fields["body_mass"][:, number] *= share(c[0])
    fields["body_inertia"][:, number] *= share(c[0])[:, None]


def _scale_inertia(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    fields["body_inertia"][:, robot.body(place).id] *= share(c[0])[:, None]


def _offset_mass(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    fields["body_ipos"][:, robot.body(place).id] += c.T  # (3)


def _scale_stiffness(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    number = robot.actuator(place).id
    gain, bias = fields["actuator_gainprm"][:, number], fields["actuator_biasprm"][:, number]
    bias[:, 1] *= share(c[0])
    if gain_pulls(robot, number, 1):
        gain[:, 0] *= share(c[0])


def _scale_damping(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    number = robot.actuator(place).id
    gain, bias = fields["actuator_gainprm"][:, number], fields["actuator_biasprm"][:, number]
    bias[:, 2] *= share(c[0])
    if gain_pulls(robot, number, 2):
        gain[:, 0] *= share(c[0])


def gain_pulls(robot: Robot, number: int, term: int) -> bool:
    """Whether an actuator's control is a set point of its position (term 1) or velocity (2)."""
    import mujoco

    model = robot.compiled
    gain, bias = model.actuator_gainprm[number], model.actuator_biasprm[number]
    fixed = int(model.actuator_gaintype[number]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    # Where it has a stiffness as well, the set point is multiplied by that one.
    return bool(fixed and gain[0] == -bias[term] and (term == 1 or bias[1] == 0))


def _scale_gravity(fields: Fields, robot: Robot, place: str, c: Array) -> None:  # noqa: ARG001
    gravity = fields["opt.gravity"]
    # What a tilt has added is no part of what is scaled.
    gravity += c[0][:, None] * robot.compiled.opt.gravity


def _tilt_gravity(fields: Fields, robot: Robot, place: str, c: Array) -> None:  # noqa: ARG001
    size = float(np.linalg.norm(robot.compiled.opt.gravity))
    fields["opt.gravity"][:, :2] += size * c.T  # (4)


def arm_of(robot: Robot, place: str) -> int:
    """Where in `wrap_prm` a robot whose drives are coupled has by how much that of a joint turns
    the joint before.
    """
    model = robot.compiled
    return int(model.tendon_adr[model.tendon(place + TENDON).id]) + 1


def _couple(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    fields["wrap_prm"][:, arm_of(robot, place)] = c[0]


def _limit_force(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    number = robot.actuator(place).id
    limited, ranges = fields["actuator_forcelimited"], fields["actuator_forcerange"]
    limits = c[0] > 0
    free = limits & ~limited[:, number].astype(bool)
    ranges[free, number] = (-np.inf, np.inf)
    cut = np.stack([-c[0], c[0]], axis=1)[limits]
    low, high = ranges[limits, number].T
    ranges[limits, number] = np.clip(cut, low[:, None], high[:, None])  # (5)
    limited[limits, number] = True


COUPLING = "wrap_prm"
"""Of the fields the one that a model without tendons lacks."""
_SERVO = ("actuator_gainprm", "actuator_biasprm")

FIELDS: Mapping[str, Native] = {
    "drag.linear": Native(("dof_damping",), _add_dof("dof_damping")),
    "drag.quadratic": Native(("dof_dampingpoly",), _add_quadratic),
    "friction.coulomb": Native(("dof_frictionloss", "dof_solref", "dof_solimp"), _add_friction),
    "spring.linear": Native(("jnt_stiffness",), _add_spring),
    "spring.cubic": Native(("jnt_stiffnesspoly",), _add_cubic),
    "inertia.armature": Native(("dof_armature",), _add_dof("dof_armature"), derived=True),
    "mass.scale": Native(("body_mass", "body_inertia"), _scale_mass, derived=True),
    "mass.offset": Native(("body_ipos",), _offset_mass, derived=True),
    "inertia.scale": Native(("body_inertia",), _scale_inertia, derived=True),
    "actuator.stiffness": Native(_SERVO, _scale_stiffness),
    "actuator.damping": Native(_SERVO, _scale_damping),
    "gravity.scale": Native(("opt.gravity",), _scale_gravity),
    "gravity.tilt": Native(("opt.gravity",), _tilt_gravity),
    "joint.coupling": Native((COUPLING,), _couple),
    "actuator.limit": Native(("actuator_forcelimited", "actuator_forcerange"), _limit_force),
}
"""Native effects by name, each at a place of its kind; the world's take any place, as ``""``."""
