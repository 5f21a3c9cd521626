"""Names for runs: a readable id that changes with everything that determines a run, and with
nothing else.

``cma_es/wide-017/0/3f9ac2d15b`` is tuner, target and seed, and a hash of the tuner's options, the
simulator with its settings, the target's scenario and observation, budget, limits, code and package
versions.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from bench import __version__
from bench.problem.experiment import Entry, Experiment
from bench.problem.problem import SealedTarget
from bench.registry import simulators, tuners
from bench.runs.training import package_version, recording_digest, source

_WORLD = (
    "simulator",
    "observe",
    "error_channel",
    "timeout",
    "memory",
    "noise",
    "settings",
    "world",
    "constants",
    "parameters",
    "initial",
    "inputs",
    "sampling",
)
_PACKAGES = (
    "cma",
    "mujoco",
    "nlopt",
    "numpy",
    "pybullet",
    "scikit-learn",
    "scikit-optimize",
    "scipy",
    "torch",
)


def digest(*parts: Any, length: int = 10) -> str:
    """A short hexadecimal hash of plain values, arrays' bytes among them."""
    text = json.dumps(parts, sort_keys=True, default=_plainly)
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def _plainly(value: Any) -> Any:
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    return dict(value) if isinstance(value, Mapping) else str(value)


@cache
def code() -> str:
    """Hash of the code that makes runs: methods, worlds, and the part of the harness that drives
    and scores them.
    """
    project = Path(__file__).resolve().parents[2]
    rooms = ("methods", "sims", "bench/problem", "bench/runs")
    files = [file for room in rooms for file in sorted((project / room).rglob("*.py"))]
    return digest(__version__, [[str(f.relative_to(project)), f.read_bytes()] for f in files])


@cache
def versions() -> str:
    """Hash of the versions of Python and the packages that compute."""
    return digest(platform.python_version(), [package_version(name) for name in _PACKAGES])


def fingerprint(experiment: Experiment, plugins: Sequence[str]) -> dict[str, str]:
    """Hashes of everything that must not change while an experiment is under way, by what a person
    would call it.
    """
    return {
        "configuration": digest(experiment.name, experiment.document()),
        "recording": digest(recording_digest(experiment)),
        "plugins": digest([[Path(p).name, Path(p).read_bytes()] for p in plugins]),
        "code": code(),
        "package versions": versions(),
    }


class Identities:
    """Ids of an experiment's runs."""

    def __init__(self, experiment: Experiment) -> None:
        document = experiment.document()
        self._experiment = experiment
        self._world = digest(
            experiment.name,
            {name: document[name] for name in _WORLD},
            source(simulators.get(experiment.simulator)),
            code(),
            versions(),
        )
        self._entries: dict[str, str] = {}
        self._targets: dict[str, str] = {}

    def run(self, entry: Entry, target: SealedTarget, seed: int, budget: int) -> str:
        """The id of one run."""
        if entry.label not in self._entries:
            kind = tuners.get(entry.tuner)
            training = self._experiment.training_budget if kind.learned else 0
            self._entries[entry.label] = digest(
                entry.tuner, dict(entry.options), training, source(kind)
            )
        if target.name not in self._targets:
            self._targets[target.name] = _target(target)
        what = digest(
            self._world, self._entries[entry.label], self._targets[target.name], seed, budget
        )
        return f"{entry.label}/{target.name}/{seed}/{what}"


def _target(target: SealedTarget) -> str:
    """Hash of a target's scenarios, observations and start."""
    sides = [target.fitting, target.held_out]
    scenarios = [
        [s.times.tobytes(), s.initial, {k: v.tobytes() for k, v in s.inputs.items()}, s.constants]
        for side in sides
        for s in side.scenarios
    ]
    return digest(scenarios, [side.observed.tobytes() for side in sides], target.start.tobytes())
