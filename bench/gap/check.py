"""Identifiability check before a fit: which parameters and causes can a recording identify?"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from bench.gap.identify import Number, identified
from bench.gap.measure import central
from bench.gap.model.base_fit import fit_base
from bench.gap.model.crew import Crew
from bench.gap.model.floor import noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.recordings.filter_start import leave_out_settling
from bench.recordings.inspection import load
from bench.recordings.pieces import cut
from sims.base import InputError
from sims.recording.recording import Recording
from sims.simulated import Simulated


def check(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    jobs: int = 1,
) -> tuple[Number, ...]:
    """Assess which free numbers and which causes a recording can identify.

    Args:
        source: Recording, or the path of its table.
        system: Name of the system to use instead of the one in the description.
        model: Model file of a robot to use instead of the one in the description.
        free: Numbers of a robot's model file, or constants of a system, that are estimated.
        jobs: Number of worker processes.

    Returns:
        Identifiability of each free number, then of each cause.

    Raises:
        InputError: The recording cannot be read, or its simulator takes no effects.
    """
    recording, kind = load(source, system, model, free)
    if not issubclass(kind, Simulated):
        raise InputError(f"{recording.path}: simulator {recording.system} takes no effects")
    recording, _ = leave_out_settling(recording, kind)
    recording, _ = cut(recording, kind)
    engine = kind.default_engine if kind.own_engine else "batch"
    constants = () if kind.has_model else tuple(free)
    with closing(Crew(jobs)) as crew:
        world = World(kind, recording, recording.training(), engine, (), constants)
        world.crew = crew
        crew.join(world)
        floor = noise_floor(world, recording)
        noise = Noise(floor.sigma, np.zeros(len(floor.sigma)))
        base = fit_base(world, noise)
        if not np.isfinite(base.fit.cost):
            raise InputError(
                f"{recording.path}: the simulation fails wherever a fit begins; "
                "check constants, units, inputs and initial states"
            )
        numbers = identified(world, noise, central(world, base.fit, noise))
        world.close()
    return numbers
