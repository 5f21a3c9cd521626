"""Draw the figure of a training: training loss and held-out loss against epoch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import write_figure
from bench.figures.style import BLUE, ORANGE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class LossRow(NamedTuple):
    """Losses of one epoch of a training.

    Attributes:
        seed: Seed of the training.
        stage: Stage of the training, which trains one network.
        epoch: Number of the epoch.
        training: Training loss.
        held_out: Held-out loss.
    """

    seed: int
    stage: str
    epoch: int
    training: float
    held_out: float


_STAGES = {"clean": "Network for targets without noise", "noisy": "Network for noisy targets"}


def write_loss_figure(folder: Path, title: str, rows: Sequence[LossRow]) -> Path:
    """Draw the losses into `folder`/figures.

    Args:
        folder: Folder of the results.
        title: Title above the figure.
        rows: Losses of all epochs.

    Returns:
        Path of the PNG file.

    Raises:
        InputError: The folder cannot be made or written to.
    """
    png, *_ = write_figure(draw_loss_figure(title, rows), folder / "figures" / "loss")
    return png


def draw_loss_figure(title: str, rows: Sequence[LossRow]) -> Figure:
    """Draw loss against epoch, one panel per stage, with two lines for each seed.

    Args:
        title: Title above the figure.
        rows: Losses of all epochs.
    """
    # In the order in which they were trained.
    stages = list(dict.fromkeys(row.stage for row in rows))
    seeds = sorted({row.seed for row in rows})
    # Width and height in inches.
    figure, axes = make_panel_grid(1, len(stages), (1.0 + 4.0 * len(stages), 3.4), sharey=True)
    for axis, stage in zip(axes[0], stages, strict=True):
        for seed in seeds:
            training_rows = [row for row in rows if row.seed == seed and row.stage == stage]
            # The legend lists the lines of the first seed only.
            _draw_losses(axis, training_rows, has_labels=seed == seeds[0])
        axis.set(
            title=_STAGES.get(stage, stage),
            xlabel="epoch (pass over the training data)",
            yscale="log",
        )
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("loss (weighted squared error of\nthe estimated difference)")
    axes[0, 0].legend()
    count = f"{len(seeds)} training{'s' if len(seeds) > 1 else ''}"
    # The held-out loss is that on other targets than those of the training.
    figure.suptitle(f"{title} (held out: others); {count}", fontsize=11)
    return figure


def _draw_losses(axis: Axes, rows: Sequence[LossRow], has_labels: bool) -> None:
    """Draw the losses of one stage of one training.

    Args:
        axis: axes to draw on.
        rows: losses of its epochs.
        has_labels: whether the lines have entries in the legend.
    """
    epochs = [row.epoch for row in rows]
    for losses, line, colour, name in (
        ([row.training for row in rows], "-", BLUE, "training"),
        ([row.held_out for row in rows], "--", ORANGE, "held out"),
    ):
        axis.plot(epochs, losses, line, color=colour, lw=1.2, label=name if has_labels else None)
