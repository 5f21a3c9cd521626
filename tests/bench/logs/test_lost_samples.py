"""Tests of samples that a logger has lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.logs.lost_samples import fill_lost_commands
from sims.recording.recording import Recording, Run

RNG = np.random.default_rng(3)


def run():
    """Return a run of 4 s at 100 Hz with a slow channel and a ramp as its input."""
    times = np.arange(401) / 100
    values = np.sin(2.0 * np.pi * 1.5 * times) + 1e-4 * RNG.standard_normal(times.size)
    return Run("1", times, {"q": values}, {"u": 2.0 * times}, {}, {}, False)


def recording(*runs):
    return Recording(Path("log.csv"), "robot", "", {}, {}, tuple(runs))


def without(run, rows):
    """Return a run without some rows, as after a logger lost them."""
    rest = np.delete(np.arange(run.times.size), rows)
    return replace(
        run,
        times=run.times[rest],
        channels={name: values[rest] for name, values in run.channels.items()},
        inputs={name: values[rest] for name, values in run.inputs.items()},
        extra={"on": np.arange(rest.size, dtype=float)},
        off={"m": np.arange(rest.size) >= 20},
    )


def test_commands_of_lost_rows_are_interpolated():
    whole = run()
    whole = replace(whole, inputs={"u": np.square(whole.times)})
    found, note = fill_lost_commands(recording(without(whole, [7, 20, 21, 22])))
    (filled,) = found.runs
    assert note.startswith("4 commands")
    assert filled.times == pytest.approx(whole.times)
    assert np.flatnonzero(np.isnan(filled.channels["q"])).tolist() == [7, 20, 21, 22]
    # A chord of the parabola is off by (t - a) (b - t) between its neighbours a and b.
    error = np.abs(filled.inputs["u"] - np.square(whole.times))
    assert (error[[7, 20, 21, 22]] < 0.4 * np.array([1e-4, 3e-4, 4e-4, 3e-4])).all()
    assert filled.extra["on"][[6, 7, 8]].tolist() == [6, 6, 7]
    assert filled.off["m"].sum() == filled.times.size - np.argmax(filled.off["m"])


def test_an_interpolated_command_does_not_overshoot_a_jump():
    whole = replace(run(), inputs={"u": (np.arange(401) >= 8).astype(float)})
    found, _ = fill_lost_commands(recording(without(whole, [7, 20])))
    command = found.runs[0].inputs["u"]
    assert (command >= 0.0).all()
    assert (command <= 1.0).all()
    assert 0.2 < command[7] < 0.8
    assert command[20] == 1.0


@pytest.mark.parametrize("case", ["long gap", "jitter", "no input", "whole"])
def test_other_gaps_stay(case):
    rows = {"long gap": range(10, 17), "whole": []}.get(case, [10])
    log = without(run(), list(rows))
    if case == "jitter":
        log = replace(log, times=np.sort(log.times + 1e-3 * RNG.standard_normal(log.times.size)))
    elif case == "no input":
        log = replace(log, inputs={})
    given = recording(log)
    assert fill_lost_commands(given) == (given, "")
