"""Tests that published cases stay as they were: everything follows from the name of a case.

`published_cases.json` has hidden coefficients and RMS readings of a case of each kind and system.
They are compared up to rounding errors, because processors differ in the last bits.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from bench.diagnosis_benchmark.case_set import draw_case, render_recording

PUBLISHED = json.loads(Path(__file__).with_name("published_cases.json").read_text())

LONG = ("single/servo/friction.stribeck/3", "foreign/servo/gust/3", "single/arm2/input.lag/3")
"""Cases that take more than five seconds."""


def measure(kind, system, effect, seed):
    """Return hidden coefficients by effect, and RMS values by column of the recording."""
    case = draw_case(kind, system, seed, effect or None)
    rows = list(csv.DictReader(render_recording(case).table.splitlines()))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    sizes = {name: float(np.sqrt(np.mean(values**2))) for name, values in columns.items()}
    return {name: list(c) for name, c in case.effects.items()}, sizes


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.long] if name in LONG else []) for name in PUBLISHED],
)
def test_a_published_case_is_drawn_as_before(name):
    kind, system, effect, seed = name.split("/")
    effects, sizes = measure(kind, system, effect, int(seed))
    expected = PUBLISHED[name]
    assert list(effects) == list(expected["effects"])
    for effect, c in effects.items():
        assert c == pytest.approx(expected["effects"][effect], rel=1e-5)
    assert sizes == pytest.approx(expected["sizes"], rel=1e-5)
