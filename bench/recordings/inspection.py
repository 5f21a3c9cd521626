"""What is in a recording: runs, rates, gaps, ranges, noise; as text and as a figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.recordings.noise import Noise, estimated, gaps
from bench.registry import simulators
from sims.base import Array, Channel, InputError, Simulator
from sims.recording.recording import Recording, Run, divided, read_recording, system_of

_MOST_RUNS = 40
_CAVEAT = (
    "estimated: from second and third differences, white noise assumed; coloured noise makes it too small, motion that "
    "is fast against the sampling too large"
)


def load(
    source: str | Path | Recording, system: str | None = None
) -> tuple[Recording, type[Simulator]]:
    """A recording, and the simulator of the system it is of (or of `system`).

    Args:
        source: the table's path, or a recording that is in memory already.
        system: take it for this system, whatever it says of itself.

    Raises:
        InputError: it cannot be read, or there is no such system.
    """
    path = source.path if isinstance(source, Recording) else Path(source)
    name = system or (source.system if isinstance(source, Recording) else system_of(path))
    try:
        kind = simulators.get(name)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if isinstance(source, Recording):
        return divided(source), kind
    return read_recording(path, kind), kind


def summary(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Lines that say what is in the recording."""
    runs = recording.runs
    samples = sum(run.times.size for run in runs)
    seconds = sum(run.times[-1] - run.times[0] for run in runs)
    held_out = len(recording.held_out())
    yield recording.title
    whole = len({run.name for run in runs})
    held = "its last third held out" if whole < len(runs) else f"{held_out} held out"
    size = f"{_count(whole, 'run')} ({held}), {samples} samples, {seconds:.4g} s"
    yield f"{recording.path}: system {recording.system}, {size}"
    yield ""
    yield from _aligned([_RUN_HEAD, *map(_run_row, runs[:_MOST_RUNS])], left=2)
    if len(runs) > _MOST_RUNS:
        yield f"... and {len(runs) - _MOST_RUNS} more runs"
    yield ""
    yield from _aligned([_SIGNAL_HEAD, *_signal_rows(recording, kind)], left=3)
    yield _CAVEAT
    yield ""
    yield from _constants(recording, kind)


_RUN_HEAD = (
    "run",
    "use",
    "samples",
    "seconds",
    "rate [Hz]",
    "intervals [ms]: min",
    "median",
    "max",
    "gaps",
    "missing",
)


def _run_row(run: Run) -> tuple[str, ...]:
    intervals = 1e3 * np.diff(run.times)
    low, median, high = float(intervals.min()), float(np.median(intervals)), float(intervals.max())
    missing = sum(int(np.isnan(v).sum()) for v in run.channels.values())
    return (
        run.name,
        "held out" if run.held_out else "fitting",
        str(run.times.size),
        f"{run.times[-1] - run.times[0]:.4g}",
        f"{1e3 / median:.4g}",
        f"{low:.4g}",
        f"{median:.4g}",
        f"{high:.4g}",
        str(gaps(run.times)),
        str(missing),
    )


_SIGNAL_HEAD = ("signal", "kind", "unit", "min", "max", "missing", "noise: stated", "estimated", "")


def _signal_rows(recording: Recording, kind: type[Simulator]) -> Iterator[tuple[str, ...]]:
    for channel, what in declared(recording, kind):
        signals = [(run.times, _of(run, channel.name)) for run in recording.runs]
        values = np.concatenate([v for _, v in signals])
        noise = estimated(signals) if what == "channel" else Noise(np.nan, 0.0)
        stated = recording.noise.get(channel.name)
        yield (
            channel.name,
            what,
            channel.unit,
            f"{np.nanmin(values):.4g}",
            f"{np.nanmax(values):.4g}",
            f"{np.isnan(values).mean():.1%}" if np.isnan(values).any() else "0",
            ("-" if what == "channel" else "") if stated is None else f"{stated:.3g}",
            f"{noise.sigma:.3g}" if np.isfinite(noise.sigma) else "",
            f"in steps of {noise.step:.3g}" if noise.step else "",
        )


def declared(recording: Recording, kind: type[Simulator]) -> list[tuple[Channel, str]]:
    """The recorded inputs and channels, each with the word for what it is."""
    first = recording.runs[0]
    inputs = [(c, "input") for c in kind.inputs if c.name in first.inputs]
    return inputs + [(c, "channel") for c in kind.channels if c.name in first.channels]


def _of(run: Run, name: str) -> Array:
    return run.channels[name] if name in run.channels else run.inputs[name]


def _constants(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    for constant in kind.constants:
        usual = recording.constants.get(constant.name, constant.value)
        note = "" if constant.name in recording.constants else " (the system's default; not stated)"
        by_value: dict[float, list[str]] = {}
        for run in recording.runs:
            by_value.setdefault(run.constants.get(constant.name, usual), []).append(run.name)
        unit = "" if constant.unit == "1" else f" {constant.unit}"
        if len(by_value) == 1:
            value = next(iter(by_value))
            stated = any(constant.name in run.constants for run in recording.runs)
            yield f"{constant.name} = {value:g}{unit}{'' if stated else note}"
        else:
            parts = [f"{value:g}{unit} in {_named(names)}" for value, names in by_value.items()]
            yield f"{constant.name} differs by run: {'; '.join(parts)}"
    known = [
        f"{run.name} ({', '.join(f'{k} = {v:g}' for k, v in run.initial.items())})"
        for run in recording.runs
        if run.initial
    ]
    if known:
        yield f"initial states stated: {', '.join(known[:_MOST_RUNS])}"


def _named(names: Sequence[str]) -> str:
    shown = ", ".join(names[:12])
    return f"run{'s' * (len(names) > 1)} {shown}" + (
        f" and {len(names) - 12} more" if len(names) > 12 else ""
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _aligned(rows: Sequence[Sequence[str]], left: int) -> Iterator[str]:
    """Columns, the first `left` of them to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [
            c.ljust(w) if i < left else c.rjust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ]
        yield "  ".join(cells).rstrip()
