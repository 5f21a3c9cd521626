"""Tests of the ball tracker against the true positions of the renderer, and with defective
films.
"""

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")

from dataclasses import replace

from sims.core import medians
from sims.core.simulator import InputError
from sims.vision import ball_tracker as tracking
from sims.vision import video_files
from sims.vision.ball_renderer import BallScene, SceneAppearance
from sims.vision.ball_tracker import track_ball
from sims.vision.pinhole_camera import PinholeCamera
from sims.vision.video_files import VideoFile, write_video

TIMES = np.arange(60) / 60


def fall(top=3.8, rebound=0.8):
    """Return heights of a ball that falls and rebounds, in closed form."""
    touch = np.sqrt(2 * (top - 0.5) / 9.81)
    speed = 9.81 * touch * rebound
    later = TIMES - touch
    return np.where(later < 0, top - 4.905 * TIMES**2, 0.5 + speed * later - 4.905 * later**2)


def stage(seed, pixels=100, **appearance):
    rng = np.random.default_rng(seed)
    camera = PinholeCamera.draw_published(rng, pixels)
    return camera, BallScene(camera, replace(SceneAppearance.draw(rng), **appearance), 0.5, rng)


def apparent_radius(camera, points):
    """Return the radius in pixels of the circle with the area of the ball's outline."""
    return np.sqrt(camera.project_sphere(points, 0.5)[1].prod(axis=-1))


def upright(z):
    return np.stack([0 * z, 0 * z, z], axis=1)


@pytest.mark.parametrize("seed", [3, 8, 12])
def test_centres_are_within_half_a_pixel_of_the_true_centre_after_compression(seed, tmp_path):
    camera, scene = stage(seed)
    points = upright(fall())
    write_video(tmp_path / "drop.mp4", scene.render_frames(points), TIMES, scene.appearance.crf)
    found = track_ball(VideoFile(tmp_path / "drop.mp4"))
    apart = np.linalg.norm(np.stack([found.u, found.v], axis=1) - camera.project(points), axis=1)
    assert np.isfinite(apart).mean() > 0.9
    assert np.sqrt(np.nanmean(apart**2)) < 0.5
    np.testing.assert_allclose(
        np.nanmedian(found.radius / apparent_radius(camera, points)), 1, atol=0.06
    )


def bouncing(times, top=4.4, restitution=0.55):
    """Return heights of a ball that bounces until it rests, flight by flight in closed form."""
    touch = np.sqrt(2 * (top - 0.5) / 9.81)
    z = np.where(times < touch, top - 4.905 * times**2, 0.5)
    begin, speed = touch, 9.81 * touch * restitution
    while speed > 0.3:
        flight = 2 * speed / 9.81
        up = (times >= begin) & (times < begin + flight)
        z[up] = 0.5 + speed * (times[up] - begin) - 4.905 * (times[up] - begin) ** 2
        begin, speed = begin + flight, restitution * speed
    return z


@pytest.mark.parametrize("seed", [1, 4, 23])
def test_a_ball_that_comes_to_rest_is_seen_to_the_end(seed, tmp_path):
    """The ball rests next to its shadow for half of the film; both enter the median of the
    frames.
    """
    times = np.arange(240) / 60
    camera, scene = stage(seed)
    points = upright(bouncing(times))
    write_video(tmp_path / "rest.mp4", scene.render_frames(points), times, scene.appearance.crf)
    found = track_ball(VideoFile(tmp_path / "rest.mp4"))
    true = camera.project_sphere(points, 0.5)[0]
    apart = np.linalg.norm(np.stack([found.u, found.v], axis=1) - true, axis=1)
    seen = (true[:, 1] > 0) & (true[:, 1] < 99)
    assert np.isfinite(apart[seen]).mean() > 0.93
    assert np.sqrt(np.nanmean(apart**2)) < 0.5
    assert np.isfinite(apart[-60:]).all()


def test_the_same_frames_make_the_same_file(tmp_path):
    """The bytes do not depend on earlier memory content; with x264's own settings one file in
    twenty differs.
    """
    _, scene = stage(5)
    frames, made = list(scene.render_frames(upright(fall()))), set()
    rng = np.random.default_rng(0)
    for i in range(25):
        junk = [np.ones(rng.integers(1, 20_000)) for _ in range(4)]
        write_video(tmp_path / f"{i}.mp4", iter(frames), TIMES, scene.appearance.crf)
        made.add((tmp_path / f"{i}.mp4").read_bytes())
        del junk
    assert len(made) == 1


def test_the_picture_is_where_the_camera_model_says():
    camera, scene = stage(1, noise=0.0, shadow=0.0, ball=(1.0, 1.0, 1.0), ground=(0.1, 0.1, 0.1))
    point = np.array([0.3, -0.2, 2.0])
    away = np.array([0.0, 0.0, -50.0])
    apart = (
        np.abs(scene.render_frame(point).astype(float) - scene.render_frame(away)).max(axis=2) > 60
    )
    v, u = np.nonzero(apart)
    np.testing.assert_allclose(
        [u.mean(), v.mean()], camera.project_sphere(point, 0.5)[0], atol=0.35
    )
    np.testing.assert_allclose(
        np.sqrt(apart.sum() / np.pi), apparent_radius(camera, point), rtol=0.06
    )


def test_a_short_film_is_decoded_once_and_a_long_one_each_time_with_the_same_track(monkeypatch):
    _, scene = stage(12)
    frames = list(zip(TIMES, scene.render_frames(upright(fall())), strict=True))

    class Source:
        passes = 0

        def __iter__(self):
            self.passes += 1
            return iter(frames)

    short, long = Source(), Source()
    kept = tracking.track_ball(short)
    monkeypatch.setattr(video_files, "_MAX_CACHED_BYTES", 10_000)
    again = tracking.track_ball(long)
    assert (short.passes, long.passes) == (1, 3)
    np.testing.assert_array_equal(kept.u, again.u)


def test_the_background_is_the_median_of_what_is_seen():
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 255, (9, 50, 3)).astype(np.float32)
    values[rng.uniform(size=(9, 50)) < 0.6] = np.nan
    values[0] = 7.0  # each pixel is observed at least once
    np.testing.assert_array_equal(medians.compute_nan_median(values), np.nanmedian(values, axis=0))


def test_frames_without_the_ball_stay_missing():
    _, scene = stage(12)
    points = upright(fall())
    hidden = np.zeros(60, bool)
    hidden[20:30] = hidden[50:] = True
    points[hidden, 2] = -50
    found = track_ball([(t, f) for t, f in zip(TIMES, scene.render_frames(points), strict=True)])
    assert not np.isfinite(found.u[hidden]).any()
    assert np.isfinite(found.u[~hidden]).sum() >= 35
    assert any("show no measurable ball" in note for note in found.notes)


def test_a_film_without_a_ball_is_one_line():
    _, scene = stage(4)
    with pytest.raises(InputError, match="no ball found"):
        track_ball(
            [
                (t, f)
                for t, f in zip(
                    TIMES, scene.render_frames(upright(np.full(60, -50.0))), strict=True
                )
            ]
        )


def test_a_cut_leaves_the_longest_part():
    (_, first), (_, second) = stage(12), stage(3)
    points = upright(fall())
    frames = [*first.render_frames(points[:45]), *second.render_frames(points[45:])]
    found = track_ball(list(zip(TIMES, frames, strict=True)))
    assert found.times.size == 45
    assert "cut" in found.notes[0]


def test_two_balls_give_a_warning():
    _, scene = stage(12)
    empty = scene.render_frame(np.array([0, 0, -50.0])).astype(int)
    frames = list(scene.render_frames(upright(fall())))
    doubled = []
    for frame in frames:
        ball = np.abs(frame.astype(int) - empty).max(axis=2) > 25
        moved, mask = np.roll(frame, 28, axis=1), np.roll(ball, 28, axis=1)
        doubled.append(np.where(mask[..., None], moved, frame))
    found = track_ball(list(zip(TIMES, doubled, strict=True)))
    assert any("second ball" in note for note in found.notes)


def test_uneven_time_stamps_come_back(tmp_path):
    _, scene = stage(1)
    times = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.05, 60)).round(3)
    times -= times[0]
    write_video(tmp_path / "uneven.mp4", scene.render_frames(upright(fall())), times)
    read = [t for t, _ in VideoFile(tmp_path / "uneven.mp4")]
    np.testing.assert_allclose(read, times, atol=1e-5)
    np.testing.assert_allclose(
        [t for t, _ in VideoFile(tmp_path / "uneven.mp4", fps=30)], np.arange(60) / 30, atol=1e-12
    )


def test_a_truncated_film_is_read_as_far_as_it_goes(tmp_path):
    _, scene = stage(1)
    write_video(tmp_path / "whole.mp4", scene.render_frames(upright(fall())), TIMES)
    data = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "half.mp4").write_bytes(data[: len(data) * 6 // 10])
    film = VideoFile(tmp_path / "half.mp4")
    assert 5 < len(list(film)) < 55
    assert "truncated" in film.notes[0]


@pytest.mark.parametrize(
    ("data", "message"), [(b"run,t\n1,0\n" * 9, "text file"), (b"", "empty file")]
)
def test_what_is_no_video_is_one_line(data, message, tmp_path):
    (tmp_path / "no.mp4").write_bytes(data)
    with pytest.raises(InputError, match=message):
        VideoFile(tmp_path / "no.mp4")


def test_a_signal_without_samples_has_no_measurable_noise():
    assert np.isnan(tracking.estimate_roughness(np.full(50, np.nan)))
