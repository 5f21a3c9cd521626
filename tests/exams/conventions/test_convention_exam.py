"""Tests of conventions in logs from MuJoCo.

Broken conventions are found and corrected, and causes are not mistaken for them.
"""

import math

import numpy as np
import pytest

from bench.cli.main import main
from bench.diagnosis.conventions import convention_comparison
from bench.diagnosis.conventions.convention_comparison import (
    ConventionComparison,
    ConventionDifference,
)
from bench.diagnosis.conventions.convention_hypotheses import ConventionHypothesis
from bench.diagnosis.conventions.corrected_description import (
    correct_description,
    list_changed_tables,
)
from bench.diagnosis.conventions.signal_changes import SignalChange
from bench.diagnosis.conventions.unit_check import Subject
from bench.logs.recording_loading import load_recording
from sims.core.angles_and_quaternions import unwrap_angle
from sims.core.toml_validation import read_toml
from sims.recording.recording_description import read_meta
from tests.exams.conventions.convention_logs import BROKEN, CAUSES, write_log
from tests.malformed_input import valid_input

SEEDS = {
    "sign of position": (12, "the sign of q.j1, qd.j1 looks reversed"),
    "sign of command": (1, "the sign of u.m1 looks reversed"),
    "sign of both": (14, "the axis of joint j0 looks reversed, command and position"),
    "zero of position": (15, "position q.j1 looks counted from another zero"),
    "zero of both": (40, "joint j1 looks counted from another zero, command and position"),
    "unit of one": (5, "the numbers of q.j2 look like degrees, stated as radians"),
    "unit of all": (18, "look like milliradians, stated as radians"),
    "exchanged positions": (7, "the channels of j0, j1 look exchanged"),
    "exchanged commands": (20, "the commands of j1, j2 look exchanged"),
    "exchanged both": (33, "the channels and commands of j0, j1 look exchanged"),
    "wrapped": (10, "position q.j2 looks wrapped: whole turns are left out"),
    "late commands": (23, "commands look stamped 0.03 s late"),
}
"""By convention, the seed of a log that breaks it, and the expected message."""
QUICK = ("exchanged positions",)
"""Conventions of the fast tests."""
SLOW = ("sign of both", "zero of both", "unit of all", "late commands")
"""Conventions of the slow tests; the others differ from these in what they concern."""


def mark(broken):
    """Return a broken convention with the mark of its duration."""
    if broken in QUICK:
        return broken
    return pytest.param(broken, marks=pytest.mark.slow if broken in SLOW else pytest.mark.long)


def check(path):
    recording, kind = load_recording(path)
    return ConventionComparison(Subject(kind, recording, None))


@pytest.mark.parametrize("broken", [mark(broken) for broken in BROKEN])
def test_a_broken_convention_is_found_and_its_correction_leaves_none(broken, tmp_path, capsys):
    seed, message = SEEDS[broken]
    log = write_log(tmp_path / "log", seed, broken)
    fixed = tmp_path / "log" / "fixed.toml"
    command = ["inspect", str(log.path), "--fix", str(fixed), "--out", str(tmp_path / "look")]
    assert main(command) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "convention: " in printed
    assert message in printed
    if broken == "zero of both":
        offset = read_toml(fixed)["channels"]["q.j1"]["offset"]
        assert offset == pytest.approx(-log.size, abs=0.03)
    assert check(fixed.with_suffix(".csv")).differences() == []


def test_explain_refuses_a_log_with_a_broken_convention(tmp_path, capsys):
    (broken,) = QUICK
    seed, message = SEEDS[broken]
    log = write_log(tmp_path / "log", seed, broken)
    assert main(["explain", str(log.path), "--out", str(tmp_path / "out"), "--jobs", "1"]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


# With seed 2002, another zero improves the fit, but less than soft friction does.
CORRECT_LOGS = [*((cause, 2000 + k) for k, cause in enumerate(CAUSES)), ("friction", 2002)]


@pytest.mark.parametrize(("cause", "seed"), CORRECT_LOGS)
def test_a_cause_is_no_broken_convention(cause, seed, tmp_path):
    log = write_log(tmp_path / "log", seed, None, cause)
    assert check(log.path).differences() == []


@pytest.mark.long
def test_of_many_hypotheses_those_that_balance_forces_are_filtered_first(tmp_path):
    """Six joints have more hypotheses than one round filters, and orders are proposed last."""
    log = write_log(tmp_path / "log", 201, "exchanged both")
    (difference,) = check(log.path).differences()
    assert difference.description == "the channels and commands of j2, j5 look exchanged"


def test_a_round_ends_after_a_number_of_filters(tmp_path, monkeypatch):
    (broken,) = QUICK
    log = write_log(tmp_path / "log", SEEDS[broken][0], broken)
    monkeypatch.setattr(convention_comparison, "MAX_EVALUATIONS", 0)
    comparison = check(log.path)
    assert comparison.differences() == []
    # The log as described is compared as a whole and in its two parts for fitting before.
    assert comparison.evaluations == 3
    # The right hypothesis is among the first ones.
    monkeypatch.setattr(convention_comparison, "MAX_EVALUATIONS", 6)
    (difference,) = check(log.path).differences()
    assert difference.description == SEEDS[broken][1]


def test_an_identity_transform_is_no_difference(tmp_path, monkeypatch):
    log = write_log(tmp_path / "log", SEEDS["sign of both"][0], "sign of both")
    monkeypatch.setattr(SignalChange, "applied", lambda change, signals: signals[change.source])
    assert check(log.path).differences() == []


@pytest.mark.long
def test_a_model_that_diverges_between_samples_gives_no_difference(tmp_path):
    """Milliseconds read as seconds: in 20 s an unstable joint exceeds the range of numbers."""
    model = valid_input.ARM.replace(b'name="hip"', b'name="hip" stiffness="-5e4"')
    (tmp_path / "arm.xml").write_bytes(model)
    (tmp_path / "log.csv").write_bytes(valid_input.MAPPED_LOG)
    mapped = {**valid_input.MAPPED, "time": {"column": "stamp"}}
    (tmp_path / "mapped.toml").write_bytes(valid_input.toml(mapped))
    assert check(tmp_path / "mapped.toml").differences() == []


def test_whole_turns_are_unwrapped_towards_the_command():
    angle = np.linspace(2.0, 9.0, 60)
    wrapped = (angle + math.pi) % (2 * math.pi) - math.pi
    wrapped[7] = np.nan
    there = np.isfinite(wrapped)
    assert unwrap_angle(wrapped)[there] == pytest.approx(angle[there])
    later = unwrap_angle(wrapped, command=angle + 4 * math.pi + 0.1)
    assert later[there] == pytest.approx(angle[there] + 4 * math.pi)


def test_the_corrected_description_reads_as_the_change_says(tmp_path):
    """The new keys make -1 times the old value, plus 0.5 rad.

    The log has degrees with a scale and an offset. The joint counts in the opposite direction from
    0.5 rad.
    """
    log = write_log(tmp_path / "log", 2001, None)
    path = log.path.with_suffix(".toml")
    text = path.read_text().replace(
        '[channels."q.j1"]\nunit = "rad"',
        '[channels."q.j1"]\nunit = "deg"\nscale = 2.0\noffset = 3.0',
    )
    path.write_text(text)
    recording, kind = load_recording(log.path)
    before = recording.runs[0].channels["q.j1"]
    change = ConventionHypothesis("", {"q.j1": SignalChange("q.j1", -1.0, 0.5)})
    differences = [ConventionDifference(change, 1.0)]
    _, meta = read_meta(log.path)
    after = correct_description(meta, kind, differences)["channels"]["q.j1"]
    degree = math.pi / 180.0
    raw = before / degree / 2.0 - 3.0 / 2.0
    assert degree * (after["scale"] * raw + after["offset"]) == pytest.approx(0.5 - before)
    assert list(list_changed_tables(meta, kind, differences)) == [
        f'[channels."q.j1"] scale = -2, offset = {0.5 / degree - 3.0:.9g}'
    ]
