"""Time step, integrator and solver options of a robot, and stiff friction constraints.

MuJoCo models dry friction as a constraint with the parameters `solref` and `solimp`
(https://mujoco.readthedocs.io/en/stable/computation/index.html, "Friction loss"). Its defaults are
soft, so that a joint at rest creeps; effects add stiff friction.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from sims.core.engine import IntegrationBatch, Trajectories

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

INTEGRATOR_IDS = {"Euler": 0, "RK4": 1, "implicit": 2, "implicitfast": 3}
"""Numbers of MuJoCo's integrators (mjtIntegrator), by their names in a model file."""
RK4_INTEGRATOR_ID = INTEGRATOR_IDS["RK4"]
"""MuJoCo's number of the Runge-Kutta 4 integrator."""


CONE_IDS = {"pyramidal": 0, "elliptic": 1}
"""Numbers of MuJoCo's friction cones (mjtCone), by their names in a model file."""
SOLVER_IDS = {"PGS": 0, "CG": 1, "Newton": 2}
"""Numbers of MuJoCo's constraint solvers (mjtSolver), by their names in a model file."""
OPTION_WORDS: Mapping[str, Mapping[str, int]] = {
    "integrator": INTEGRATOR_IDS,
    "cone": CONE_IDS,
    "solver": SOLVER_IDS,
}
"""Numbers of the words that an option of a model file may have, by option."""
OPTION_EFFECTS: Mapping[str, str] = {
    "numerics.step": "timestep",
    "numerics.integrator": "integrator",
    "numerics.cone": "cone",
    "numerics.impratio": "impratio",
    "numerics.noslip": "noslip_iterations",
    "numerics.solver": "solver",
    "numerics.iterations": "iterations",
}
"""Options of a model file by the effect that names them as a cause."""
MAX_RK4_FRICTION_RATE = 2.5
"""Largest decay rate of stiff friction at which RK4 does not chatter, in 1 / time step."""


class IntegratorSettings(NamedTuple):
    """Numerical settings of MuJoCo.

    Attributes:
        timestep: time step in seconds.
        integrator: name of the integrator, a key of `INTEGRATOR_IDS`.
        solver_options: further options that differ from the model file, as pairs of name and
            number, sorted by name. They are those of `OPTION_EFFECTS`.
    """

    timestep: float
    integrator: str
    solver_options: tuple[tuple[str, float], ...] = ()

    def to_model_options(self) -> dict[str, float]:
        """Return the settings as fields of a model's options (`mujoco.MjOption`)."""
        return {
            "timestep": self.timestep,
            "integrator": INTEGRATOR_IDS[self.integrator],
            **dict(self.solver_options),
        }

    def to_document(self) -> dict[str, float | str]:
        """Return the settings as in a model file: words where the file has words."""
        return {
            name: format_option(name, number) for name, number in self.to_model_options().items()
        }

    def replace_options(self, options: Mapping[str, float]) -> IntegratorSettings:
        """Return the settings with other options.

        Args:
            options: numbers by name of the option, as in `to_model_options`.
        """
        changed = {**self.to_model_options(), **options}
        words = {number: word for word, number in INTEGRATOR_IDS.items()}
        return IntegratorSettings(
            changed.pop("timestep"),
            words[int(changed.pop("integrator"))],
            tuple(sorted(changed.items())),
        )


def format_option(name: str, number: float) -> float | str:
    """Return the value of an option as in a model file: a word where the file has words.

    Args:
        name: name of the option.
        number: its number in a compiled model.
    """
    words = {number: word for word, number in OPTION_WORDS.get(name, {}).items()}
    return words.get(int(number), number) if words else number


def parse_option(name: str, value: float | str) -> float:
    """Return the number of an option in a compiled model; the reverse of `format_option`."""
    return OPTION_WORDS[name][value] if isinstance(value, str) else value


def read_option(robot: RobotModel, name: str) -> float:
    """Return the number of an option in the robot's model file.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        name: name of the option, such as ``impratio``.
    """
    return cast(float, getattr(robot.compiled.opt, name))


def list_changed_options(
    robot: RobotModel, settings: IntegratorSettings
) -> dict[str, tuple[float, float]]:
    """Return the options in which settings differ from the robot's model file.

    Returns:
        Number in the file and number in use, by the effect that names the option.
    """
    options = settings.to_model_options()
    changes = {
        effect: (read_option(robot, name), options[name])
        for effect, name in OPTION_EFFECTS.items()
        if name in options
    }
    return {effect: pair for effect, pair in changes.items() if pair[0] != pair[1]}


DEFAULT_SETTINGS = IntegratorSettings(0.002, "Euler")
"""MuJoCo's default settings."""


class RobotEngine:
    """MuJoCo at the time step of the model; `RobotSimulator` does the simulation."""

    name = "mujoco"

    def __init__(self, numerics: IntegratorSettings) -> None:
        self.numerics = numerics
        self.largest_step = numerics.timestep

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Raise an error: robots are simulated by `RobotSimulator`, not through this interface."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing, since the engine holds no resources."""


def read_integrator_settings(robot: RobotModel) -> IntegratorSettings:
    """Return the integrator settings that the robot's model file specifies."""
    option = robot.compiled.opt
    names = {number: name for name, number in INTEGRATOR_IDS.items()}
    return IntegratorSettings(float(option.timestep), names[int(option.integrator)])


def specifies_integrator(robot: RobotModel) -> bool:
    """Return whether the robot's model file specifies how it is simulated.

    An MJCF does, by its defaults too. A URDF describes the robot alone, unless it contains options
    of MuJoCo.
    """
    return robot.format == "mjcf" or read_integrator_settings(robot) != DEFAULT_SETTINGS


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

    Friction acts with a time constant 1 / b. A step of Euler or of the implicit integrators stops
    the velocity completely with b = 1 / h, and overshoots beyond it. The four evaluations of RK4
    tolerate `MAX_RK4_FRICTION_RATE` / h, and 3 / h chatters. MuJoCo's default time constant,
    0.02 s, creeps at rest.

    Args:
        timestep: time step h in seconds.
        integrator: MuJoCo's number of the integrator.
    """
    if integrator == RK4_INTEGRATOR_ID:
        return (SOLREF_PLACEHOLDER_STIFFNESS, -MAX_RK4_FRICTION_RATE / timestep)
    return (2.0 * timestep, 1.0)


def write_friction_form(fields: Fields, robot: RobotModel, batch_indices: Any, dofs: Any) -> None:
    """Set the solver parameters of dry friction that effects add, in the form of the robot.

    Time step and integrator are taken from the fields if they contain them, else from the file.

    Args:
        fields: model fields of the batch elements, changed in place.
        robot: its `friction_form` decides; ``soft`` keeps the parameters of the file.
        batch_indices: index of the batch elements.
        dofs: index of the joints' velocities.
    """
    if robot.friction_form == "soft":
        return
    option = robot.compiled.opt
    timestep = fields["opt.timestep"][0] if "opt.timestep" in fields else option.timestep
    integrator = fields["opt.integrator"][0] if "opt.integrator" in fields else option.integrator
    solref = get_friction_solref(float(timestep), int(integrator))
    fields["dof_solref"][batch_indices, dofs] = solref
    fields["dof_solimp"][batch_indices, dofs] = FRICTION_SOLIMP


def get_friction_constraint(robot: RobotModel, dof: int) -> tuple[float, float]:
    """Return damping b (1/s) and impedance d of MuJoCo's constraint for friction loss.

    The constraint has the reference acceleration -b v at the velocity v. The values are those of
    the form in which effects add friction to the robot.

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
    timeconst, ratio = (float(value) for value in solref)
    limits = np.clip(solimp[:2], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    (at_rest, largest), width = limits.tolist(), float(solimp[2])
    # Friction has no constraint violation. For a constant impedance, MuJoCo takes the mean.
    d = at_rest if width > mujoco.mjMINVAL else 0.5 * (at_rest + largest)
    if timeconst <= 0:
        return -ratio / largest, d
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE):
        timeconst = max(timeconst, 2.0 * float(model.opt.timestep))
    return 2.0 / (largest * timeconst), d
