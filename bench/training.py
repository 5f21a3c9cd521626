"""Trains learned tuners once for each simulator and seed, and keeps what they learned as plain tensors.

The file's name is a hash of everything that went in: the tuner's and simulator's source and options, the training range
and scenarios, budget, seed, and the versions of the packages that compute. Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import sys
import zipfile
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.experiment import Entry, Experiment
from bench.measured import find_recording
from bench.problem import Problem
from bench.registry import simulators, tuners
from bench.seeds import rng_for
from methods.base import Array, Tuner
from sims.base import InputError

_COUNTS = "__simulations_and_seconds__"


@dataclass(frozen=True)
class Training:
    """What one training cost, and where its tensors lie."""

    path: Path
    simulations: int
    seconds: float


def build(entry: Entry) -> Tuner:
    """The tuner of an entry, with its options.

    Raises:
        InputError: an option that the tuner does not have, or a value that it refuses.
    """
    kind = tuners.get(entry.tuner)
    try:
        return kind(**entry.options)
    except (TypeError, ValueError) as error:
        raise InputError(f"tuner {entry.label}: {error}") from None


def folder() -> Path:
    """Where trained weights are kept: $SIMGAP_CACHE, else simgap/ in the user's cache folder."""
    if os.environ.get("SIMGAP_CACHE"):
        return Path(os.environ["SIMGAP_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


def key(experiment: Experiment, entry: Entry, seed: int) -> str:
    """The hash of everything that determines the trained weights."""
    document = experiment.document()
    training = ("simulator", "observe", "noise", "settings", "constants", "parameters", "initial", "inputs", "sampling")
    what = {name: document[name] for name in training} | {
        "recording": recording_digest(experiment),
        "tuner": entry.tuner,
        "options": dict(entry.options),
        "budget": experiment.training_budget,
        "seed": seed,
        "source": [source(tuners.get(entry.tuner)), source(simulators.get(experiment.simulator))],
        "versions": [sys.version, *(package_version(name) for name in ("numpy", "pybullet", "torch"))],
    }
    text = json.dumps(what, sort_keys=True, default=str)
    return f"{entry.tuner}-{experiment.simulator}-{seed}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def recording_digest(experiment: Experiment) -> str:
    """Hash of the recording's two files; empty where the experiment has none."""
    if experiment.recording is None:
        return ""
    table = find_recording(experiment.recording.path)
    return hashlib.sha256(table.read_bytes() + table.with_suffix(".toml").read_bytes()).hexdigest()


def source(kind: type) -> str:
    """Digest of the source of the package folder (or plugin file) that a class comes from."""
    path = Path(inspect.getfile(kind))
    files = sorted(path.parent.glob("*.py")) if kind.__module__.split(".")[0] in ("methods", "sims") else [path]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def package_version(name: str) -> str:
    """Name and version of an installed package, or that it is absent."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} absent"


def train(experiment: Experiment, entry: Entry, seed: int) -> Training:
    """Train, or find trained: the tensors' file and what the training cost when it was done."""
    path = folder() / f"{key(experiment, entry, seed)}.npz"
    if (costs := _read(path)) is not None:
        simulations, seconds = costs[_COUNTS]
        return Training(path, int(simulations), float(seconds))
    tuner = build(entry)
    practice = Problem(experiment).practice(experiment.training_budget)
    started = perf_counter()
    tuner.fit(practice, rng_for(experiment.name, "fit", entry.tuner, seed), experiment.training_budget)
    seconds = perf_counter() - started
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.stem}.{os.getpid()}.npz")  # so that a reader never meets half a file
    np.savez(partial, allow_pickle=False, **tuner.state(), **{_COUNTS: np.array([practice.used, seconds])})
    partial.replace(path)
    return Training(path, practice.used, seconds)


def trained(entry: Entry, path: Path) -> Tuner:
    """The tuner with the tensors of `path`.

    Raises:
        InputError: the file is truncated or foreign.
    """
    tuner = build(entry)
    state = _read(path)
    if state is None:
        raise InputError(f"{path}: expected trained weights of {entry.label}, found none; delete it and run again")
    state.pop(_COUNTS)
    try:
        tuner.restore(state)
    except ValueError as error:
        raise InputError(f"{path}: not the weights of {entry.label}: {error}") from None
    return tuner


def _read(path: Path) -> dict[str, Array] | None:
    """The arrays of an .npz file; None where it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError):
        return None
    return arrays if _COUNTS in arrays else None
