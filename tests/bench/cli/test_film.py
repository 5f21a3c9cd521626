import json

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")

from bench.logs import ball_heights_from_film
from sims.core.simulator import InputError
from sims.recording.recording import read_recording
from sims.systems.ball import BallSystem
from sims.vision import video_files
from tests.command_output import run_command


@pytest.fixture(scope="module")
def drop(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    made = folder / "drop.csv"
    options = ["--runs", "1", "--theta", "0.7", "--observe", "z", "--rate", "60", "--seconds", "3"]
    run_command("simulate", "ball", *options, "--initial", "z=3.6", "vx=0", "vy=0", "--out", made)
    run_command("film", made, "--out", folder / "drop.mp4", "--camera-seed", "3", "--size", "200")
    return folder


def test_a_tracked_film_gives_the_heights_and_explain_reads_it_unedited(drop, tmp_path):
    out = tmp_path / "tracked.csv"
    run_command("track", drop / "drop.mp4", "--out", out)
    tracked = read_recording(out, BallSystem, whole=True)
    truth = read_recording(drop / "drop.csv", BallSystem, whole=True).runs[0]
    run = tracked.runs[0]
    z = np.interp(run.times, truth.times, truth.channels["z"])
    assert np.sqrt(np.nanmean((run.channels["z"] - z) ** 2)) < 0.04
    assert tracked.extra == {"u": "px", "v": "px", "radius_px": "px"}
    assert tracked.constants["radius"] == 0.5
    assert 1e-4 < tracked.noise["z"] < 0.05
    assert out.with_suffix(".png").stat().st_size > 10_000
    run_command("explain", out, "--out", tmp_path / "explained")
    found = json.loads((tmp_path / "explained" / "verdict.json").read_text())["parameters"][
        "restitution"
    ]
    assert abs(found["value"] - 0.7) < 0.03


def test_without_the_camera_the_fall_gives_the_scale(drop, tmp_path):
    out = tmp_path / "scaled.csv"
    run_command("track", drop / "drop.mp4", "--out", out, "--scale", "fall", "--ball-diameter", "1")
    z = read_recording(out, BallSystem, whole=True).runs[0].channels["z"]
    assert np.nanmin(z) == pytest.approx(0.5, abs=0.15)
    assert np.nanmax(z) == pytest.approx(3.6, abs=0.4)


def test_a_picture_that_cannot_be_drawn_leaves_nothing_behind(drop, tmp_path):
    def broken(*_):
        raise RuntimeError("out of paint")

    with pytest.raises(RuntimeError, match="out of paint"):
        ball_heights_from_film.track_film(drop / "drop.mp4", tmp_path / "t.csv", broken)
    assert not list(tmp_path.iterdir())


def test_a_film_and_its_camera_come_together_or_not_at_all(drop, tmp_path, monkeypatch):
    def full(_):
        raise InputError("disk full")

    monkeypatch.setattr(video_files, "write_files", full)
    run_command("film", drop / "drop.csv", "--out", tmp_path / "film.mp4", "--size", "32", code=2)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_tracked_is_one_line_and_nothing_is_written(tmp_path):
    (tmp_path / "text.mp4").write_text("hello\n" * 20)
    error = run_command("track", tmp_path / "text.mp4", "--out", tmp_path / "t.csv", code=2).err
    assert error.count("\n") == 1
    assert "text file" in error
    assert not list(tmp_path.glob("t.*"))
