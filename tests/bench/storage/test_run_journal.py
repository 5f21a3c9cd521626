import pickle
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from bench.benchmark.storage.run_journal import (
    JOURNAL_FILE,
    SEGMENTS_FOLDER,
    RunJournal,
    encode_record,
    read_plan,
    read_records,
    read_statuses,
    write_plan,
)
from bench.benchmark.storage.run_status import RunStatus
from sims.core.simulator import InputError


def columns(place, k=3):
    return {
        "run": [f"t/{place}"] * (k + 1),
        "k": np.arange(k + 1),
        "loss": place + np.arange(k + 1) / 7,
    }


def status(place):
    return RunStatus(f"t/{place}", "t", "s", "in-000", 0, "done", f"reason {place}\n\x1b", 3, 0.5)


@pytest.fixture(autouse=True)
def closed(monkeypatch):
    """Close the journals that a test leaves open, as a killed process does."""
    opened = []
    begin = RunJournal.__init__
    monkeypatch.setattr(
        RunJournal, "__init__", lambda self, *a, **k: (opened.append(self), begin(self, *a, **k))[1]
    )
    yield
    for journal in opened:
        if hasattr(journal, "_file"):
            journal.close()


def filled(folder, places):
    journal = RunJournal(folder)
    for place in places:
        journal.append(place, columns(place), status(place))
    return journal


def everything(journal, runs=2000):
    return pa.concat_tables([rows for _, rows in journal.iterate_tables(runs)]).to_pydict()


def expected(places):
    wanted = [columns(p) for p in sorted(places)]
    return {
        name: [x for c in wanted for x in (c[name] if name == "run" else c[name].tolist())]
        for name in wanted[0]
    }


@pytest.mark.parametrize("runs", [1, 3, 2000])
def test_rows_come_back_in_the_order_of_the_plan_bit_for_bit(tmp_path, runs):
    order = [5, 0, 3, 9, 1, 8, 2, 7, 6, 4, 10]
    journal = filled(tmp_path, order)
    assert everything(journal, runs) == expected(order)
    assert [places for places, _ in journal.iterate_tables(4)][1:] == [[4, 5, 6, 7], [8, 9, 10]]


def test_reopened_after_any_cut_it_holds_every_whole_record_and_goes_on(tmp_path):
    filled(tmp_path, [2, 0]).close()
    path = tmp_path / SEGMENTS_FOLDER / JOURNAL_FILE
    data = path.read_bytes()
    ends = [record.end for record in read_records(path)]
    assert ends[-1] == len(data)
    for cut in [0, 1, ends[0] - 1, ends[0], ends[0] + 5, ends[0] + 40, len(data) - 1, len(data)]:
        path.write_bytes(data[:cut])
        journal = RunJournal(tmp_path)
        whole = [place for place, end in zip([2, 0], ends, strict=True) if end <= cut]
        assert list(journal.statuses) == whole
        journal.append(7, columns(7), status(7))
        journal.close()
        again = RunJournal(tmp_path)
        assert everything(again) == expected([*whole, 7])
        assert again.statuses[7] == status(7)
        again.close()


def test_damaged_record_is_dropped_and_its_run_counts_as_missing(tmp_path):
    filled(tmp_path, [0, 1]).close()
    path = tmp_path / SEGMENTS_FOLDER / JOURNAL_FILE
    data = bytearray(path.read_bytes())
    data[-10] ^= 1
    path.write_bytes(data)
    journal = RunJournal(tmp_path)
    assert list(journal.statuses) == [0]
    journal.close()
    # Before other records it is no consequence of a kill, and nothing is deleted.
    data[60] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"{JOURNAL_FILE}: expected a record before byte"):
        RunJournal(tmp_path)
    assert path.read_bytes() == data


def test_zeros_that_a_crash_of_the_machine_left_are_dropped(tmp_path):
    filled(tmp_path, [0]).close()
    path = tmp_path / SEGMENTS_FOLDER / JOURNAL_FILE
    whole = path.read_bytes()
    path.write_bytes(whole + bytes(5000))
    journal = RunJournal(tmp_path)
    assert list(journal.statuses) == [0]
    assert path.read_bytes() == whole


@pytest.mark.parametrize("name", ["000001.journal", "000001.parquet"])
def test_runs_of_an_earlier_version_are_not_repeated_unasked(tmp_path, name):
    (tmp_path / SEGMENTS_FOLDER).mkdir()
    (tmp_path / SEGMENTS_FOLDER / name).write_bytes(b"run\n")
    for read in (RunJournal, read_statuses):
        with pytest.raises(InputError, match=f"{name}: expected .* earlier version"):
            read(tmp_path)
    assert {path.name for path in (tmp_path / SEGMENTS_FOLDER).iterdir()} == {name}


def test_two_processes_never_write_one_folder(tmp_path):
    journal = RunJournal(tmp_path)
    with pytest.raises(InputError, match="another simgap process uses"):
        RunJournal(tmp_path)
    journal.close()
    RunJournal(tmp_path).close()


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (lambda: encode_record(0, status(0), pa.table(columns(0))), "every run once, found that"),
        (lambda: encode_record(-1, status(9), pa.table(columns(9))), "place in the plan: expected"),
        (lambda: encode_record(9, replace(status(9), seed="x"), pa.table(columns(9))), "seed: exp"),
    ],
)
def test_damaged_status_is_one_line(tmp_path, record, words):
    filled(tmp_path, range(4)).close()
    path = tmp_path / SEGMENTS_FOLDER / JOURNAL_FILE
    path.write_bytes(path.read_bytes() + record())
    with pytest.raises(InputError, match=f"{JOURNAL_FILE}: expected .*{words}") as caught:
        RunJournal(tmp_path)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=words):
        read_statuses(tmp_path)
    # The lock was released.
    path.unlink()
    RunJournal(tmp_path).close()


def test_statuses_of_a_folder_that_is_being_written(tmp_path):
    journal = filled(tmp_path, range(6))
    assert sorted(read_statuses(tmp_path)) == list(range(6))
    assert read_statuses(tmp_path)[5] == status(5)
    journal.delete_segments()
    assert read_statuses(tmp_path) == {}
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_ever_unpickled(tmp_path):
    (tmp_path / SEGMENTS_FOLDER).mkdir()
    (tmp_path / SEGMENTS_FOLDER / JOURNAL_FILE).write_bytes(pickle.dumps({"run": 1}))
    with pytest.raises(InputError, match="found damage"):
        RunJournal(tmp_path)


def test_plan(tmp_path):
    (tmp_path / SEGMENTS_FOLDER).mkdir()
    assert read_plan(tmp_path) is None
    write_plan(tmp_path, ["a/in-000/0/12", "b/in-000/0/34"])
    assert read_plan(tmp_path) == ["a/in-000/0/12", "b/in-000/0/34"]
