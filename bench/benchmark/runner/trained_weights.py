"""Files of trained weights: their folder, and writing and reading them with the training's cost.

A file contains the key of its training, so that an exchanged file is detected. Nothing is ever
unpickled.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.benchmark.isolation.process_errors import RunEndedError
from sims.core.files import atomic_replacement
from sims.core.simulator import Array, InputError

_COST_ARRAY = "__simulations_and_seconds__"
"""Name of the array with the cost of the training: simulations and seconds."""
_KEY_ARRAY = "__key__"
"""Name of the array with the training key."""
RETRAIN_ADVICE = "delete it to train again"
"""Advice for a file that cannot be used; it is never repaired silently."""


class WeightsError(InputError):
    """A file of trained weights cannot be used."""


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training.

    Attributes:
        path: file of the weights.
        simulations: number of simulations of the training.
        seconds: duration of the training in seconds.
        was_cached: True if the weights were in the cache.
    """

    path: Path
    simulations: int
    seconds: float
    was_cached: bool = False


def get_weights_folder() -> Path:
    """Return the folder of trained weights: $SIMGAP_CACHE, else simgap/ in the user's cache."""
    if os.environ.get("SIMGAP_CACHE"):
        return Path(os.environ["SIMGAP_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


def write_weights(
    path: Path, state: Mapping[str, Array], simulations: int, seconds: float
) -> TrainingResult:
    """Write trained weights to a file, atomically because several processes may train the tuner.

    Args:
        path: path of the NumPy archive, named by the training key.
        state: weights by name.
        simulations: number of simulations of the training.
        seconds: duration of the training in seconds.

    Returns:
        The path and the cost of the training.

    Raises:
        RunEndedError: an array has a name that is reserved.
    """
    # `file` and `allow_pickle` are arguments of `np.savez`; the others are written below.
    reserved = {"file", "allow_pickle", _COST_ARRAY, _KEY_ARRAY} & set(state)
    if reserved:
        raise RunEndedError(
            "crashed", f"the trained state has arrays with the reserved names {reserved}"
        )
    # The key is stored with the weights, so that an exchanged file is detected.
    metadata = {
        _COST_ARRAY: np.array([simulations, seconds]),
        _KEY_ARRAY: np.frombuffer(path.stem.encode(), dtype=np.uint8),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_replacement(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **state, **metadata)
    return TrainingResult(path, simulations, seconds)


def read_weights(path: Path) -> dict[str, Array]:
    """Read the weights of a file, without the cost of the training and its key.

    Returns:
        Arrays by name.

    Raises:
        WeightsError: the file is missing, damaged, or of another training.
    """
    state = _read_checked_arrays(path)
    del state[_COST_ARRAY], state[_KEY_ARRAY]
    return state


def read_training_cost(path: Path) -> TrainingResult:
    """Read the cost of the training whose weights a file has.

    Raises:
        WeightsError: the file is missing, damaged, or of another training.
    """
    simulations, seconds = _read_checked_arrays(path)[_COST_ARRAY]
    return TrainingResult(path, int(simulations), float(seconds), was_cached=True)


def _read_checked_arrays(path: Path) -> dict[str, Array]:
    """Read and check the arrays of a weights file.

    The file has the weights, the cost of the training (two numbers) and its key, which must be the
    name of the file. Nothing is unpickled.

    Raises:
        WeightsError: the file is missing, damaged, or of another training.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {member: file[member] for member in file.files}
    except (
        OSError,
        ValueError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
        KeyError,
        AttributeError,
    ):
        raise WeightsError(
            f"{path}: expected trained weights, found none or a damaged file; {RETRAIN_ADVICE}"
        ) from None
    counts, stored_key = arrays.get(_COST_ARRAY, np.empty(0)), arrays.get(_KEY_ARRAY, np.empty(0))
    if (
        counts.shape != (2,)
        or counts.dtype != np.float64
        or stored_key.dtype != np.uint8
        or stored_key.ndim != 1
    ):
        raise WeightsError(
            f"{path}: expected trained weights, found arrays {sorted(arrays)[:4]}; {RETRAIN_ADVICE}"
        )
    stored_name = stored_key.tobytes().decode("utf-8", "replace")
    if stored_name != path.stem:
        raise WeightsError(
            f"{path}: expected the weights of {path.stem}, found those of {stored_name:.80}; "
            f"{RETRAIN_ADVICE}"
        )
    return arrays
