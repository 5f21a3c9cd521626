"""The check before the fit: can *this* recording fix a number, and what is it mixed up with?"""

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
    """What a recording can say of every free number, and of every cause.

    Args:
        source: the recording.
        system: take it for this system.
        model: take it for this robot.
        free: numbers of a robot's model file, or constants of a system, that are estimated.
        jobs: processes that work at once.

    Raises:
        InputError: it cannot be read, or is of nothing that takes effects.
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
