"""A shot as a short animation: every method's plan and what the ball did, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.shot.deal import Deal
from bench.shot.pictures import end_of, label_of, shot_panel
from bench.shot.settings import Settings
from bench.shot.throw import RATE, throw
from bench.shot.tune import Model

_FRAMES_PER_SECOND = 12
_SLOWER = 2.0
_HOLD = 9  # frames at the end


def animate(folder: Path, settings: Settings, example: tuple[Deal, list[str]], kept: Mapping[str, Any]) -> Path:
    """Write figures/shot.gif of one shot by some methods, at half its speed; returns the file."""
    from matplotlib import pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter

    dealt, methods = example
    models = {model["method"]: Model(**model) for model in kept[dealt.name]["models"]}
    throws = {method: throw(dealt, settings, models[method]) for method in methods}
    top = max(float(np.nanmax(t.flown[:, 2])) for t in throws.values()) + 0.1
    figure, axes = plt.subplots(1, len(methods), figsize=(2.9 * len(methods), 3.2), squeeze=False)
    moving = []
    for axis, method in zip(axes[0], methods, strict=True):
        shot_panel(axis, dealt, label_of(method), models[method], throws[method], top)
        line = axis.lines[-1]
        (ball,) = axis.plot([], [], marker="o", color="#D55E00", markeredgecolor="black", markersize=7)
        moving.append((throws[method].flown, end_of(throws[method].flown, dealt.scene.hoop_z - 0.12), line, ball))
    step = RATE / _FRAMES_PER_SECOND / _SLOWER
    frames = int(np.ceil(max(end for _, end, _, _ in moving) / step)) + 1

    def show(frame: int) -> list[Any]:
        for path, end, line, ball in moving:
            now = min(round(frame * step), end - 1)
            line.set_data(path[: now + 1, 0], path[: now + 1, 2])
            ball.set_data(path[now : now + 1, 0], path[now : now + 1, 2])
        return []

    figure.tight_layout()
    made = folder / "figures" / "shot.gif"
    FuncAnimation(figure, show, frames=frames + _HOLD).save(made, PillowWriter(_FRAMES_PER_SECOND), dpi=70)
    plt.close(figure)
    return made
