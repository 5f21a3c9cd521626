"""A recording drawn: every input and channel over time, the runs end to end, held-out runs on grey
ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.recordings.inspection import declared
from sims.base import Array, InputError, Simulator
from sims.recording.recording import Recording, Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_RUNS = 40
_MOST_POINTS = 4000
"""Points drawn of one run; of a longer one the extremes of each part are drawn."""
_FITTING, _HELD_OUT, _GROUND = "#0072B2", "#A03C00", "#E4E4E4"


class _Placed(NamedTuple):
    """A run where it stands on the common axis: its first instant is drawn at `begin`."""

    run: Run
    begin: float

    @property
    def times(self) -> Array:
        shifted: Array = self.run.times - self.run.times[0] + self.begin
        return shifted


def draw(recording: Recording, kind: type[Simulator], folder: Path) -> list[Path]:
    """Draw the recording into `folder` as PNG and PDF, named for it; returns the two.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    signals = declared(recording, kind)
    placed = _placed(recording.runs)
    width = float(np.clip(3 + 0.8 * len(placed), 9, 16))
    figure, axes = plt.subplots(
        len(signals),
        1,
        figsize=(width, 1.2 + 2.0 * len(signals)),
        sharex=True,
        squeeze=False,
        layout="constrained",
    )
    for axis, (channel, what) in zip(axes[:, 0], signals, strict=True):
        unit = "" if channel.unit == "1" else f" [{_pretty(channel.unit)}]"
        axis.set_ylabel(f"{channel.name}{unit}\n({what})")
        for part in placed:
            _panel(
                axis, part, part.run.channels.get(channel.name, part.run.inputs.get(channel.name))
            )
    _finish(list(axes[:, 0]), recording, placed)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        made = [folder / f"{recording.path.stem}{ending}" for ending in (".png", ".pdf")]
        figure.savefig(made[0], dpi=150)
        figure.savefig(made[1], metadata={"CreationDate": None})
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written ({error.strerror})") from None
    finally:
        plt.close(figure)
    return made


def _pretty(unit: str) -> str:
    return unit.replace("^2", "²").replace("^3", "³").replace("*", "·")


def _placed(runs: Sequence[Run]) -> list[_Placed]:
    """The runs one behind the other, a little apart; of very many, some evenly chosen."""
    if len(runs) > _MOST_RUNS:
        runs = [runs[i] for i in np.linspace(0, len(runs) - 1, _MOST_RUNS).round().astype(int)]
    lengths = [float(run.times[-1] - run.times[0]) for run in runs]
    apart = 0.015 * sum(lengths) / max(1.0, len(runs) ** 0.5)
    begins = np.concatenate([[0.0], np.cumsum(np.array(lengths) + apart)[:-1]])
    return [_Placed(run, float(begin)) for run, begin in zip(runs, begins, strict=True)]


def _panel(axis: Axes, part: _Placed, values: Array | None) -> None:
    assert values is not None
    times = part.times
    if part.run.held_out:
        axis.axvspan(float(times[0]), float(times[-1]), color=_GROUND, linewidth=0)
    missing = np.isnan(values)
    t, y = _thinned(times, values)
    marker = "." if values.size <= 60 or missing.mean() > 0.2 else ""
    colour = _HELD_OUT if part.run.held_out else _FITTING
    axis.plot(t, y, color=colour, linewidth=0.9, marker=marker, markersize=3, linestyle="-")
    if missing.any():
        axis.plot(
            times[missing],
            np.full(missing.sum(), 0.02),
            "|",
            color="black",
            markersize=5,
            transform=axis.get_xaxis_transform(),
        )


def _thinned(times: Array, values: Array) -> tuple[Array, Array]:
    """At most about `_MOST_POINTS` points that look the same: the least and the largest of each
    stretch.
    """
    if values.size <= _MOST_POINTS:
        return times, values
    size = -(-values.size // (_MOST_POINTS // 2))
    edges = range(0, values.size, size)
    keep = set()
    for begin in edges:
        stretch = values[begin : begin + size]
        if np.isfinite(stretch).any():
            keep |= {begin + int(np.nanargmin(stretch)), begin + int(np.nanargmax(stretch))}
        else:
            keep.add(begin)
    rows = np.array(sorted(keep))
    return times[rows], values[rows]


def _finish(axes: Sequence[Axes], recording: Recording, placed: Sequence[_Placed]) -> None:
    from matplotlib.lines import Line2D

    for axis in axes:
        axis.grid(visible=True, axis="y", linewidth=0.4, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.01)
        for part in placed[1:]:
            axis.axvline(part.begin, color="#888888", linewidth=0.5, linestyle=":")
    for part in placed:
        middle = float(part.times[[0, -1]].mean())
        axes[0].annotate(
            part.run.name,
            (middle, 1.0),
            (0, 2),
            xycoords=axes[0].get_xaxis_transform(),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=8 if len(placed) <= 20 else 6,
            annotation_clip=False,
        )
    axes[-1].set_xlabel("time, runs end to end [s]; above: their names")
    total = len(recording.runs)
    some = f", {len(placed)} of {total} runs" if len(placed) < total else ""
    axes[0].set_title(f"{recording.title}{some}", fontsize=11, pad=16)
    marks = [Line2D([], [], color=_FITTING, label="for fitting")]
    if recording.held_out():
        marks.append(Line2D([], [], color=_HELD_OUT, label="held out (grey ground)"))
    if any(np.isnan(v).any() for part in placed for v in part.run.channels.values()):
        marks.append(
            Line2D([], [], color="black", marker="|", linestyle="", label="missing sample")
        )
    axes[0].figure.legend(
        handles=marks, loc="outside lower center", ncols=3, fontsize=8, frameon=False
    )
