"""Effects that are written into fields of the compiled MuJoCo model of a batch.

With the coefficient c, and the value that the model file specifies at a joint, an actuator or a
body:

* (1) Added: value + c, at least zero: damping, dry friction, stiffness, armature.
* (2) Scaled: value times 1 + c, with 1 + c at least `SMALLEST`.
* (3) Moved: the centre of mass is moved by c (3 numbers, m) in the body frame.
* (4) Tilted: gravity plus g c_x along x and g c_y along y, with the magnitude g of the file's
  gravity.
* (5) Limited: the file's range restricted to [-c, c]; a limit of zero has no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sims.base import Array
from sims.robot.model import TENDON, Robot

SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Parameter `solimp` of stiff dry friction: the hardest value that MuJoCo allows.

With it a joint at rest hardly creeps.
"""
SOFT = -1e-9
"""Placeholder for the stiffness in `solref` of dry friction, which has no stiffness.

The negative value makes MuJoCo read the second number as a damping.
"""
RK4 = 1
"""MuJoCo's number of the Runge-Kutta 4 integrator."""

SMALLEST = 1e-6
"""Minimum factor of a mass or a gain, so that none becomes zero or negative."""

Fields = Mapping[str, Any]
"""Model fields of L batch elements by name, arrays (L, ...)."""

Write = Callable[[Fields, Robot, str, Array], None]
"""Function that changes fields in place, from robot, place and coefficients (K, L)."""


@dataclass(frozen=True)
class Native:
    """An effect that is written into fields of the model.

    Attributes:
        fields: names of the fields, as in ``mujoco.batch.Batch.expand``.
        write: changes the fields, which contain the values of the file or the result of another
            effect.
        derived: whether MuJoCo derives constants from the fields, so that ``set_const`` must be
            called; this requires a model of `lanes_model`.
    """

    fields: tuple[str, ...]
    write: Write
    derived: bool = False


def lanes_model(robot: Robot) -> Any:
    """Compile the model such that masses and centres of mass can differ between batch elements.

    MuJoCo stores less for a body that turns about its centre of mass, and then rejects changes of
    its centre of mass. Here it stores everything. The motion is the same.
    """
    return robot.compile(lanes_spec(robot))


def lanes_spec(robot: Robot) -> Any:
    """Make the mujoco.MjSpec of `lanes_model`."""
    spec = robot.spec.copy()
    for body in spec.bodies:
        body.simple = False
    return spec


def stiff(timestep: float, integrator: int) -> tuple[float, float]:
    """Return `solref` of stiff dry friction, which stops a velocity within one step.

    Friction acts with a time constant 1 / b. A step of Euler or of the implicit integrators stops
    the velocity completely with b = 1 / h, and overshoots beyond it. The four evaluations of RK4
    tolerate b = 2.5 / h, and 3 / h chatters. MuJoCo's default time constant, 0.02 s, creeps at
    rest.

    Args:
        timestep: time step h in seconds.
        integrator: MuJoCo's number of the integrator.
    """
    return (SOFT, -2.5 / timestep) if integrator == RK4 else (2.0 * timestep, 1.0)


def stiff_of(fields: Fields, robot: Robot) -> tuple[float, float]:
    """Return `solref` of stiff dry friction for a batch.

    Time step and integrator are taken from the fields if they contain them, else from the file.

    Args:
        fields: model fields of the batch elements.
        robot: robot with the model file.
    """
    option = robot.compiled.opt
    step = fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep
    kind = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    return stiff(float(step), int(kind))


def write_friction_form(fields: Fields, robot: Robot, lanes: Any, dofs: Any) -> None:
    """Set the solver parameters of dry friction that effects add, in the form of the robot.

    Args:
        fields: model fields of the batch elements, changed in place.
        robot: its `friction_form` decides; ``soft`` keeps the parameters of the file.
        lanes: index of the batch elements.
        dofs: index of the joints' velocities.
    """
    if robot.friction_form == "soft":
        return
    fields["dof_solref"][lanes, dofs] = stiff_of(fields, robot)
    fields["dof_solimp"][lanes, dofs] = SOLIMP


def added(stated: Any, c: Any) -> Any:
    """Add a coefficient to a value by (1); a negative value in the file may remain."""
    return np.maximum(stated + c, np.minimum(stated, 0.0))


def share(c: Any) -> Any:
    """Return the factor 1 + c of (2)."""
    return np.maximum(1.0 + c, SMALLEST)


def _add_dof(field: str) -> Write:
    """Make a function that adds the coefficient to a field of a joint's degree of freedom."""

    def write(fields: Fields, robot: Robot, place: str, c: Array) -> None:
        column = robot.joint(place).velocity
        fields[field][:, column] = added(fields[field][:, column], c[0])

    return write


def _add_quadratic(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    # The first number of the polynomial multiplies |v| v.
    column = fields["dof_dampingpoly"][:, robot.joint(place).velocity]
    column[:, 0] = added(column[:, 0], c[0])


def _add_friction(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    column = robot.joint(place).velocity
    loss = fields["dof_frictionloss"]
    # A reduced friction keeps the solver parameters of the file.
    rubs = c[0] > 0
    loss[:, column] = added(loss[:, column], c[0])
    write_friction_form(fields, robot, rubs, column)


def _add_spring(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    column = fields["jnt_stiffness"]
    number = robot.joint(place).id
    column[:, number] = added(column[:, number], c[0])


def _add_cubic(fields: Fields, robot: Robot, place: str, c: Array) -> None:
    # The second number of the polynomial multiplies x^3. It has no lower limit, since a spring may
    # soften.
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
    """Return whether an actuator's control is a set point of position (1) or velocity (2).

    Args:
        robot: robot with the actuator.
        number: number of the actuator.
        term: index in `biasprm`: 1 for the position, 2 for the velocity.
    """
    import mujoco

    model = robot.compiled
    gain, bias = model.actuator_gainprm[number], model.actuator_biasprm[number]
    fixed = int(model.actuator_gaintype[number]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    # With a position gain as well, the set point is multiplied by the position gain.
    return bool(fixed and gain[0] == -bias[term] and (term == 1 or bias[1] == 0))


def _scale_gravity(fields: Fields, robot: Robot, place: str, c: Array) -> None:  # noqa: ARG001
    gravity = fields["opt.gravity"]
    # The tilt that another effect added is not scaled.
    gravity += c[0][:, None] * robot.compiled.opt.gravity


def _tilt_gravity(fields: Fields, robot: Robot, place: str, c: Array) -> None:  # noqa: ARG001
    size = float(np.linalg.norm(robot.compiled.opt.gravity))
    fields["opt.gravity"][:, :2] += size * c.T  # (4)


def arm_of(robot: Robot, place: str) -> int:
    """Return the address in `wrap_prm` of the coupling coefficient of a joint's drive.

    Args:
        robot: robot with coupled drives.
        place: joint of the drive.
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
"""Model field of coupling coefficients, which a model without tendons lacks."""
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
"""Model-field effects by name.

Each acts at a place of its kind, and those of the world at any place, such as ``""``.
"""
