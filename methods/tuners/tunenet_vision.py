"""TuneNet on vision: simulated heights against the track of a film.

Source: Allevato et al., CoRL 2019, arXiv 1907.11200.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from methods.learning.input_features import FeatureConfig
from methods.learning.pair_network import PairNetworkDesign
from methods.tuners.tunenet import TuneNet

_LAST_CHANNEL = 1_000_000
"""Index of the last channel, larger than any number of channels."""


@dataclass(eq=False)
class TuneNetVision(TuneNet):
    """TuneNet with another sensor on the side of the target; the network learns the relation.

    The proposed side reads the first channel of the simulation, such as `z` of simulator
    ball-filmed. The target's side reads the other channels of the target, such as the pixel row
    `v`, and nothing about the camera, as published. A single channel is read by both sides. The
    proposed model fills gaps of the target (`learning.gap_filling`). Inputs, training and steps are
    otherwise those of `methods.tuners.tunenet.TuneNet`; h(o, o) = 0 cannot hold by construction,
    since no target is seen as a simulation is.

    Attributes:
        scenarios: training scenarios, each with a camera of its own, at most as many as the budget
            allows.
        noise: noise of the tracker, 1 sigma, in units of the channel's standard deviation in
            training.
        clean: as in TuneNet; the errors of a tracker last.
        told: read what is known of the scenario, such as where the camera stands.
        channels: first and last channel that the target's side reads, by number.
    """

    name: ClassVar[str] = "tunenet-vision"

    scenarios: int = 200
    strictness: float = 100.0
    noise: float = 0.02
    told: bool = False
    channels: tuple[int, int] | None = (1, _LAST_CHANNEL)
    clean: bool = False

    def make_network_design(self) -> PairNetworkDesign:
        """Return the design of the network."""
        return replace(super().make_network_design(), antisymmetric=False)

    def make_feature_config(self) -> FeatureConfig:
        """Return the configuration of the inputs of both sides."""
        target = super().make_feature_config()
        # The simulation shows heights, which do not depend on the camera.
        return replace(
            target, proposed=replace(target, use_scenario_features=False, channels=(0, 0))
        )
