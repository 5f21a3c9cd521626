"""Tests of the data sheet of a servo with known parameters."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomllib

from bench.api.datasheet import datasheet
from bench.diagnosis.datasheet.datasheet import DataSheet
from bench.diagnosis.datasheet.datasheet_content import SheetRow
from bench.diagnosis.datasheet.datasheet_mjcf import build_mjcf
from bench.diagnosis.explanation import Explanation
from sims import extended_simulator
from sims.core.simulator import InputError
from tests.bench.diagnosis.datasheet.drive_recordings import (
    CONSTANTS,
    FRICTION,
    NOISE,
    SAMPLES,
    TRUE_PARAMETERS,
)
from tests.command_output import run_command


def row(sheet: DataSheet, name: str) -> SheetRow:
    return next(row for row in sheet.rows if row.name == name)


def test_what_was_put_in_lies_within_the_intervals(sheet: DataSheet) -> None:
    stall = TRUE_PARAMETERS["torque_constant"] / TRUE_PARAMETERS["resistance"]
    truth = {
        **TRUE_PARAMETERS,
        "friction.coulomb": FRICTION,
        "torque constant over resistance": stall,
        "back-EMF damping": stall * TRUE_PARAMETERS["torque_constant"],
        "stall torque": stall * CONSTANTS["voltage"],
        "free speed": CONSTANTS["voltage"] / TRUE_PARAMETERS["torque_constant"],
    }
    assert sheet.verdict.verdict == "named"
    shown = {row.name: row.number for row in sheet.rows if row.number is not None}
    assert set(shown) == set(truth)
    for name, value in truth.items():
        number = shown[name]
        assert number.low is not None
        assert number.high is not None
        assert number.low <= value <= number.high, name
        # Without this limit, an arbitrarily wide interval would pass the test.
        assert number.high - number.low < 0.1 * abs(value), name


def test_a_ratio_is_known_better_than_its_parts(sheet: DataSheet) -> None:
    def width(name: str) -> float:
        number = row(sheet, name).number
        assert number is not None
        assert number.low is not None
        assert number.high is not None
        return (number.high - number.low) / number.value

    # The data determine the torque per volt, so the errors of its two factors are correlated.
    assert width("torque constant over resistance") < 0.5 * width("resistance")


def test_what_is_not_there_is_not_shown_within_what_these_data_resolve(sheet: DataSheet) -> None:
    absent = [row for row in sheet.rows if row.number is None]
    names = {row.name for row in absent}
    assert {"drag.linear", "servo.deadband", "input.delay", "sensor.bias", "backlash"} <= names
    # The Coulomb part of a richer law is the friction already found, so it is listed only once.
    assert "friction.stribeck coulomb" not in names
    leaning = [
        row.name
        for row in absent
        if row.detection_limit and row.detection_limit.is_nonzero_if_fitted
    ]
    # On average, one in 20 absent effects has an interval that excludes zero.
    assert len(leaning) <= 0.2 * len(absent)


def test_the_terminal_names_few_of_the_effects_that_are_not_shown(sheet: DataSheet) -> None:
    hidden = [row.name for row in sheet.rows if row.number is None]
    (line,) = [line for line in sheet.lines() if line.startswith("not detected")]
    assert len(hidden) > 5
    named, _, more = line.partition(": ")[2].partition(" and ")
    assert named.split(", ") == hidden[:5]
    assert more.startswith(f"{len(hidden) - 5} more")


def test_what_the_data_resolve_is_what_least_squares_says(sheet: DataSheet) -> None:
    """The detection limit of a sensor bias is between 1 and 30 times the half width of a mean.

    The motion determines the bias by gravity, which has little effect here.
    """
    reach = row(sheet, "sensor.bias").detection_limit
    assert reach is not None
    mean = 1.96 * NOISE / np.sqrt(3 * SAMPLES)
    assert mean < reach.size < 30 * mean


def test_drag_cannot_be_distinguished_from_that_of_the_motor(sheet: DataSheet) -> None:
    """Any drag c fits the data if kt and R keep kt / R and kt^2 / R + c constant."""
    reach = row(sheet, "drag.linear").detection_limit
    assert reach is not None
    assert {"torque_constant", "resistance"} <= set(reach.confounded_with)
    assert reach.size > 0.05
    assert reach.is_unbounded


def test_gaps_show_from_a_size_on_and_limits_up_to_one(sheet: DataSheet) -> None:
    dead, band = (
        row(sheet, "servo.deadband").detection_limit,
        row(sheet, "input.deadband").detection_limit,
    )
    clipped, slow = (
        row(sheet, "input.saturation").detection_limit,
        row(sheet, "input.rate").detection_limit,
    )
    assert dead is not None
    assert band is not None
    assert clipped is not None
    assert slow is not None
    # Friction stops the arm up to 0.17 rad from its goal, so a dead zone of a tenth of this is
    # visible.
    assert dead.limit == band.limit == "above"
    assert 0 < dead.size < 0.02
    assert 0 < band.size < 0.05
    # Commands reach 1.5 rad and contain steps, so any rate limit would be visible.
    assert clipped.limit == slow.limit == "below"
    assert 1.0 < clipped.size < 1.5
    assert slow.size > 10


def test_what_another_run_may_say_is_no_less_than_what_these_say(sheet: DataSheet) -> None:
    for name in (*TRUE_PARAMETERS, "friction.coulomb"):
        found = row(sheet, name)
        assert found.number is not None
        assert found.number.low is not None
        assert found.prediction_half_width is not None
        half = found.number.value - found.number.low
        # Both fitted runs are of one servo, so they differ by little more than their noise.
        assert half * 0.999 < found.prediction_half_width < 5 * half


def test_the_files_say_the_same_and_are_safe(files: Path, sheet: DataSheet) -> None:
    stated = tomllib.loads((files / "sheet.toml").read_text())
    # The file is made from the saved explanation, the fixture from the one in memory.
    assert stated == sheet.document()
    friction = stated["quantities"]["friction.coulomb"]
    assert friction["state"] == "found"
    assert friction["unit"] == "N*m"
    assert friction["low"] <= FRICTION <= friction["high"]
    assert friction["p_value"] < 1e-6
    load = stated["quantities"]["friction.load"]
    assert load["state"] == "not shown"
    assert 0 < load["resolved"] < 0.2
    assert "value" not in load
    html = (files / "sheet.html").read_text()
    assert "<b>servo" not in html
    assert "<i>one" not in html
    assert "&lt;b&gt;servo" in html
    assert "friction.stribeck" in html
    assert (files / "sheet.pdf").read_bytes().count(b"/Type /Page ") == 1


def test_faults_are_one_line(log: Path, explained: Explanation, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="name a folder that simgap explain has written"):
        datasheet(log, explained=tmp_path)
    (tmp_path / "verdict.json").write_text("[]")
    with pytest.raises(InputError, match="expected a verdict of simgap explain"):
        datasheet(log, explained=tmp_path)
    with pytest.raises(InputError, match="expected none, as servo is no robot; found elbow"):
        datasheet(log, explained=explained, joint="elbow")


@pytest.mark.parametrize(
    ("key", "value"),
    [("p_value", "x"), ("effect", 3), ("alternatives", 1), ("coefficients", []), ("verdict", "so")],
)
def test_a_damaged_verdict_is_refused(
    log: Path, explained: Explanation, tmp_path: Path, key: str, value: object
) -> None:
    document = explained.answer.to_document()
    (document if key in document else document["causes"][0])[key] = value
    (tmp_path / "verdict.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=f"expected a verdict of simgap explain; .*{key}"):
        datasheet(log, explained=tmp_path)


def test_numbers_that_a_model_does_not_state_are_nominal(
    log: Path, explained: Explanation, tmp_path: Path
) -> None:
    (tmp_path / "verdict.json").write_text(json.dumps(explained.answer.to_document()))
    empty = replace(explained.extended, parameters={}, effects={"friction.coulomb": {}})
    extended_simulator.write_extended(empty, tmp_path / "extended.toml")
    bare = datasheet(log, explained=tmp_path)
    number = row(bare, "armature").number
    assert number is not None
    assert (number.value, number.low) == (2e-3, None)
    assert build_mjcf(bare, tmp_path).contents["model.xml"].count("frictionloss") == 0


def test_an_unknown_joint_is_refused_before_the_search(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "sheet"
    assert (
        run_command("datasheet", log, "--joint", "elbow", "--out", out, code=2).err.count("\n") == 1
    )
    assert not out.exists()
