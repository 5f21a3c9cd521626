"""Convert the files of data sets into the recording format."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping

import numpy as np

from sims.core.files import Content
from sims.core.simulator import InputError

Conversion = Callable[[Mapping[str, bytes]], dict[str, Content]]
"""Function from the contents of a data set's files, by name, to the files to write, by name."""

_PERIOD_MS = 1
"""Sample period of the published file, ms."""
_DECIMATION = 5
"""Decimation factor: every fifth sample is kept, which gives 200 Hz."""
_SAMPLES_PER_RUN = 1000
"""Number of samples of a run: 5 s at 200 Hz."""
_HELD_OUT_FROM = 7
"""Number of the first held-out run."""
_DECIMALS = 6
"""Number of decimals to which angles and rates are rounded; an encoder step is 1e-3 rad."""

_FREE_SWING = """system = "pendulum"
title = "Single pendulum, free swing, encoder"

[channels.q]
unit = "rad"      # 0 = hanging straight down

[channels.qd]
unit = "rad/s"

[constants]
mass = 0.1476     # kg, bob and rod
length = 0.1478   # m, hinge to centre of mass
gravity = 9.81    # m/s^2
"""


def free_swing(files: Mapping[str, bytes]) -> dict[str, Content]:
    """Convert the free swing of the single pendulum to a recording with runs of 5 s.

    The MATLAB file holds one swing at 1 ms, divided into pieces: ``Y_id`` and ``Y_vad`` are cell
    arrays of (2, T) angles (pi is hanging) and rates. The pieces are joined, every fifth sample is
    kept, and the angle is measured from hanging. Runs from number 7 on are held out.

    Raises:
        InputError: the file does not have this form.
    """
    (name,) = [name for name in files if name.endswith(".mat")]
    swing = _join_records(name, files[name])[:, ::_DECIMATION]
    q = np.round(swing[0], _DECIMALS) - np.pi
    qd = np.round(swing[1], _DECIMALS)
    runs = swing.shape[1] // _SAMPLES_PER_RUN
    if runs == 0:
        raise InputError(
            f"{name}: expected at least {_SAMPLES_PER_RUN * _DECIMATION} samples of 1 ms"
        )
    lines = ["run,t,q,qd"]
    for run in range(runs):
        for i in range(_SAMPLES_PER_RUN):
            k = run * _SAMPLES_PER_RUN + i
            t = i * _DECIMATION * _PERIOD_MS / 1000
            lines.append(f"{run + 1},{t:.7g},{q[k]:.7g},{qd[k]:.7g}")
    held_out = range(_HELD_OUT_FROM, runs + 1)
    description = _FREE_SWING + "".join(f"\n[runs.{run}]\nheld_out = true\n" for run in held_out)
    return {"recording.csv": "\n".join(lines) + "\n", "recording.toml": description}


def _join_records(name: str, content: bytes) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Join the angles and rates (2, T) of all pieces of a MATLAB file, in their order.

    Args:
        name: name of the file, for messages.
        content: content of the file.

    Raises:
        InputError: the file is damaged or has another form.
    """
    from scipy.io import loadmat

    try:
        arrays = loadmat(io.BytesIO(content))  # type: ignore[arg-type]  # the stubs know no streams
        records = [record for key in ("Y_id", "Y_vad") for record in arrays[key].ravel()]
        joined_samples = np.concatenate([np.asarray(record, float) for record in records], axis=1)
    except Exception as error:  # the reader raises various errors for a damaged file
        reason = f"{type(error).__name__}: {error}"
        expected = "a MATLAB file with cell arrays Y_id and Y_vad of (2, T) numbers"
        raise InputError(f"{name}: expected {expected} ({reason})") from None
    if joined_samples.shape[0] != 2:
        raise InputError(
            f"{name}: expected 2 rows in Y_id and Y_vad, found {joined_samples.shape[0]}"
        )
    return joined_samples


CONVERSIONS: Mapping[str, Conversion] = {"free_swing": free_swing}
"""Conversions by their names in datasets.toml."""
