import os

import pytest

from sims.core import files
from sims.core.simulator import InputError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_whole_and_nothing_stays_next_to_it(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    files.write_atomically(path, "π")
    assert path.read_text(encoding="utf-8") == "π"
    files.write_atomically(path, b"\x00")
    assert path.read_bytes() == b"\x00"
    assert names(tmp_path) == ["a.txt"]


def test_what_fails_leaves_the_old_file_and_no_half_one(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")

    def half():
        with files.atomic_replacement(path) as partial:
            partial.write_text("ne")
            assert path.read_text() == "old", "a reader meets the old file until the new is whole"
            assert list(tmp_path.glob("*.csv")) == [path], "who lists files takes it for none"
            raise RuntimeError("half")

    with pytest.raises(RuntimeError, match="half"):
        half()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.csv"]
    with files.atomic_replacement(path, keep_ending=True) as partial:
        assert partial.suffix == ".csv"
        partial.write_text("new")
    assert path.read_text() == "new"


def test_content_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    steps = []
    sync, replace = os.fsync, files.Path.replace
    monkeypatch.setattr(os, "fsync", lambda n: (steps.append("disk"), sync(n))[1])
    monkeypatch.setattr(
        files.Path, "replace", lambda a, b: (steps.append("name"), replace(a, b))[1]
    )
    files.write_atomically(tmp_path / "a", "x")
    assert steps == ["disk", "name"]


def test_new_files_are_all_written_or_none_and_never_over_another(tmp_path):
    there = tmp_path / "b"
    there.write_text("mine")
    with pytest.raises(FileExistsError) as error:
        files.write_new_files({tmp_path / "a": "1", there: "2"})
    assert error.value.filename == str(there)
    assert names(tmp_path) == ["b"]
    assert there.read_text() == "mine"
    missing = tmp_path / "no" / "folder"
    with pytest.raises(OSError, match="No such file") as fault:
        files.write_new_files({tmp_path / "a": "1", missing: "2"})
    assert fault.value.filename == str(missing)
    assert names(tmp_path) == ["b"]
    files.write_new_files({tmp_path / "a": "1", tmp_path / "c": b"3"})
    assert names(tmp_path) == ["a", "b", "c"]


def test_without_hard_links_nothing_is_overwritten_either(tmp_path, monkeypatch):
    def refused(*_):
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refused)
    files.write_new_files({tmp_path / "a": "1"})
    with pytest.raises(FileExistsError):
        files.write_new_files({tmp_path / "a": "2"})
    assert (tmp_path / "a").read_text() == "1"
    assert names(tmp_path) == ["a"]


def test_a_folder_is_made_whole_or_not_at_all_and_only_where_nothing_is(tmp_path):
    folder = tmp_path / "deep" / "results"

    def half():
        with files.atomic_new_folder(folder) as partial:
            (partial / "x").write_text("1")
            raise RuntimeError("half")

    with pytest.raises(RuntimeError, match="half"):
        half()
    assert not list((tmp_path / "deep").iterdir())
    folder.mkdir()
    with files.atomic_new_folder(folder) as partial:
        (partial / "x").write_text("1")
        assert not list(folder.iterdir())
    assert names(folder) == ["x"]
    with (
        pytest.raises(OSError, match="not empty"),
        files.atomic_new_folder(folder) as partial,
    ):
        (partial / "y").write_text("2")
    assert names(folder) == ["x"]
    assert names(tmp_path / "deep") == ["results"]


def test_full_folders_are_refused_and_new_ones_get_a_name_of_their_own(tmp_path):
    files.check_folder_empty(tmp_path)
    files.check_folder_empty(tmp_path / "nowhere")
    one = files.make_timestamped_path(tmp_path, "x")
    one.mkdir()
    two = files.make_timestamped_path(tmp_path, "x")
    assert two != one
    with pytest.raises(InputError, match="exists and is not empty"):
        files.check_folder_empty(tmp_path)
    (one / "file").write_text("")
    with pytest.raises(InputError, match="exists and is not empty"):
        files.check_folder_empty(one / "file")


def test_first_line_of_an_error():
    assert files.get_first_line(ValueError("\n one\ntwo")) == "one"
    assert files.get_first_line(KeyboardInterrupt()) == "KeyboardInterrupt"
