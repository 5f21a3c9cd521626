"""Registered simulator of the bounce shot."""

from sims.shot.system import ShotSystem
from sims.simulated import Simulated


class BounceShot(Simulated):
    """A ball dropped on an incline, from which it bounces towards a hoop."""

    system = ShotSystem
