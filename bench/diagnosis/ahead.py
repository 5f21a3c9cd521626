"""What the process that starts diagnosers loads ahead, so that no answer need do it: numerical
packages, the search for causes, the effects, the compiled steps and what they are compiled from.

Nobody's recording is in it: each system is simulated and searched once, in a world of its own.
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
"""Noise of the recordings that are searched."""


def _searched(system: str) -> None:
    """Fit a recording of a system, and look what each effect would change."""
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
