"""The pendulum as a registered simulator."""

from sims.pendulum.system import PendulumSystem
from sims.simulated import Simulated


class Pendulum(Simulated):
    """A pendulum; see `PendulumSystem`."""

    system = PendulumSystem
    default_engine = "pybullet"
