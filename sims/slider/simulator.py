"""The slider as a registered simulator."""

from sims.simulated import Simulated
from sims.slider.system import SliderSystem


class Slider(Simulated):
    """A slider; see `SliderSystem`."""

    system = SliderSystem
    default_engine = "pybullet"
