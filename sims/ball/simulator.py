"""Registered simulator of the ball."""

from sims.ball.system import BallSystem
from sims.simulated import Simulated


class Ball(Simulated):
    """Ball that falls and bounces on level ground."""

    system = BallSystem
    default_engine = "pybullet"
