"""The ball as a registered simulator."""

from sims.ball.system import BallSystem
from sims.simulated import Simulated


class Ball(Simulated):
    """A ball that falls and bounces on level ground."""

    system = BallSystem
    default_engine = "pybullet"
