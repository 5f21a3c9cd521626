"""The figure of a training: loss against epoch, training and held-out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.figures.style import save

Row = tuple[int, str, int, float, float]
_STAGES = {"clean": "Network for targets without noise", "noisy": "Network for noisy targets"}


def draw(folder: Path, title: str, rows: Sequence[Row]) -> Path:
    """Draw the losses into `folder`/figures; returns the PNG.

    Args:
        folder: where to.
        title: above the figure.
        rows: seed, stage, epoch, training loss, held-out loss.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    stages = list(dict.fromkeys(row[1] for row in rows))
    seeds = sorted({row[0] for row in rows})
    figure, axes = plt.subplots(
        1, len(stages), figsize=(1.0 + 4.0 * len(stages), 3.4), sharey=True, squeeze=False
    )
    for ax, stage in zip(axes[0], stages, strict=True):
        for seed in seeds:
            values = np.array([row[2:] for row in rows if row[:2] == (seed, stage)])
            first = seed == seeds[0]
            ax.plot(
                values[:, 0],
                values[:, 1],
                "-",
                color="#0072B2",
                lw=1.2,
                label="training" if first else None,
            )
            ax.plot(
                values[:, 0],
                values[:, 2],
                "--",
                color="#E69F00",
                lw=1.2,
                label="held out" if first else None,
            )
        ax.set(
            title=_STAGES.get(stage, stage),
            xlabel="epoch (pass over the training data)",
            yscale="log",
        )
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("loss (weighted squared error of\nthe estimated difference)")
    axes[0, 0].legend()
    figure.suptitle(
        f"{title} (held out: others); {len(seeds)} training{'s' * (len(seeds) > 1)}", fontsize=11
    )
    return save(folder, "loss", figure)
