"""Summarise a recording as text: runs, rates, gaps, ranges and noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.logs.signal_statistics import (
    compute_run_statistics,
    compute_signal_statistics,
    list_recorded_signals,
)
from sims.core.simulator import Simulator
from sims.core.values import format_unit
from sims.recording.recording import (
    Recording,
    Run,
)

_MAX_LISTED_RUNS = 40
"""Maximum number of runs that are listed."""
_MAX_LISTED_NAMES = 12
"""Maximum number of runs that are named in one line."""
_CAVEAT = (
    "estimated: from second and third differences, white noise assumed; it is too small "
    "for coloured noise, and too large if the motion is fast compared with the sampling"
)
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
_SIGNAL_HEAD = ("signal", "kind", "unit", "min", "max", "missing", "noise: stated", "estimated", "")


def format_summary(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Yield the lines of a text summary of a recording.

    Args:
        recording: Recording to summarise.
        kind: Simulator class of its system.
    """
    runs = recording.runs
    samples = sum(run.times.size for run in runs)
    seconds = sum(run.times[-1] - run.times[0] for run in runs)
    held_out = len(recording.held_out())
    yield recording.title
    # A single run is divided into two parts with the same name.
    run_count = len({run.name for run in runs})
    held_out_text = f"{held_out} held out"
    if run_count < len(runs):
        held_out_text = "its last third is held out"
    if recording.folds():
        held_out_text = "each left out in turn"
    size = (
        f"{_format_count(run_count, 'run')} ({held_out_text}), {samples} samples, {seconds:.4g} s"
    )
    yield f"{recording.path}: system {recording.system}, {size}"
    yield from recording.notes
    yield ""
    yield from _align_columns([_RUN_HEAD, *map(_run_row, runs[:_MAX_LISTED_RUNS])], left_columns=2)
    if len(runs) > _MAX_LISTED_RUNS:
        yield f"... and {len(runs) - _MAX_LISTED_RUNS} more runs"
    yield ""
    yield from _align_columns(
        [_SIGNAL_HEAD, *_iterate_signal_rows(recording, kind)], left_columns=3
    )
    yield _CAVEAT
    yield ""
    yield from _format_constants(recording, kind)


def _format_use(run: Run) -> str:
    if run.fold is not None:
        return "left out in turn"
    return "held out" if run.held_out else "fitting"


def _run_row(run: Run) -> tuple[str, ...]:
    """Format the statistics of a run as a table row; sampling intervals are in milliseconds."""
    statistics = compute_run_statistics(run)
    return (
        statistics.name,
        _format_use(run),
        str(statistics.samples),
        f"{statistics.seconds:.4g}",
        f"{statistics.rate:.4g}",
        *(f"{1e3 * t:.4g}" for t in (statistics.shortest, statistics.median, statistics.longest)),
        str(statistics.gaps),
        str(statistics.missing),
    )


def _iterate_signal_rows(recording: Recording, kind: type[Simulator]) -> Iterator[tuple[str, ...]]:
    """Yield a row of the table of signals for each channel and input: unit, range, gaps and noise.

    `role` is the kind of the signal. The stated noise is "-" for a channel whose noise is not
    stated; steps are quantisation steps.
    """
    for channel, role in list_recorded_signals(recording, kind):
        statistics = compute_signal_statistics(recording, channel, role)
        not_stated = "-" if role == "channel" else ""
        yield (
            statistics.name,
            role,
            format_unit(statistics.unit) or "1",
            f"{statistics.low:.4g}",
            f"{statistics.high:.4g}",
            f"{statistics.missing:.1%}" if statistics.missing else "0",
            not_stated if statistics.stated is None else f"{statistics.stated:.3g}",
            f"{statistics.estimated:.3g}" if np.isfinite(statistics.estimated) else "",
            f"in steps of {statistics.step:.3g}" if statistics.step else "",
        )


def _format_constants(recording: Recording, kind: type[Simulator]) -> Iterator[str]:
    """Yield a line for each constant of the system, and one for the stated initial states."""
    for constant in kind.constants:
        yield _format_constant(recording, constant.name, constant.value, constant.unit)
    run_texts = []
    for run in recording.runs:
        if run.initial:
            states = ", ".join(f"{name} = {value:g}" for name, value in run.initial.items())
            run_texts.append(f"{run.name} ({states})")
    if run_texts:
        yield f"initial states stated: {', '.join(run_texts[:_MAX_LISTED_RUNS])}"


def _format_constant(recording: Recording, name: str, default: float, unit: str) -> str:
    """Describe a constant's value, and list the runs with each value if it differs."""
    common_value = recording.constants.get(name, default)
    runs_by_value: dict[float, list[str]] = {}
    for run in recording.runs:
        runs_by_value.setdefault(run.constants.get(name, common_value), []).append(run.name)
    unit = f" {format_unit(unit)}".rstrip()
    if len(runs_by_value) > 1:
        parts = [
            f"{value:g}{unit} in {_format_run_names(runs)}" for value, runs in runs_by_value.items()
        ]
        return f"{name} differs by run: {'; '.join(parts)}"
    value = next(iter(runs_by_value))
    is_stated = name in recording.constants or any(name in run.constants for run in recording.runs)
    note = "" if is_stated else " (the system's default; not stated)"
    return f"{name} = {value:g}{unit}{note}"


def _format_run_names(names: Sequence[str]) -> str:
    runs = f"run{'s' if len(names) > 1 else ''} {', '.join(names[:_MAX_LISTED_NAMES])}"
    unnamed_count = len(names) - _MAX_LISTED_NAMES
    return f"{runs} and {unnamed_count} more" if unnamed_count > 0 else runs


def _format_count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"


def _align_columns(rows: Sequence[Sequence[str]], left_columns: int) -> Iterator[str]:
    """Align a table as text, with the first `left_columns` columns left-justified."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = zip(row, widths, strict=True)
        aligned = [c.ljust(w) if i < left_columns else c.rjust(w) for i, (c, w) in enumerate(cells)]
        yield "  ".join(aligned).rstrip()
