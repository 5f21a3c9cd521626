"""How MuJoCo steps a robot: time step and integrator."""

from __future__ import annotations

from typing import NamedTuple

from sims.robot.model import Robot
from sims.system import Lanes, Motion, System

INTEGRATORS = {"Euler": 0, "RK4": 1, "implicit": 2, "implicitfast": 3}
"""MuJoCo's integrators, by their names in a model file."""


class Numerics(NamedTuple):
    """How MuJoCo steps: seconds, and the integrator's name."""

    timestep: float
    integrator: str

    def settings(self) -> dict[str, float]:
        """As options of a model."""
        return {"timestep": self.timestep, "integrator": INTEGRATORS[self.integrator]}


class RobotEngine:
    """MuJoCo at the model's own step; `RobotSimulator` steps it."""

    name = "mujoco"
    requires: tuple[str, ...] = ("mujoco",)

    def __init__(self, numerics: Numerics) -> None:
        self.numerics = numerics
        self.largest_step = numerics.timestep

    def integrate(self, lanes: Lanes) -> Motion:
        """Not for anything but robots."""
        raise NotImplementedError

    def refuses(self, system: type[System]) -> str:
        """Everything that has no model file."""
        return "" if system.has_model else "it has no model file"

    def close(self) -> None:
        """Nothing to give back."""


def own_numerics(robot: Robot) -> Numerics:
    """How the robot's file says that it is stepped."""
    option = robot.compiled.opt
    names = {number: name for name, number in INTEGRATORS.items()}
    return Numerics(float(option.timestep), names[int(option.integrator)])
