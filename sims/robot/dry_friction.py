"""Solver parameters of the dry friction that effects add: stiff, or as in the model file.

MuJoCo models dry friction as a constraint with the parameters `solref` and `solimp`
(https://mujoco.readthedocs.io/en/stable/computation/index.html, "Friction loss"). Its defaults are
soft, so that a joint at rest creeps; effects add stiff friction.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sims.robot.integrator_settings import RK4_INTEGRATOR_ID

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

MAX_RK4_FRICTION_RATE = 2.5
"""Largest decay rate of stiff friction at which RK4 does not chatter, in 1 / time step."""


Fields = Mapping[str, Any]
"""Model fields of L batch elements by name, arrays (L, ...)."""


FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Parameter `solimp` of stiff dry friction: the hardest value that MuJoCo allows.

With it a joint at rest hardly creeps.
"""


SOLREF_PLACEHOLDER_STIFFNESS = -1e-9
"""Placeholder for the stiffness in `solref` of dry friction, which has no stiffness.

The negative value makes MuJoCo read the second number as a damping.
"""


def get_friction_solref(timestep: float, integrator: int) -> tuple[float, float]:
    """Return `solref` of stiff dry friction, which stops a velocity within one step.

    Friction pulls the velocity v to zero by the reference acceleration -b v. A step of Euler or of
    the implicit integrators stops the velocity completely with b = 1 / h, and overshoots beyond it.
    The four evaluations of RK4 tolerate b = `MAX_RK4_FRICTION_RATE` / h; with 3 / h the velocity
    chatters. With MuJoCo's softer default, a time constant of 0.02 s, a joint at rest creeps.

    Args:
        timestep: time step h in seconds.
        integrator: MuJoCo's number of the integrator.

    Returns:
        For RK4 the negative stiffness and the damping -b, a form that MuJoCo takes as it is.
        Otherwise a time constant of 2 h and a damping ratio of 1, for which MuJoCo sets b = 1 / h.
    """
    if integrator == RK4_INTEGRATOR_ID:
        return (SOLREF_PLACEHOLDER_STIFFNESS, -MAX_RK4_FRICTION_RATE / timestep)
    return (2.0 * timestep, 1.0)


def write_friction_form(fields: Fields, robot: RobotModel, batch_indices: Any, dofs: Any) -> None:
    """Make the dry friction of some joints as stiff as the time step allows, by solver parameters.

    Nothing is changed if the robot's `friction_form` is ``soft``: then the friction that effects
    add keeps the solver parameters of the file. Time step and integrator are taken from the fields
    if they contain them, else from the file.

    Args:
        fields: model fields of the batch elements, changed in place.
        robot: robot with the friction form.
        batch_indices: NumPy index (numbers, slice or mask) of the batch elements.
        dofs: NumPy index of the joints' velocities.
    """
    if robot.friction_form == "soft":
        return
    option = robot.compiled.opt
    # All batch elements have the same options, so the first one stands for them.
    timestep = fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep
    integrator = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    solref = get_friction_solref(float(timestep), int(integrator))
    fields["dof_solref"][batch_indices, dofs] = solref
    fields["dof_solimp"][batch_indices, dofs] = FRICTION_SOLIMP


def get_friction_constraint(robot: RobotModel, dof: int) -> tuple[float, float]:
    """Return damping b (1/s) and impedance d of MuJoCo's constraint for dry friction.

    The constraint has the reference acceleration -b v at the velocity v; the impedance, from 0 to
    1, is how strongly it acts. The values are those of the robot's `friction_form`, in which
    effects add friction: stiff, or as in the model file. With `solref` (timeconst, dampratio) and
    the largest impedance d_max of `solimp`, MuJoCo sets b = 2 / (d_max timeconst). Negative numbers
    (-stiffness, -damping) give b = damping / d_max.

    Args:
        robot: robot with the time step and the integrator in use.
        dof: index of the joint's velocity.
    """
    import mujoco

    model = robot.compiled
    solref, solimp = model.dof_solref[dof], model.dof_solimp[dof]
    if robot.friction_form == "stiff":
        solref = get_friction_solref(float(model.opt.timestep), int(model.opt.integrator))
        solimp = FRICTION_SOLIMP
    timeconst, second = (float(value) for value in solref)
    # `solimp` has the impedance at no constraint violation, the largest one, and the violation at
    # which the impedance is the largest one.
    limits = np.clip(solimp[:2], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    (at_rest, largest), width = limits.tolist(), float(solimp[2])
    # Friction has no constraint violation, so it has the impedance there. A width of zero means a
    # constant impedance, for which MuJoCo takes the mean.
    d = at_rest if width > mujoco.mjMINVAL else 0.5 * (at_rest + largest)
    if timeconst <= 0:  # The numbers are -stiffness and -damping.
        return -second / largest, d
    # By default, MuJoCo uses no smaller time constant than two time steps.
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE):
        timeconst = max(timeconst, 2.0 * float(model.opt.timestep))
    return 2.0 / (largest * timeconst), d
