"""Tests of `simgap download`: a data set arrives complete and unchanged, or one line says why."""

import hashlib
import io
import json
import os
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from bench.benchmark.problem.experiment_config import list_experiment_names, load_experiment
from bench.benchmark.problem.missing_requirements import availability
from bench.datasets import public_datasets
from bench.datasets.public_datasets import SourceFile
from sims.recording.recording import read_recording
from sims.systems.pendulum import Pendulum
from tests.command_output import run_command

MAT = "ParameterEstimation/SinglePendulum/SinglePendulumDataForParameterEstimation.mat"
LICENCE = b"Anybody may use this.\n"
RECORD_LENGTHS = (2600, 2600, 2600, 2601)
"""Number of 1 ms samples in each piece of the synthetic swing: two runs of 5 s and a remainder."""


def swing_samples():
    """Return (2, T) angles and rates at 1 ms; the pendulum hangs down at an angle of pi."""
    t = np.arange(sum(RECORD_LENGTHS)) * 1e-3
    return np.stack([np.pi + 0.8 * np.cos(8.0 * t), -6.4 * np.sin(8.0 * t)])


def cells(records):
    """Return a MATLAB cell array of shape (n, 1)."""
    array = np.empty((len(records), 1), object)
    array[:, 0] = records
    return array


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Create a clone of the pendulum repository with a short synthetic swing, declared in the
    catalogue as the published file; data sets of this machine are not found.
    """
    parts = np.split(swing_samples(), np.cumsum(RECORD_LENGTHS)[:-1], axis=1)
    content = io.BytesIO()
    savemat(content, {"Y_id": cells(parts[:2]), "Y_vad": cells(parts[2:]), "dt": 1e-3})
    folder = tmp_path / "clone"
    files = {MAT: content.getvalue(), "LICENSE": LICENCE}
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    declared = tuple(
        SourceFile(path, len(data), hashlib.sha256(data).hexdigest())
        for path, data in files.items()
    )
    made = replace(public_datasets.get("pendulum_free_swing"), files=declared)
    every = {**public_datasets._read_catalogue(), made.name: made}
    monkeypatch.setattr(public_datasets, "_read_catalogue", lambda: every)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("SIMGAP_DATA", raising=False)
    monkeypatch.delenv("SIMGAP_ROBOTS", raising=False)
    monkeypatch.chdir(tmp_path)
    return folder


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


class CutOff(Quiet):
    """Handler that announces a whole file, sends 100 bytes and closes the connection."""

    def do_GET(self):
        path = Path(self.translate_path(self.path))
        self.send_response(200)
        self.send_header("Content-Length", str(path.stat().st_size))
        self.end_headers()
        self.wfile.write(path.read_bytes()[:100])


class Endless(Quiet):
    """Handler that sends a file of unknown length that does not end."""

    sent = 0

    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        try:
            while type(self).sent < 2**28:
                self.wfile.write(bytes(2**16))
                type(self).sent += 2**16
        except OSError:
            return


@pytest.fixture
def served(repository):
    """Return a function that serves the repository on localhost and returns its address."""
    servers = []

    def serve(handler=Quiet):
        made = partial(handler, directory=str(repository))
        server = ThreadingHTTPServer(("127.0.0.1", 0), made)
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{server.server_port}"

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


def refused(*words):
    """Return the one-line error of `simgap download`, and check that no file has been written."""
    said = run_command("download", "pendulum_free_swing", *words, code=2)
    assert said.out == ""
    assert len(said.err.splitlines()) == 1, said.err
    folder = public_datasets.get_user_folder()
    assert not folder.exists() or not list(folder.iterdir())
    return said.err


def test_a_download_is_a_recording_with_its_licence_and_source(served, tmp_path):
    address = served()
    said = run_command("download", "pendulum_free_swing", "--from", address).out.splitlines()
    folder = tmp_path / "xdg" / "simgap" / "pendulum_free_swing"
    assert said == [f"pendulum_free_swing: {folder}", "needed by: simgap compare pendulum-real"]
    names = {"recording.csv", "recording.toml", "LICENSE", "SOURCE.txt"}
    assert {path.name for path in folder.iterdir()} == names
    assert (folder / "LICENSE").read_bytes() == LICENCE
    source = (folder / "SOURCE.txt").read_text()
    made = public_datasets.get("pendulum_free_swing")
    assert all(word in source for word in (made.commit, made.repository, made.files[0].sha256))
    recording = read_recording(folder / "recording.csv", Pendulum)
    assert len(recording.runs) == 2
    for number, run in enumerate(recording.runs):
        swing = swing_samples()[:, number * 5000 : (number + 1) * 5000 : 5]
        np.testing.assert_allclose(run.times, np.arange(1000) * 0.005, atol=1e-12)
        np.testing.assert_allclose(run.channels["q"], swing[0] - np.pi, atol=1.1e-6)
        np.testing.assert_allclose(run.channels["qd"], swing[1], atol=1.1e-6)


def test_runs_from_the_seventh_on_are_held_out():
    from bench.datasets.public_datasets import free_swing

    swing = np.stack([np.linspace(3.0, 3.2, 40_000), np.linspace(-1.0, 1.0, 40_000)])
    content = io.BytesIO()
    savemat(content, {"Y_id": cells([swing[:, :17_000]]), "Y_vad": cells([swing[:, 17_000:]])})
    files = free_swing({"swing.mat": content.getvalue()})
    rows = files["recording.csv"].splitlines()
    assert len(rows) == 1 + 8000
    assert rows[1001].startswith("2,0,")  # each run starts at 0 s
    held_out = [line for line in files["recording.toml"].splitlines() if line.startswith("[runs")]
    assert held_out == ["[runs.7]", "[runs.8]"]


@pytest.mark.parametrize("flat", [False, True])
def test_a_folder_holds_a_clone_or_the_files_alone(repository, tmp_path, flat):
    folder = repository
    if flat:
        folder = tmp_path / "flat"
        folder.mkdir()
        for path in (MAT, "LICENSE"):
            (folder / Path(path).name).write_bytes((repository / path).read_bytes())
    out = tmp_path / "mine"
    said = run_command("download", "pendulum_free_swing", "--from", folder, "--out", out).out
    assert (out / "pendulum_free_swing" / "recording.csv").is_file()
    assert f"experiments find it with SIMGAP_DATA={out}" in said


def test_what_is_here_is_not_downloaded_again(repository):
    words = ["download", "pendulum_free_swing"]
    run_command(*words, "--from", repository)
    assert "already in" in run_command(*words, "--from", "/nowhere").out


def test_an_experiment_finds_what_was_downloaded(repository):
    said = run_command("compare", "pendulum-real", "--targets", "1", code=2).err
    assert said.count("\n") == 1
    assert "run `simgap download pendulum_free_swing`" in said
    assert availability(load_experiment("pendulum-real")).data_set.name == "pendulum_free_swing"
    run_command("download", "pendulum_free_swing", "--from", repository)
    assert availability(load_experiment("pendulum-real")).data_set is None


def test_an_address_that_lacks_the_file(served, repository):
    (repository / MAT).unlink()
    said = refused("--from", served())
    assert "404" in said
    assert MAT in said
    assert "--from FOLDER" in said


def test_a_connection_that_is_cut_off(served):
    said = refused("--from", served(CutOff))
    assert "expected" in said or "cannot be downloaded" in said
    assert "100" in said


def test_a_server_that_does_not_stop_sending(served):
    said = refused("--from", served(Endless))
    assert "found more" in said
    assert Endless.sent < 2**24, "no more is read than was published"


def test_no_network(repository, monkeypatch):
    import urllib.request

    def unreachable(*_, **__):
        raise urllib.error.URLError(OSError(-2, "Name or service not known"))

    monkeypatch.setattr(urllib.request, "urlopen", unreachable)
    said = refused()
    assert "cannot be downloaded" in said
    assert "Name or service not known" in said
    assert f"{public_datasets.get('pendulum_free_swing').base_url}/{MAT}" in said


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (MAT, lambda data: data[:-1] + bytes([data[-1] ^ 1]), "expected SHA-256"),
        (MAT, lambda data: b"", "found 0"),
        (MAT, lambda data: data[:50], "found 50"),
        ("LICENSE", lambda data: b"Nobody may use this..\n", "LICENSE: expected SHA-256"),
    ],
    ids=["one bit", "empty", "not whole", "licence"],
)
def test_a_file_that_was_changed(repository, name, change, message):
    file = repository / name
    file.write_bytes(change(file.read_bytes()))
    said = refused("--from", repository)
    assert message in said
    assert "nothing is written" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--from", "nowhere"], "--from nowhere: no such folder"),
        (["--from", "http://127.0.0.1:9"], "cannot be downloaded"),
        (["--from", "ftp://x"], "expected a folder, or an http or https address"),
        (["--from", "."], f"expected {MAT} of commit e99a7e1"),
    ],
)
def test_a_source_that_cannot_be(repository, words, message):
    assert message in refused(*words)


def test_an_unknown_name_names_those_that_there_are():
    assert (
        "there are: pendulum_free_swing, so101" in run_command("download", "pendulum", code=2).err
    )


def test_a_folder_with_other_things_is_left_alone(repository, tmp_path):
    mine = tmp_path / "out" / "pendulum_free_swing"
    mine.mkdir(parents=True)
    (mine / "notes.txt").write_text("mine")
    said = refused("--from", repository, "--out", tmp_path / "out")
    assert "delete it, or choose another folder with --out" in said
    assert [path.name for path in mine.iterdir()] == ["notes.txt"]


def test_a_folder_that_cannot_be_written(repository, tmp_path):
    (tmp_path / "file").write_text("")
    said = refused("--from", repository, "--out", tmp_path / "file")
    assert "choose another folder with --out" in said


@pytest.mark.parametrize("content", [b"", b"MATLAB 5.0 MAT-file" * 20, None])
def test_a_file_of_other_content_is_no_recording(content):
    from bench.datasets.public_datasets import free_swing
    from sims.core.simulator import InputError

    if content is None:
        stream = io.BytesIO()
        savemat(stream, {"Y_id": np.zeros((2, 3)), "Y_vad": np.zeros((2, 3))})
        content = stream.getvalue()
    with pytest.raises(InputError, match=r"x\.mat: expected ") as raised:
        free_swing({"x.mat": content})
    assert "\n" not in str(raised.value)


def test_the_list_says_what_there_is_where_and_for_what(repository):
    listed = {
        one["name"]: one for one in json.loads(run_command("download", "--json").out)["data_sets"]
    }
    assert listed["so101"]["experiments"] == ["robot-so101"]
    assert listed["so101"]["folder"] is None
    document = json.loads(
        run_command("download", "pendulum_free_swing", "--from", repository, "--json").out
    )
    assert document["downloaded"] == ["pendulum_free_swing"]
    (one,) = document["data_sets"]
    assert Path(one["folder"]).is_dir()
    said = run_command("download").out
    assert f"in {one['folder']}" in said
    assert "not here: run `simgap download so101`" in said


def test_every_experiment_that_lacks_a_file_of_the_project_names_a_data_set(repository):
    """Without any data, experiments lack only files that a command can download."""
    for name in list_experiment_names():
        lacks = availability(load_experiment(name))
        if lacks.data_set is None:
            assert not lacks.skipped, (name, lacks.skipped)
    lacking = {
        n: d.name
        for n in list_experiment_names()
        if (d := availability(load_experiment(n)).data_set)
    }
    assert lacking == {"pendulum-real": "pendulum_free_swing", "robot-so101": "so101"}


def test_the_published_swing_is_the_recording_that_results_were_made_with(recordings, tmp_path):
    """This test needs both the published file and the recording on this machine."""
    published = os.environ.get("SIMGAP_FREE_SWING")
    if not published:
        pytest.skip("SIMGAP_FREE_SWING does not name the published file")
    from bench.datasets.public_datasets import free_swing

    for name, content in free_swing({"x.mat": Path(published).read_bytes()}).items():
        assert content == (recordings / "pendulum_free_swing" / name).read_text(), name


def test_data_sets_are_those_that_results_were_made_with(recordings):
    robots = recordings.parent / "robots"
    for data_set, folder in (("so101", robots), ("pendulum_free_swing", recordings)):
        for file in public_datasets.get(data_set).files:
            path = folder / data_set / file.name
            if not path.is_file():
                continue  # converted files are compared in the test above
            content = path.read_bytes()
            assert len(content) == file.bytes
            assert hashlib.sha256(content).hexdigest() == file.sha256
