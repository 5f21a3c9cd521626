"""Tests of LeRobot datasets, versions 2 and 3, as folders of logs."""

import numpy as np
import pandas
import pytest

import simgap
from bench.logs.recording_digest import compute_recording_digest
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError
from sims.recording.log_formats.lerobot_dataset import is_dataset, list_episodes, split_episode_path
from sims.recording.log_formats.log_files import read_log
from tests.bench.logs.log_writers import ARM, JOINTS, make_dataset_folder, make_episode, motion


def frames(episode, count=90):
    """Return the rows of an episode, in degrees, with an image in each row."""
    times, q, u = motion(episode, count)
    rows = make_episode(episode, times, np.degrees(q), np.degrees(u))
    return rows.assign(**{"observation.images.top": [{"bytes": b"x", "path": "a.png"}] * count})


def dataset(folder, version, joints=JOINTS, count=4):
    """Write four episodes: one file each, or three in one file and the fourth in two."""
    data = make_dataset_folder(folder, version, joints)
    own = [frames(k) for k in range(count)]
    if version == "2.1":
        for k, rows in enumerate(own):
            rows.to_parquet(data / f"episode_{k:06d}.parquet")
    else:
        half = len(own[-1]) // 2
        pandas.concat([*own[:-1], own[-1][:half]]).to_parquet(
            data / "file-000.parquet", index=False
        )
        own[-1][half:].to_parquet(data / "file-001.parquet", index=False)
    return folder


@pytest.mark.parametrize("version", ["2.1", "3.0"])
def test_an_episode_is_a_log_whose_entries_have_their_names(tmp_path, version):
    folder = dataset(tmp_path / "set", version)
    assert is_dataset(folder)
    paths = list_episodes(folder)
    assert [path.parent.name for path in paths] == [f"episode_{k:06d}" for k in range(4)]
    for number, path in enumerate(paths):
        assert split_episode_path(path) == (folder, number)
        log, rows = read_log(path), frames(number)
        seen = np.stack(rows["observation.state"].to_numpy())
        for k, joint in enumerate(JOINTS):
            assert log.get_column(f"observation.state.{joint}.pos").tolist() == seen[:, k].tolist()
        assert (log.get_column("episode_index") == number).all()
        assert log.get_column("timestamp").size == 90
        assert "observation.images.top" not in log.columns


def test_a_dataset_of_version_3_is_imported_and_read(tmp_path):
    """The tests of all log formats import one of version 2.1."""
    dataset(tmp_path / "set", "3.0")
    arm, out = tmp_path / "arm.xml", tmp_path / "log.toml"
    arm.write_text(ARM)
    made = simgap.import_logs([tmp_path / "set"], arm, out, position_unit="deg")
    recording, _ = load_recording(out)
    assert [run.name for run in recording.runs] == [f"episode_{k:06d}" for k in range(4)]
    run, (_, q, u) = recording.runs[3], motion(3, 90)
    np.testing.assert_allclose(run.channels["q.knee"], q[:, 1], atol=1e-7)
    np.testing.assert_allclose(run.inputs["u.m_hip"], u[:, 0], atol=1e-7)
    assert "time: column timestamp in s, 100 Hz" in made.guessed
    before = compute_recording_digest(out)
    (tmp_path / "set" / "meta" / "info.json").write_text('{"features": {}}')
    assert compute_recording_digest(out) != before


def test_entries_without_names_have_places(tmp_path):
    folder = dataset(tmp_path / "set", "2.1", joints=None)
    log = read_log(list_episodes(folder)[1])
    assert {"observation.state[0]", "observation.state[1]", "action[1]"} <= set(log.list_columns())


def test_what_is_not_there_or_not_whole_is_one_line(tmp_path):
    folder = dataset(tmp_path / "set", "2.1")
    with pytest.raises(InputError, match=r"set: no episode 9; there are: 0 to 3"):
        read_log(folder / "episode_000009" / "frames")
    (folder / "data" / "chunk-000" / "episode_000001.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match=r"000001.parquet: not a Parquet file that can be read: "):
        read_log(folder / "episode_000000" / "frames")
    (tmp_path / "arm.xml").write_text(ARM)
    with pytest.raises(InputError, match=r"\.parquet: not a Parquet file that can be read: "):
        simgap.import_logs([folder], tmp_path / "arm.xml", tmp_path / "log.toml")
    assert not (tmp_path / "log.toml").exists()
    frames(0).drop(columns="episode_index").to_parquet(
        folder / "data" / "chunk-000" / "episode_000001.parquet"
    )
    with pytest.raises(
        InputError, match=r"000001.parquet: not a Parquet file that can be read: .*episode"
    ):
        list_episodes(folder)
