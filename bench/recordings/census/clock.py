"""The clock of a recording: intervals that vary, samples that are lost, samples that came twice."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.recordings.census.finding import Finding, named
from sims.base import Array
from sims.recording.recording import Recording, Run

JITTER = 0.02
"""Of an interval, 1 sigma: jitter that is told."""
LOST = 0.002
"""Share of samples that are lost, or came twice, from which on it is told."""
WHOLE = 0.3
"""Of an interval: what is so near to several whole ones has lost the samples between."""
FAST = 5.0
"""Steps of a signal from sample to sample: so fast it cannot stay where it was by chance."""
SURE = 4.0
"""Standard deviations beyond chance."""
_MAD = 1.4826


def intervals(recording: Recording) -> Iterator[Finding]:
    """Jitter and lost samples, each over all runs."""
    jittered, rests, lost, whole, lossy = [], [], 0, 0, []
    for run in recording.runs:
        steps = np.diff(_stamps(run))
        if steps.size < 2:
            continue
        ratios = steps / np.median(steps)
        counts = np.maximum(np.round(ratios), 1.0)
        own = ratios - counts
        jitter = _MAD * float(np.median(np.abs(own - np.median(own))))
        rests.append(jitter)
        if jitter > JITTER:
            jittered.append(run.name)
        gone = int((counts - 1)[np.abs(own) < max(WHOLE, 3.0 * jitter)].sum())
        # Where the clock jitters much a long interval is lost only if no short one makes up for it.
        gone = min(gone, max(int(ratios.sum()) - steps.size, 0))
        if gone < SURE * jitter * steps.size**0.5:
            gone = 0
        lost, whole = lost + gone, whole + steps.size + gone
        if gone:
            lossy.append(run.name)
    if jittered:
        yield Finding(
            "clock",
            f"intervals vary by {max(rests):.0%} of one (1 sigma) in {named(jittered)}",
            "every sample is simulated at its own stamp, so let the stamps be those of measuring "
            "and not of writing",
        )
    if whole and lost > LOST * whole:
        yield Finding(
            "clock",
            f"{lost} samples ({lost / whole:.1%}) are lost in {named(lossy)}",
            "nothing is filled in, but a command that changed in between is not known: log "
            "commands in a file of their own, or at a lower rate",
        )


def _stamps(run: Run) -> Array:
    """When the sensor was read that was read most often: among the instants of a run are those of
    commands and of other sensors, which have clocks of their own. All instants where these are as
    even: then what the sensor has not is empty cells.
    """
    seen = [np.isfinite(values) for values in run.channels.values()]
    often = max(seen, key=lambda one: int(one.sum()), default=np.ones(run.times.size, np.bool_))
    own = run.times[often]
    return run.times if _uneven(run.times) <= _uneven(own) else own


def _uneven(times: Array) -> float:
    """Share of the steps that are not as long as most are."""
    steps = np.diff(times)
    if not steps.size:
        return 1.0
    usual = float(np.median(steps))
    return float(np.mean(np.abs(steps - usual) > 0.01 * usual))


def repeated(recording: Recording) -> Iterator[Finding]:
    """Samples that repeat the one before, in every channel at once, while the motion goes on."""
    found, there, runs = 0, 0, []
    for run in recording.runs:
        count, expected = _stale(run)
        if count > expected + SURE * np.sqrt(max(expected, 1.0)):
            found += count
            runs.append(run.name)
        there += run.times.size
    if found > LOST * there:
        yield Finding(
            "clock",
            f"{found} samples ({found / there:.1%}) repeat the one before in every channel while "
            f"it moves, in {named(runs)}",
            "leave these rows out: a value that is old by an interval passes for a delay",
        )


def _stale(run: Run) -> tuple[int, float]:
    """Samples that are as the one before amid fast motion, and how many are so by chance."""
    signals = [values for values in run.channels.values() if np.isfinite(values).sum() > 3]
    if not signals or run.times.size < 4:
        return 0, 0.0
    changes = np.array([_in_steps(values) for values in signals])
    same = np.nan_to_num(changes, nan=0.0) == 0
    around = np.maximum(np.abs(changes[:, :-2]), np.abs(changes[:, 2:]))
    moving = np.nan_to_num(np.max(around, axis=0, initial=0.0), nan=0.0) >= FAST
    stale = same.all(axis=0)[1:-1] & moving
    # Noise of several steps stays where it was half as often as it goes one step either way.
    near = (np.abs(np.nan_to_num(changes, nan=9.0)) < 1.5).all(axis=0)[1:-1] & moving
    one = int(near.sum()) - int(stale.sum())
    return int(stale.sum()), one / max(3.0 ** len(signals) - 1.0, 1.0)


def _in_steps(values: Array) -> Array:
    """(T - 1,) changes in units of the signal's smallest one."""
    changes = np.diff(values)
    sizes = np.abs(changes[np.isfinite(changes)])
    moving = sizes[sizes > 1e-9 * np.max(sizes, initial=0.0)]
    if not moving.size:
        return np.zeros_like(changes)
    # Of a signal without steps the smallest change is a tiny one, and all is fast against it.
    return np.asarray(np.round(changes / moving.min()), dtype=np.float64)
