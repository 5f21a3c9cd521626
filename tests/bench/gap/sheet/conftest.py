"""One recording with known numbers, explained once, and its sheet."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.api.datasheet import datasheet
from bench.api.explain import explain
from bench.gap.explanation import Explanation
from bench.gap.sheet.sheet import DataSheet
from tests.bench.gap.sheet.drives import written


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="session")
def explained(log: Path) -> Explanation:
    return explain(log, jobs=1)


@pytest.fixture(scope="session")
def sheet(log: Path, explained: Explanation) -> DataSheet:
    return datasheet(log, explained=explained, name="servo <i>one</i>")
