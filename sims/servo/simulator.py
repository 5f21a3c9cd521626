"""The servo as a registered simulator."""

from sims.servo.system import ServoSystem
from sims.simulated import Simulated


class Servo(Simulated):
    """A servo; see `ServoSystem`."""

    system = ServoSystem
    default_engine = "pybullet"
