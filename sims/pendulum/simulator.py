"""Registered simulator of the pendulum."""

from sims.pendulum.system import PendulumSystem
from sims.simulated import Simulated


class Pendulum(Simulated):
    """Pendulum; see `PendulumSystem`."""

    system = PendulumSystem
    default_engine = "pybullet"
