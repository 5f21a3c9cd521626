"""Tests of the published results, some of older versions: they match their declared form."""

from pathlib import Path

import pytest

from bench.api.comparison_result import ComparisonResult
from bench.benchmark.storage.result_folder import read_checked_comparison

REFERENCE = Path(__file__).parents[3] / "results" / "reference"


@pytest.mark.parametrize(
    "folder",
    [path.parent.relative_to(REFERENCE) for path in sorted(REFERENCE.rglob("runs.parquet"))],
)
def test_published_results_are_sound(folder):
    assert not read_checked_comparison(REFERENCE / folder).runs.empty


def test_a_published_bounce_shot_is_sound():
    shots = ComparisonResult(REFERENCE / "bounce-shot")
    assert len(shots.statuses) == len(shots.runs) == 3600
    assert shots.table["rate"].between(0, 1).all()
