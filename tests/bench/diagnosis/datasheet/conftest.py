"""Fixtures of one recording with known parameters, its explanation and its data sheet."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.api.datasheet import datasheet
from bench.api.explain import explain
from bench.diagnosis.datasheet.datasheet import DataSheet
from bench.diagnosis.explanation import Explanation
from sims import extended_simulator
from tests.bench.diagnosis.datasheet.drive_recordings import written
from tests.command_output import run_command

NAME = "servo <i>one</i>"


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="session")
def explained(log: Path) -> Explanation:
    return explain(log, jobs=1)


@pytest.fixture(scope="session")
def sheet(log: Path, explained: Explanation) -> DataSheet:
    return datasheet(log, explained=explained, name=NAME)


@pytest.fixture(scope="session")
def files(log: Path, explained: Explanation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that the datasheet command writes from a saved explanation."""
    folder = tmp_path_factory.mktemp("made")
    # The command reads only these two files; to draw the figures as well would take seconds.
    (folder / "verdict.json").write_text(json.dumps(explained.answer.to_document()))
    extended_simulator.write_extended(explained.extended, folder / "extended.toml")
    given = ["--from", str(folder), "--name", NAME, "--out", str(folder / "sheet")]
    run_command("datasheet", log, *given)
    return folder / "sheet"
