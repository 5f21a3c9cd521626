"""Tests of archives: they hold the whole folder, and each later change is detected."""

import hashlib
import json
import shutil
import stat
import struct
import zipfile
from types import SimpleNamespace

import pytest
import tomli_w

from bench.studies import archive_bundle as archives
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import undrawn

PLUGIN = ["--plugin", str(PLUGINS / "spring.py")]
CENTRAL = b"PK\x01\x02\x14\x03\x14\0"
"""First bytes of an entry of the central directory, up to its flags."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Folder with a small comparison, a recording and its explanation."""
    folder = tmp_path_factory.mktemp("bundle")
    document = {**SPRING, "salt": "", "targets": 2, "seeds": 1, "budget": 3, "tuners": ["random"]}
    (folder / "small.toml").write_text(tomli_w.dumps(document))
    command = ["compare", str(folder / "small.toml"), *PLUGIN, "--jobs", "1", "--salt", "a secret"]
    with undrawn():
        run_command(*command, "--out", folder / "run")
    log = folder / "swing.csv"
    command = ["simulate", "pendulum", "--effect", "drag.linear=4e-4", "--noise", "q=0.01"]
    run_command(
        *command, "--observe", "q", "--runs", "2", "--seconds", "2", "--rate", "50", "--out", log
    )
    run_command("explain", log, "--jobs", "1", "--out", folder / "told")
    return folder


@pytest.fixture(scope="module")
def compared(place):
    """Archive of the comparison."""
    run_command("bundle", place / "run", "--out", place / "run.zip")
    return place / "run.zip"


@pytest.fixture(scope="module")
def explanation_archive(place):
    """Archive of the explanation with its recording."""
    command = ["bundle", str(place / "told"), "--with", str(place / "swing.csv")]
    run_command(*command, "--out", place / "told.zip")
    return place / "told.zip"


def verified(archive, code=0):
    """Return the document that the verification of an archive or folder prints."""
    return json.loads(run_command("verify", archive, *PLUGIN, "--json", code=code).out)


def content(archive):
    """Return the contents of an archive by name."""
    with zipfile.ZipFile(archive) as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def packed(path, files, entries=()):
    """Write an archive with files and with `entries` that are not regular files."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for name, data in files.items():
            made.writestr(name, data)
        for entry, data in entries:
            made.writestr(entry, data)
    return path


def listed_again(files, top):
    """Forge the manifest: replace its sizes and hashes by those of the changed files."""
    manifest = json.loads(files[f"{top}/manifest.json"])
    for each in manifest["files"]:
        data = files[f"{top}/{each['path']}"]
        each.update(bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
    return {**files, f"{top}/manifest.json": json.dumps(manifest).encode()}


def verify_changed(archive, tmp_path, change, code=1, is_forged=False):
    """Return what the verification prints of an archive whose files a function changed."""
    files = content(archive)
    change(files)
    files = listed_again(files, archive.stem) if is_forged else files
    return verified(packed(tmp_path / "a.zip", files), code)


def test_the_folder_is_in_it_whole_and_the_same_folder_gives_the_same_bytes(
    place, compared, tmp_path
):
    files = content(compared)
    manifest = json.loads(files.pop("run/manifest.json"))
    there = {p.relative_to(place).as_posix(): p for p in (place / "run").rglob("*") if p.is_file()}
    assert set(files) == {*there, "run/plugins/spring.py"}
    assert all(files[name] == path.read_bytes() for name, path in there.items())
    assert manifest["command"] == "simgap compare run/experiment.toml"
    again = tmp_path / "again.zip"
    shutil.copytree(place / "run", tmp_path / "run")  # other time stamps and another location
    run_command("bundle", tmp_path / "run", "--out", again)
    assert again.read_bytes() == compared.read_bytes()


def test_it_is_never_written_over_and_an_unfinished_comparison_is_refused(
    place, compared, tmp_path
):
    assert "exists already" in run_command("bundle", place / "run", "--out", compared, code=2).err
    shutil.copytree(place / "run", tmp_path / "run")
    (tmp_path / "run" / "segments").mkdir()
    assert (
        "not finished"
        in run_command("bundle", tmp_path / "run", "--out", tmp_path / "a.zip", code=2).err
    )
    assert not (tmp_path / "a.zip").exists()


def test_what_was_made_follows(compared, explanation_archive):
    found = verified(compared)
    assert (found["follows"], found["archive"]["doubts"]) == (True, [])
    checked = found["comparisons"][0]["checked"]
    assert any("the salt has the SHA-256 that was committed" in line for line in checked)
    assert any("16 of 16 rows simulated again" in line for line in checked)
    found = verified(explanation_archive)
    assert found["explanation"]["unchecked"] == []
    assert any("is reproduced" in line for line in found["explanation"]["checked"])


def test_a_folder_of_an_explanation_is_checked_too_and_what_cannot_be_is_said(place):
    found = verified(place / "told")
    assert found["archive"] is None
    assert "the recording is not in it" in found["explanation"]["unchecked"][0]


def test_the_plugins_that_an_archive_names_or_holds_are_not_run(compared, tmp_path):
    """The simulator is in a plugin; without it on the command line, nothing is simulated."""
    from bench.core.plugin_registries import simulators

    before = simulators.snapshot()
    simulators.restore({})
    try:
        assert "unknown simulator 'spring'" in run_command("verify", compared, code=2).err
    finally:
        simulators.restore(before)


@pytest.mark.parametrize(
    ("change", "file", "message"),
    [
        (lambda f: f.update({"run/table.csv": f["run/table.csv"] + b" "}), "table.csv", "expected"),
        (lambda f: f.update({"run/more.txt": b"more"}), "more.txt", "does not list"),
        (lambda f: f.pop("run/status.csv"), "status.csv", "found none"),
    ],
)
def test_a_file_that_is_changed_added_or_missing_is_named(
    compared, tmp_path, change, file, message
):
    found = verify_changed(compared, tmp_path, change)
    (doubt,) = found["archive"]["doubts"]
    assert (doubt["file"], message in doubt["says"]) == (file, True)
    assert found["comparisons"] == []


def test_a_forged_manifest_is_detected_by_the_rows(compared, tmp_path):
    def halve(files):
        table = files["run/table.csv"].decode().splitlines()
        cells = table[1].split(",")
        cells[5] = str(float(cells[5]) / 2)
        files["run/table.csv"] = "\n".join([table[0], ",".join(cells), *table[2:], ""]).encode()

    found = verify_changed(compared, tmp_path, halve, is_forged=True)
    assert found["archive"]["doubts"] == []
    assert found["comparisons"][0]["doubts"][0]["says"].startswith("median: expected")


def coefficient(verdict):
    verdict["causes"][0]["coefficients"]["coefficient"]["value"] *= 1.01


def held_out(verdict):
    verdict["heldout"]["rmse_extended"] *= 0.99


def word(verdict):
    verdict["verdict"] = "proven"


@pytest.mark.parametrize(
    ("change", "message"),
    [(coefficient, "drag.linear coefficient"), (held_out, "recomputed"), (word, "proven")],
)
def test_an_improved_verdict_is_detected(explanation_archive, tmp_path, change, message):
    def improve(files):
        verdict = json.loads(files["told/verdict.json"])
        change(verdict)
        files["told/verdict.json"] = json.dumps(verdict).encode()

    found = verify_changed(explanation_archive, tmp_path, improve, is_forged=True)
    assert any(message in doubt["says"] for doubt in found["explanation"]["doubts"])


def test_another_recording_than_the_explained_one_is_detected(explanation_archive, tmp_path):
    def exchange(files):
        rows = files["told/recordings/swing.csv"]
        files["told/recordings/swing.csv"] = rows.replace(b"0.0", b"0.1", 1)

    found = verify_changed(explanation_archive, tmp_path, exchange, is_forged=True)
    assert "expected the recording that was explained" in found["explanation"]["doubts"][0]["says"]


def entry(name, mode=stat.S_IFREG | 0o644):
    made = zipfile.ZipInfo(name)
    made.create_system = 3
    made.external_attr = mode << 16
    return made


@pytest.mark.parametrize(
    ("name", "mode", "message"),
    [
        ("run/../../evil.txt", stat.S_IFREG, "is not a path inside its folder"),
        ("/etc/evil.txt", stat.S_IFREG, "is not a path inside its folder"),
        ("run//evil.txt", stat.S_IFREG, "is not a path inside its folder"),
        ("run/..\\evil.txt", stat.S_IFREG, "not a plain path"),
        ("C:evil.txt", stat.S_IFREG, "not a plain path"),
        ("run/evil\n.txt", stat.S_IFREG, "not a plain path"),
        ("run/link", stat.S_IFLNK, "is a link"),
        ("run/pipe", stat.S_IFIFO, "is a link, a folder or a device"),
        ("run/folder/", stat.S_IFDIR, "is not a path inside its folder"),
        ("run/TABLE.csv", stat.S_IFREG, "is in it twice"),
    ],
)
def test_what_would_leave_the_folder_or_stand_for_something_else_is_refused(
    compared, tmp_path, name, mode, message
):
    made = packed(tmp_path / "a.zip", content(compared), [(entry(name, mode | 0o644), "evil")])
    found = verified(made, code=2)
    assert message in found["error"]["message"]
    assert "nothing was unpacked" in found["error"]["message"]
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.parametrize(
    ("limit", "at"), [("MAX_COMPRESSION_RATIO", 3), ("MAX_UNPACKED_BYTES", 1 << 20)]
)
def test_a_bomb_is_refused_before_it_is_unpacked(compared, tmp_path, monkeypatch, limit, at):
    monkeypatch.setattr(archives, "_MIN_BYTES_FOR_RATIO_CHECK", 1 << 20)
    monkeypatch.setattr(archives, limit, at)
    zeros = {"run/zeros": bytes(10 << 20)}
    found = verify_changed(compared, tmp_path, lambda files: files.update(zeros), code=2)
    assert "it would unpack from" in found["error"]["message"]
    monkeypatch.setattr(archives, "_MAX_FILES", 3)
    assert "files, at most 3" in verified(compared, 2)["error"]["message"]


def test_a_file_that_holds_more_than_it_says_is_refused(compared, tmp_path):
    path = packed(tmp_path / "a.zip", {**content(compared), "run/zeros": bytes(3 << 20)})
    data = bytearray(path.read_bytes())
    # The last entry of the central directory is that of the zeros; its size is replaced by 10.
    place = data.rindex(b"PK\x01\x02")
    data[place + 24 : place + 28] = struct.pack("<I", 10)
    path.write_bytes(data)
    found = verified(path, code=2)
    assert str(path) in found["error"]["message"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: b"#!/bin/sh\n" + d, "it contains data that belong to no file"),
        (lambda d: d[:-2] + b"\x02\x00hi", "it contains data that belong to no file"),
        (lambda d: d[: len(d) // 2], "expected an archive of simgap bundle"),
        (lambda _: b"no archive at all", "expected an archive of simgap bundle"),
        (lambda d: d.replace(CENTRAL + b"\0", CENTRAL + b"\1"), "is encrypted"),
    ],
)
def test_an_archive_with_more_or_less_around_it_is_refused(compared, tmp_path, change, message):
    (tmp_path / "a.zip").write_bytes(change(compared.read_bytes()))
    found = verified(tmp_path / "a.zip", code=2)
    assert message in found["error"]["message"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("run/manifest.json"), "one folder with manifest.json in it"),
        (lambda f: f.update({"run/manifest.json": b"{"}), "is not of type 'object'"),
        (lambda f: f.update({"run/manifest.json": b"[" * 100_000}), "is not of type 'object'"),
        (lambda f: f.update({"run/manifest.json": b'{"format": 1}'}), "is a required property"),
        (lambda f: f.update({"other/a.txt": b"a"}), "one folder with manifest.json in it"),
    ],
)
def test_an_invalid_manifest_is_refused(compared, tmp_path, change, message):
    found = verify_changed(compared, tmp_path, change, code=2)
    assert message in found["error"]["message"]


def test_a_file_listed_twice_is_noticed(compared, tmp_path):
    def list_again(files):
        manifest = json.loads(files["run/manifest.json"])
        manifest["files"].append(manifest["files"][0])
        files["run/manifest.json"] = json.dumps(manifest).encode()

    found = verify_changed(compared, tmp_path, list_again)
    assert "listed twice" in found["archive"]["doubts"][0]["says"]


def test_links_and_hidden_files_are_left_out_and_said(place, tmp_path):
    shutil.copytree(place / "run", tmp_path / "run")
    (tmp_path / "run" / "secret").symlink_to("/etc/passwd")
    (tmp_path / "run" / ".token").write_text("mine")
    command = ["bundle", str(tmp_path / "run"), "--out", str(tmp_path / "a.zip"), "--json"]
    found = json.loads(run_command(*command).out)
    assert found["left_out"] == [".token: hidden", "secret: a link"]
    assert not {"run/secret", "run/.token"} & set(content(tmp_path / "a.zip"))


def test_plugins_of_the_same_name_are_archived_under_different_names(monkeypatch, tmp_path):
    plugins = [tmp_path / folder / "mine.py" for folder in ("first", "second", "absent")]
    for plugin in plugins[:2]:
        plugin.parent.mkdir()
        plugin.write_text(f"# {plugin.parent.name}")
    experiment = SimpleNamespace(suite="1", diagnosis=None, tuners=[SimpleNamespace(label="mine")])
    configuration = SimpleNamespace(plugins=[str(p) for p in plugins], experiment=experiment)
    monkeypatch.setattr(archives, "list_study_folders", lambda _: [tmp_path])
    monkeypatch.setattr(archives, "read_configuration", lambda _: configuration)
    files = archives._list_plugin_files(tmp_path)
    assert files == {"plugins/mine.py": plugins[0], "plugins/mine-2.py": plugins[1]}
    assert archives._format_compare_command(tmp_path, "run") == (
        "simgap compare suite --plugin run/plugins/mine.py --plugin run/plugins/mine-2.py "
        "--tuners mine"
    )
