"""Train diagnosers and cache the result in the user's cache folder.

The cache key contains everything that the result depends on.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.room import taught
from bench.problem.seeds import stream_of
from bench.runs.housing import undisturbed
from bench.runs.sources import digest, rooms, versions
from bench.runs.training import folder
from bench.sealing.outside import Tuned
from sims.files import replacing

PLACE = "diagnosers"
"""Subfolder of the cache of trained weights."""
ROOMS = ("sims", "bench/sealing", "bench/gap", "bench/recordings", "bench/diagnosers")
"""Source folders that determine the result of a training."""


class Learned(NamedTuple):
    """Result of training a diagnoser for a system.

    Attributes:
        path: file with the trained arrays.
        simulations: number of simulations that the training used.
        seconds: time that the training took.
        found: whether the result was already in the cache.
    """

    path: Path
    simulations: int
    seconds: float
    found: bool


def learn(
    code: Tuned,
    source: str,
    system: str,
    budget: int,
    seconds: float,
    hidden: tuple[str, ...],
    trusted: bool,
) -> Learned:
    """Train a diagnoser for a system, or load the cached result.

    Args:
        code: where its code is.
        source: hash of its code.
        system: name of the system.
        budget: maximum number of simulations.
        seconds: maximum time.
        hidden: folders that the diagnoser's process must not read.
        trusted: whether the diagnoser runs in this process.

    Raises:
        EndedError: the training failed.
    """
    key = digest(code.name, source, system, budget, rooms(ROOMS), versions(), length=20)
    path = folder() / PLACE / f"{code.name}-{system}-{key}.npz"
    told = path.with_suffix(".json")
    if (cost := _cost(told)) is not None and zipfile.is_zipfile(path):
        return Learned(path, *cost, found=True)
    lesson: dict[str, Any] = {
        "wanted": {"name": code.name, "module": code.module, "file": code.file},
        "system": system,
        "budget": budget,
        "seed": stream_of("diagnosis", "lesson", code.name, system).tolist(),
    }
    arrays, used, spent = undisturbed(lambda: taught(code, lesson, seconds, hidden, trusted))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, keep_ending=True) as partial:
        named: dict[str, Any] = dict(arrays)
        np.savez_compressed(partial, **named)
    with replacing(told) as partial:
        partial.write_text(json.dumps([used, spent]), encoding="utf-8")
    return Learned(path, used, spent, found=False)


def _cost(path: Path) -> tuple[int, float] | None:
    try:
        used, seconds = json.loads(path.read_text(encoding="utf-8"))
        return int(used), float(seconds)
    except (OSError, ValueError, TypeError):
        return None
