"""Registered simulator of the slider."""

from sims.simulated import Simulated
from sims.slider.system import SliderSystem


class Slider(Simulated):
    """Slider; see `SliderSystem`."""

    system = SliderSystem
    default_engine = "pybullet"
