"""Animation of a shot: the filmed and tracked drop, then the planned and executed shots."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.bounce_shot.drop_recording import RECORDINGS_FOLDER
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_execution import SAMPLING_RATE_HZ, ExampleShot, execute_example
from bench.bounce_shot.shot_figures import draw_shot_panel, find_path_end
from bench.bounce_shot.shot_sampling import ShotSetup
from bench.figures.figure_layout import TRUSTED_TUNERS_NOTE, make_panel_grid
from bench.figures.style import BLUE, VERMILION
from sims.core.simulator import Array, InputError
from sims.recording.recording import read_recording
from sims.systems.ball import Ball
from sims.vision.ball_renderer import RgbImage
from sims.vision.video_files import VideoFile

_FRAMES_PER_SECOND = 12
"""Frame rate of the animation, Hz."""
_SLOW_MOTION_FACTOR = 2.0
"""Slow-motion factor of the shots."""
_HOLD_FRAMES = 9
"""Number of frames for which the end is shown."""
_DPI = 70
TIME_ROUNDING = 1e-6
"""Difference of two times that is a rounding error, s."""


class FilmFrames(NamedTuple):
    """Film of a drop, resampled to the frame rate of the animation.

    Attributes:
        pictures: frames of the film.
        tracks: for each frame, the ball centres tracked until then, pixels, (n, 2).
    """

    pictures: list[RgbImage]
    tracks: list[Array]


class _ShotPanel(NamedTuple):
    """Panel of a shot.

    Attributes:
        path: flown path x, y, z (T, 3), m.
        end: number of its samples that are shown.
        line: matplotlib line of the path flown so far.
        ball: matplotlib marker of the ball at the end of the line.
    """

    path: Array
    end: int
    line: Any
    ball: Any

    def show(self, sample: int) -> None:
        """Draw the flown path (x and z) up to a sample, with the ball at its end.

        The ball stops at the last sample that is shown.

        Args:
            sample: index of the sample.
        """
        x, _, z = self.path[: min(sample + 1, self.end)].T
        self.line.set_data(x, z)
        self.ball.set_data(x[-1:], z[-1:])


class _FilmPanel(NamedTuple):
    """Panel of the film: matplotlib image, line of the track so far, and a ring around its end."""

    picture: Any
    track: Any
    ring: Any

    def show(self, picture: RgbImage, track: Array) -> None:
        """Draw a frame of the film with its track, and a ring around the last tracked centre.

        Args:
            picture: frame of the film.
            track: ball centres tracked until then, pixels, (n, 2).
        """
        self.picture.set_data(picture)
        self.track.set_data(*track.T)
        self.ring.set_data(*track[-1:].T)


def write_animation(
    folder: Path,
    settings: ShotConfig,
    example: tuple[ShotSetup, list[str]],
    stored: Mapping[str, Any],
    trusted: bool = False,
) -> Path:
    """Write figures/shot.gif: a drop at normal speed, if it was filmed, and shots at half speed.

    Panels of all methods stand side by side, after the film and its track. The drop of the film is
    shown first, then the shots of all methods together.

    Args:
        folder: result folder.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        example: the shot and its methods.
        stored: stored results by name of the shot.
        trusted: whether tuners ran without isolation, which the title then says.

    Returns:
        Path of the animation.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter

    setup, methods = example
    film = _read_film(folder / RECORDINGS_FOLDER / f"{setup.name}.mp4")
    film_columns = 1 if film.pictures else 0
    # Margins are set once, below: a layout engine would move the panels from frame to frame.
    figure, axes = make_panel_grid(
        1,
        len(methods) + film_columns,
        # Width and height in inches.
        (2.9 * len(methods) + 1.5 * film_columns, 3.2),
        layout=None,
        gridspec_kw={"width_ratios": [0.5] * film_columns + [1] * len(methods)},
    )
    shot = execute_example(settings, setup, methods, stored)
    shot_panels = [
        _draw_shot_panel(axis, setup, method, shot)
        for axis, method in zip(axes[0, film_columns:], methods, strict=True)
    ]
    film_panel = _draw_film_panel(axes[0, 0], film) if film_columns else None
    # Samples of a path per frame of the animation.
    step = SAMPLING_RATE_HZ / _FRAMES_PER_SECOND / _SLOW_MOTION_FACTOR
    shot_frames = int(np.ceil(max(panel.end for panel in shot_panels) / step)) + 1

    def show(frame: int) -> list[Any]:
        """Draw one frame of the animation: first the film, then the shots in slow motion.

        Args:
            frame: number of the frame.

        Returns:
            An empty list, which matplotlib expects if whole figures are drawn.
        """
        shot_frame = frame - len(film.pictures)
        if film_panel is not None and shot_frame < 0:
            film_panel.show(film.pictures[frame], film.tracks[frame])
        else:
            for panel in shot_panels:
                panel.show(round(shot_frame * step))
        return []

    if trusted:
        figure.suptitle(TRUSTED_TUNERS_NOTE, fontsize=7)
    figure.tight_layout()
    path = folder / "figures" / "shot.gif"
    frames = len(film.pictures) + shot_frames + _HOLD_FRAMES
    writer = PillowWriter(_FRAMES_PER_SECOND)
    FuncAnimation(figure, show, frames=frames).save(path, writer, dpi=_DPI)
    return path


def _draw_shot_panel(axis: Any, setup: ShotSetup, method: str, shot: ExampleShot) -> _ShotPanel:
    """Draw the panel of one method in its initial state: the planned path, no flown path yet.

    Args:
        axis: axes to draw on.
        setup: setup of the shot: its ball, drop, incline and hoop.
        method: label of the method.
        shot: executed example: a shot with the path that it took.
    """
    draw_shot_panel(axis, setup, method, shot)
    line = axis.lines[-1]  # the flown path
    line.set_data([], [])
    (ball,) = axis.plot([], [], marker="o", color=VERMILION, markeredgecolor="black", markersize=7)
    path = shot.results[method].flown
    return _ShotPanel(path, find_path_end(path, setup.scene), line, ball)


def _draw_film_panel(axis: Any, film: FilmFrames) -> _FilmPanel:
    """Draw the panel of the film in its initial state: first frame, no track.

    The panel shows one frame of the film, with the tracked path of the ball so far.

    Args:
        axis: axes to draw on.
        film: film of the drop.

    Returns:
        The panel, whose parts change from frame to frame.
    """
    picture = axis.imshow(film.pictures[0])
    (track,) = axis.plot([], [], color=BLUE, linewidth=0.7)
    marker_style = {"markersize": 9, "markerfacecolor": "none", "markeredgecolor": VERMILION}
    (ring,) = axis.plot([], [], "o", **marker_style)
    axis.set_title("one drop,\nfilmed and tracked", fontsize=9)
    axis.set(xticks=[], yticks=[])
    return _FilmPanel(picture, track, ring)


def _read_film(path: Path) -> FilmFrames:
    """Read the film of a drop and its track, resampled to the frame rate of the animation.

    Args:
        path: film; the recording is next to it.

    Returns:
        Frames and tracks; empty if there is no film, because the study recorded heights instead.
    """
    try:
        frames = list(VideoFile(path))
        run = read_recording(path.with_suffix(".csv"), Ball, whole=True).runs[0]
    except InputError:
        return FilmFrames([], [])
    stamps, film_pictures = zip(*frames, strict=True)
    times = np.array(stamps) - stamps[0]
    # Times of the frames of the animation, s.
    frame_times = np.arange(0.0, times[-1], 1.0 / _FRAMES_PER_SECOND)
    pictures = [
        film_pictures[int(np.searchsorted(times, time - TIME_ROUNDING))] for time in frame_times
    ]
    track = np.stack([run.extra["u"], run.extra["v"]], axis=1)  # (n, 2), pixels
    return FilmFrames(pictures, [track[run.times <= time + TIME_ROUNDING] for time in frame_times])
