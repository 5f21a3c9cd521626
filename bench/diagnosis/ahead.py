"""Modules that the fork server preloads, so that no diagnosis has to import or compile them.

They are numerical packages, the search for causes, the effects and the compiled integration steps.
No recording of a case is loaded: each system is simulated and searched once with made-up data.
"""

from __future__ import annotations

from contextlib import closing

import numpy as np
import scipy.signal
import scipy.special
import scipy.stats  # noqa: F401 - loaded ahead

import bench.diagnosis.inside
import bench.gap.explain  # noqa: F401 - loaded ahead
from bench.diagnosis.worlds.items import SYSTEMS
from bench.gap.causes.candidates import directions
from bench.gap.model.base_fit import fit_base
from bench.gap.model.floor import noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.recordings.simulate import Wish, make
from sims.engines.compiled import machine
from sims.simulated import Simulated

_SIGMA = 1e-3
"""Noise standard deviation of the recordings used for the warm-up."""


def _searched(system: str) -> None:
    """Fit a simulated recording of a system and compute the direction of each effect."""
    wish = Wish(system=system, noise={"*": _SIGMA}, runs=2, seconds=0.5, rate=50.0, engine="batch")
    made = make(wish)
    kind = type(made.simulator)
    assert issubclass(kind, Simulated)
    with closing(World(kind, made.recording, made.recording.training(), "batch")) as world:
        noise = Noise(noise_floor(world, made.recording).sigma, np.zeros(len(world.channels)))
        directions(world, fit_base(world, noise).fit, world.library)


machine.machine()
for _system in SYSTEMS:
    _searched(_system)
