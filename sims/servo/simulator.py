"""Registered simulator of the servo."""

from sims.servo.system import ServoSystem
from sims.simulated import Simulated


class Servo(Simulated):
    """Servo; see `ServoSystem`."""

    system = ServoSystem
    default_engine = "pybullet"
