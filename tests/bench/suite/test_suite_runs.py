"""Stored runs of a suite, and their union with own runs."""

import numpy as np
import pytest
from pyarrow import parquet

from bench.suite.suite_runs import (
    CURVES_FILE,
    RUN_KEYS,
    concatenate,
    merge_runs,
    read_suite_runs,
    write_suite_runs,
)
from sims.core.simulator import InputError
from tests.bench.suite.synthetic_suite import make_suite, power_law

CURVE = power_law(0.123456789, 1.0)


def test_stored_runs_come_back_with_three_digits(tmp_path):
    failed = np.full(101, np.inf)
    suite = make_suite({"a": {"one": CURVE, "two": failed}, "b": {"one": CURVE}})
    write_suite_runs(suite, tmp_path)
    again = read_suite_runs(tmp_path)
    assert again.runs.to_dict("list") == suite.runs.to_dict("list")
    assert again.errors == pytest.approx(suite.errors, rel=5.01e-3)
    assert again.cells.astype(str).equals(suite.cells.astype(str))
    assert again.version == "suite 1"


def test_a_file_that_states_no_digits_has_four(tmp_path, monkeypatch):
    monkeypatch.setattr("bench.suite.suite_runs._STORED_DIGITS", 4)
    suite = make_suite({"a": {"one": CURVE}})
    write_suite_runs(suite, tmp_path)
    table = parquet.read_table(tmp_path / CURVES_FILE)
    metadata = {key: value for key, value in table.schema.metadata.items() if b"digits" not in key}
    parquet.write_table(table.replace_schema_metadata(metadata), tmp_path / CURVES_FILE)
    monkeypatch.undo()
    assert read_suite_runs(tmp_path).errors == pytest.approx(suite.errors, rel=5.01e-4)


def test_missing_failed_and_vanishing_errors_come_back(tmp_path):
    special = CURVE.copy()
    special[1:5] = 0.0, 1e-150, 9.99996e-7, 12345.0
    special[60:] = np.nan
    write_suite_runs(make_suite({"a": {"one": special}}, targets=1), tmp_path)
    (again,) = read_suite_runs(tmp_path).errors
    assert again[1:5] == pytest.approx([0.0, 0.0, 1e-6, 12300.0], rel=1e-3, abs=1e-12)
    assert np.isnan(again[60:]).all()
    assert np.isfinite(again[:60]).all()


def test_damaged_store_is_one_message(tmp_path):
    (tmp_path / CURVES_FILE).write_bytes(b"nothing")
    with pytest.raises(InputError, match="expected the stored runs of a suite"):
        read_suite_runs(tmp_path)


def test_own_runs_are_joined_by_the_others_on_common_targets():
    own = make_suite({"a": {"mine": CURVE, "one": CURVE * 3}}, targets=6)
    stored = make_suite({"a": {"one": CURVE, "two": CURVE}, "b": {"one": CURVE}}, targets=4)
    merged = merge_runs(own, stored)
    assert set(merged.cells["cell"]) == {"a"}
    assert merged.tuners == ["mine", "one", "two"]
    counts = merged.runs.groupby("tuner")["target"].nunique()
    assert counts.to_dict() == {"mine": 4, "one": 4, "two": 4}
    # The user's own run of a stored method is the one that counts.
    assert merged.errors[(merged.runs["tuner"] == "one").to_numpy()][0, 1] == CURVE[1] * 3


def test_runs_on_other_targets_stay_alone():
    own = make_suite({"c": {"mine": CURVE}})
    assert merge_runs(own, make_suite({"a": {"one": CURVE}})).tuners == ["mine"]


def test_of_a_run_that_occurs_twice_the_first_stays():
    first = make_suite({"a": {"one": CURVE, "two": CURVE}})
    again = make_suite({"a": {"two": CURVE * 2}, "b": {"one": CURVE}})
    joined = concatenate([first, again])
    assert not joined.runs.duplicated(RUN_KEYS).any()
    assert len(joined.errors) == len(joined.runs) == 3 * 4
    is_second = ((joined.runs["cell"] == "a") & (joined.runs["tuner"] == "two")).to_numpy()
    assert joined.errors[is_second][0, 1] == CURVE[1]
