"""Tests of HDF5 files as logs: plain files, and robomimic files with a group for each run."""

import numpy as np
import pytest

import simgap
from bench.logs.recording_digest import compute_recording_digest
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError
from sims.recording.log_formats.log_files import read_log
from tests.bench.logs.log_writers import ARM

h5py = pytest.importorskip("h5py", reason="h5py is not installed: extra hdf5")

TIMES = np.arange(120) / 50.0
Q = np.column_stack([np.sin(3 * TIMES), 0.5 * np.cos(2 * TIMES)])


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return tmp_path / "arm.xml"


def test_a_plain_file_is_a_log(arm, tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time"] = TIMES
        file["robot/position"] = Q[:, ::-1]
        file["robot/names"] = ["knee", "hip"]
        file["camera"] = np.zeros((120, 4, 4))
    made = simgap.import_logs([tmp_path / "log.h5"], arm, tmp_path / "log.toml")
    recording, _ = load_recording(tmp_path / "log.toml", divide=False)
    np.testing.assert_allclose(recording.runs[0].channels["q.knee"], Q[:, 1])
    assert "q.knee: log.h5, column robot/position.knee, by its name" in "\n".join(made.guessed)


def test_groups_that_are_numbered_are_runs(arm, tmp_path):
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        for run in (10, 2):
            file[f"data/demo_{run}/obs/joint_pos"] = Q + 0.1 * run
            file[f"data/demo_{run}/rewards"] = np.zeros(120)
        file["mask/train"] = ["demo_2"]
    out = tmp_path / "log.toml"
    with pytest.raises(InputError, match="state the rate of the rows with --rate HZ"):
        simgap.import_logs([tmp_path / "demo.hdf5"], arm, out)
    simgap.import_logs([tmp_path / "demo.hdf5"], arm, out, rate=50, held_out=["demo_10"])
    recording, _ = load_recording(out, divide=False)
    assert [run.name for run in recording.runs] == ["demo_2", "demo_10"]
    np.testing.assert_allclose(recording.runs[1].channels["q.hip"], Q[:, 0] + 1.0)
    before = compute_recording_digest(out)
    with h5py.File(tmp_path / "demo.hdf5", "a") as file:
        file["data/demo_2/obs/joint_pos"][0] = 0.5
    assert compute_recording_digest(out) != before


def test_what_is_not_there_or_not_whole_is_one_line(tmp_path):
    path = tmp_path / "log.hdf5"
    with h5py.File(path, "w") as file:
        file["a/t"] = TIMES
        file["b/note"] = "text"
    with pytest.raises(InputError, match=r"unknown group 'c'; there are: a, b"):
        read_log(path / "c")
    with pytest.raises(InputError, match=r"expected columns of numbers, found none"):
        read_log(path / "b")
    (tmp_path / "bad.h5").write_bytes(path.read_bytes()[:300])
    (tmp_path / "text.h5").write_text("t,q\n0,1\n")
    for name in ("bad.h5", "text.h5"):
        with pytest.raises(InputError, match=r"not an HDF5 file that can be read") as error:
            read_log(tmp_path / name)
        assert "\n" not in str(error.value)
