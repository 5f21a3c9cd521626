"""Tests that the data sheet of a joint without a drive has no rows of a drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomllib

from bench.api.datasheet import datasheet
from bench.core.plugin_registries import simulators
from bench.diagnosis.datasheet import datasheet_figure
from bench.diagnosis.datasheet.datasheet import DataSheet
from bench.diagnosis.datasheet.datasheet_joint import make_subject
from bench.figures.figure_layout import apply_settings
from tests.bench.diagnosis.explained_samples import recording
from tests.bench.figures.figure_readability import unreadable
from tests.command_output import run_command

FRICTION = 0.004
"""Dry friction in N m."""


@pytest.fixture(scope="module")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a recording of a released pendulum that dry friction stops; return its path."""
    folder = tmp_path_factory.mktemp("free")
    command = ["simulate", "pendulum", "--effect", f"friction.coulomb={FRICTION}"]
    command += ["--noise", "q=0.003", "qd=0.02", "--runs", "3", "--seconds", "1.5", "--rate", "60"]
    run_command(*command, "--out", folder / "swing.csv")
    command = ["datasheet", str(folder / "swing.csv"), "--out", str(folder / "sheet")]
    run_command(*command)
    return folder


def test_there_is_no_drive_and_no_diagram_in_any_file(swing: Path) -> None:
    document = tomllib.loads((swing / "sheet" / "sheet.toml").read_text())
    assert "diagram" not in document
    assert document["rest"]["laws"] == ["friction.coulomb"]
    assert document["rest"]["breakaway"] == pytest.approx(FRICTION, rel=0.1)
    quantities = document["quantities"]
    assert "friction.coulomb" in quantities
    parts = {row["part"] for row in quantities.values()}
    assert parts == {"system", "joint", "channel"}, "nothing is said of an actuator"
    for name in ("input.bias", "backlash", "joint.backlash", "joint.flexibility", "state.limit"):
        assert name not in quantities
    page = (swing / "sheet" / "sheet.html").read_text()
    assert "There is no drive: the log has no input." in page
    assert "At rest, dry friction holds loads up to 0.00" in page
    for words in ("Motor", "moves forward", "force of the motor", "Drive and back-drive"):
        assert words not in page


def test_the_printed_page_says_it_too_and_can_be_read(swing: Path) -> None:
    made = datasheet(swing / "swing.csv", explained=swing / "sheet" / "explained")
    with apply_settings(datasheet_figure.STYLE):
        page = datasheet_figure.draw_sheet(made)
        assert unreadable(page) == []
    assert not page.axes, "no diagram is drawn"
    words = " ".join(text.get_text() for text in page.texts)
    assert "There is no drive" in words.replace("\n", " ")


def test_a_driven_joint_has_its_diagram_and_a_page_that_can_be_read(sheet: DataSheet) -> None:
    assert sheet.is_driven
    assert "diagram" in sheet.document()
    with apply_settings(datasheet_figure.STYLE):
        page = datasheet_figure.draw_sheet(sheet)
        assert unreadable(page) == []
    assert len(page.axes) == 1


@pytest.mark.parametrize(("torque", "is_driven"), [(None, False), (0.0, False), (0.1, True)])
def test_an_input_that_is_always_zero_is_no_drive(torque: float | None, is_driven: bool) -> None:
    made = recording(runs=2, seconds=0.5, rate=50.0)
    if torque is not None:
        signal = np.full(len(made.runs[0].times), torque)
        runs = tuple(replace(run, inputs={"u": signal}) for run in made.runs)
        made = replace(made, runs=runs)
    assert make_subject(simulators.get("pendulum"), None).is_driven(made) is is_driven
