import pickle

import numpy as np
import pyarrow as pa
import pytest

from bench.benchmark.storage.run_journal import (
    SEGMENTS_FOLDER,
    RunJournal,
    read_plan,
    read_records,
    write_plan,
)
from bench.benchmark.storage.run_status import RunStatus
from sims.core.simulator import InputError
from tests.finished_statuses import read_finished_statuses


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


def filled(folder, places, part_runs=4):
    journal = RunJournal(folder, part_runs)
    for place in places:
        journal.append(place, columns(place), status(place))
    return journal


def everything(journal, runs=2000):
    return pa.concat_tables(list(journal.iterate_tables(runs))).to_pydict()


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
    assert len(list((tmp_path / SEGMENTS_FOLDER).glob("*.parquet"))) == 2
    assert everything(journal, runs) == expected(order)


def test_reopened_after_any_cut_it_holds_every_whole_record_and_goes_on(tmp_path):
    filled(tmp_path, [2, 0], part_runs=100).close()
    path = tmp_path / SEGMENTS_FOLDER / "000001.journal"
    data = path.read_bytes()
    ends = [end for *_, end in read_records(path)]
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
    filled(tmp_path, [0, 1], part_runs=100).close()
    path = tmp_path / SEGMENTS_FOLDER / "000001.journal"
    data = bytearray(path.read_bytes())
    data[-10] ^= 1
    path.write_bytes(data)
    assert list(RunJournal(tmp_path).statuses) == [0]


def test_killed_between_the_part_and_the_deletion_of_its_journal_doubles_nothing(tmp_path):
    filled(tmp_path, [0, 1, 2], part_runs=100).close()
    kept = (tmp_path / SEGMENTS_FOLDER / "000001.journal").read_bytes()
    journal = RunJournal(tmp_path, part_runs=4)
    journal.append(3, columns(3), status(3))
    journal.close()
    assert not (tmp_path / SEGMENTS_FOLDER / "000001.journal").exists()
    (tmp_path / SEGMENTS_FOLDER / "000001.journal").write_bytes(kept)
    # The next journal is started only after that deletion, so it does not exist yet.
    (tmp_path / SEGMENTS_FOLDER / "000002.journal").unlink()
    (tmp_path / SEGMENTS_FOLDER / "000002.partial").write_bytes(b"half a part")
    again = RunJournal(tmp_path)
    assert everything(again) == expected([0, 1, 2, 3])
    again.close()
    assert sorted(read_finished_statuses(tmp_path)) == [0, 1, 2, 3]


def test_two_processes_never_write_one_folder(tmp_path):
    journal = RunJournal(tmp_path)
    with pytest.raises(InputError, match="another simgap process uses"):
        RunJournal(tmp_path)
    journal.close()
    RunJournal(tmp_path).close()


def test_damaged_part_is_one_line(tmp_path):
    filled(tmp_path, range(4)).close()
    path = tmp_path / SEGMENTS_FOLDER / "000001.parquet"
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(
        InputError, match=r"000001.parquet: expected a part of a comparison, found damage"
    ) as caught:
        RunJournal(tmp_path)
    assert "\n" not in str(caught.value)


def test_statuses_of_a_folder_that_is_being_written(tmp_path):
    journal = filled(tmp_path, range(6))
    assert sorted(read_finished_statuses(tmp_path)) == list(range(6))
    assert read_finished_statuses(tmp_path)[5] == status(5)
    journal.delete_segments()
    assert read_finished_statuses(tmp_path) == {}
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_ever_unpickled(tmp_path):
    (tmp_path / SEGMENTS_FOLDER).mkdir()
    (tmp_path / SEGMENTS_FOLDER / "000001.journal").write_bytes(pickle.dumps({"run": 1}))
    assert RunJournal(tmp_path).statuses == {}


def test_plan(tmp_path):
    (tmp_path / SEGMENTS_FOLDER).mkdir()
    assert read_plan(tmp_path) is None
    write_plan(tmp_path, ["a/in-000/0/12", "b/in-000/0/34"])
    assert read_plan(tmp_path) == ["a/in-000/0/12", "b/in-000/0/34"]
