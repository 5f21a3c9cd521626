"""A shot as a short animation: the filmed drop as it was tracked, then every method's plan and what
the ball did.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.shot.deal import RECORDINGS, Deal
from bench.shot.pictures import end_of, label_of, shot_panel
from bench.shot.settings import Settings
from bench.shot.throw import RATE, throw
from bench.shot.tune import Model
from sims.ball.simulator import Ball
from sims.base import Array, InputError
from sims.camera.render import Image
from sims.camera.video import Video
from sims.recording.recording import read_recording

_FRAMES_PER_SECOND = 12
_SLOWER = 2.0
_HOLD = 9  # frames at the end


class Film(NamedTuple):
    """Pictures of a drop, as many a second as the animation has, and the middles (n, 2) tracked
    until each, pixels.
    """

    pictures: list[Image]
    tracks: list[Array]


def animate(
    folder: Path, settings: Settings, example: tuple[Deal, list[str]], kept: Mapping[str, Any]
) -> Path:
    """Write figures/shot.gif: the drop at its own speed, where it was filmed, and the shots at half
    of it.

    Returns:
        The file.
    """
    from matplotlib import pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter

    dealt, methods = example
    models = {model["method"]: Model(**model) for model in kept[dealt.name]["models"]}
    throws = {method: throw(dealt, settings, models[method]) for method in methods}
    top = max(float(np.nanmax(t.flown[:, 2])) for t in throws.values()) + 0.1
    film = _film(folder / RECORDINGS / f"{dealt.name}.mp4")
    beside = int(bool(film.pictures))
    figure, axes = plt.subplots(
        1,
        len(methods) + beside,
        figsize=(2.9 * len(methods) + 1.5 * beside, 3.2),
        squeeze=False,
        gridspec_kw={"width_ratios": [0.5] * beside + [1] * len(methods)},
    )
    moving = []
    for axis, method in zip(axes[0, beside:], methods, strict=True):
        shot_panel(axis, dealt, label_of(method), models[method], throws[method], top)
        line = axis.lines[-1]
        line.set_data([], [])
        (ball,) = axis.plot(
            [], [], marker="o", color="#D55E00", markeredgecolor="black", markersize=7
        )
        moving.append(
            (
                throws[method].flown,
                end_of(throws[method].flown, dealt.scene.hoop_z - 0.12),
                line,
                ball,
            )
        )
    seen = _film_panel(axes[0, 0], film) if beside else []
    step = RATE / _FRAMES_PER_SECOND / _SLOWER
    shots = int(np.ceil(max(end for _, end, _, _ in moving) / step)) + 1

    def show(frame: int) -> list[Any]:
        if frame < len(film.pictures):
            picture, track, ring = seen
            picture.set_data(film.pictures[frame])
            track.set_data(*film.tracks[frame].T)
            ring.set_data(*film.tracks[frame][-1:].T)
            return []
        for path, end, line, ball in moving:
            now = min(round((frame - len(film.pictures)) * step), end - 1)
            line.set_data(path[: now + 1, 0], path[: now + 1, 2])
            ball.set_data(path[now : now + 1, 0], path[now : now + 1, 2])
        return []

    figure.tight_layout()
    made = folder / "figures" / "shot.gif"
    frames = len(film.pictures) + shots + _HOLD
    FuncAnimation(figure, show, frames=frames).save(made, PillowWriter(_FRAMES_PER_SECOND), dpi=70)
    plt.close(figure)
    return made


def _film_panel(axis: Any, film: Film) -> list[Any]:
    picture = axis.imshow(film.pictures[0])
    (track,) = axis.plot([], [], color="#0072B2", linewidth=0.7)
    (ring,) = axis.plot(
        [], [], "o", markersize=9, markerfacecolor="none", markeredgecolor="#D55E00"
    )
    axis.set_title("one drop,\nfilmed and tracked", fontsize=9)
    axis.set(xticks=[], yticks=[])
    return [picture, track, ring]


def _film(path: Path) -> Film:
    """What there is of a film and its track; nothing where drops were not filmed, or the film is
    gone.
    """
    try:
        frames = list(Video(path))
        run = read_recording(path.with_suffix(".csv"), Ball, whole=True).runs[0]
    except InputError:
        return Film([], [])
    times = np.array([time for time, _ in frames]) - frames[0][0]
    wanted = np.arange(0.0, times[-1], 1.0 / _FRAMES_PER_SECOND)
    track = np.stack([run.extra["u"], run.extra["v"]], axis=1)
    pictures = [frames[int(np.searchsorted(times, time - 1e-6))][1] for time in wanted]
    return Film(pictures, [track[run.times <= time + 1e-6] for time in wanted])
