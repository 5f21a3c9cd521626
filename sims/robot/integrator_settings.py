"""Time step and integrator with which MuJoCo simulates a robot."""

from __future__ import annotations

from typing import NamedTuple

from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.system import System
from sims.robot.robot_model import RobotModel

INTEGRATOR_IDS = {"Euler": 0, "RK4": 1, "implicit": 2, "implicitfast": 3}
"""Numbers of MuJoCo's integrators (mjtIntegrator), by their names in a model file."""
RK4_INTEGRATOR_ID = INTEGRATOR_IDS["RK4"]
"""MuJoCo's number of the Runge-Kutta 4 integrator."""


class IntegratorSettings(NamedTuple):
    """Integrator settings of MuJoCo.

    Attributes:
        timestep: time step in seconds.
        integrator: name of the integrator, a key of `INTEGRATOR_IDS`.
    """

    timestep: float
    integrator: str

    def to_model_options(self) -> dict[str, float]:
        """Return the settings as fields of a model's options (`mujoco.MjOption`)."""
        return {"timestep": self.timestep, "integrator": INTEGRATOR_IDS[self.integrator]}


DEFAULT_SETTINGS = IntegratorSettings(0.002, "Euler")
"""MuJoCo's default settings."""


class RobotEngine:
    """MuJoCo at the time step of the model; `RobotSimulator` does the simulation."""

    name = "mujoco"
    requires: tuple[str, ...] = ("mujoco",)

    def __init__(self, numerics: IntegratorSettings) -> None:
        self.numerics = numerics
        self.largest_step = numerics.timestep

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Raise an error: robots are simulated by `RobotSimulator`, not through this interface."""
        raise NotImplementedError

    def find_unsupported_reason(self, system: type[System]) -> str:
        """Return why this engine cannot simulate a system; empty if it can."""
        return "" if system.has_model else "it has no model file"

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
