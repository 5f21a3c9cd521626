"""The two figures of the exam, readable in grey: power against size, and confusion of causes."""

from __future__ import annotations

import numpy as np

WANTED = 0.97


def draw(folder, power, counts):
    """Draw `figures`/power and `figures`/confusion as PNG and PDF, if there are data."""
    import matplotlib

    matplotlib.use("Agg")
    (folder / "figures").mkdir(exist_ok=True)
    if power:
        _save(folder / "figures" / "power", _power(power))
    if counts:
        _save(folder / "figures" / "confusion", _confusion(counts))


def _save(path, figure):
    from matplotlib import pyplot as plt

    for suffix in (".png", ".pdf"):
        figure.savefig(
            path.with_suffix(suffix),
            dpi=150,
            metadata={"CreationDate": None} if suffix == ".pdf" else None,
        )
    plt.close(figure)


def _power(groups):
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    sizes = np.array([size for size, _, _ in groups])
    for place, label, marker, colour, shift in (
        (1, "by name, alone or in a set of at most 2", "o", "#000000", 0.985),
        (2, "the same, equivalent effects counted as one", "s", "#888888", 1.015),
    ):
        parts = [group[place] for group in groups]
        middle = np.array([part["share"] for part in parts])
        bars = np.array(
            [[part["share"] - part["low"], part["high"] - part["share"]] for part in parts]
        ).T
        axis.errorbar(
            sizes * shift, middle, yerr=np.maximum(bars, 0.0), fmt=f"{marker}-", color=colour,
            markersize=4.5,
            linewidth=1.1, capsize=2.5, label=label,
        )  # fmt: skip
    for size, part, _ in groups:
        axis.annotate(
            f"{part['of']}",
            (size, -0.07),
            xytext=(0, 0),
            textcoords="offset points",
            ha="center",
            fontsize=7,
        )
    axis.axhline(WANTED, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
    axis.set(
        xscale="log",
        ylim=(-0.09, 1.03),
        xlabel="size of the hidden effect [noise]",
        ylabel="share found",
    )
    ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.set_title(
        "Bars: 95 % (Wilson). Numbers: recordings. Dashes: what is asked for from 1 on.", fontsize=8
    )
    axis.legend(loc="center right", fontsize=8, frameon=False)
    axis.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    return figure


def _confusion(counts):
    from matplotlib import pyplot as plt

    truths, named = (_ordered({pair[i] for pair in counts}) for i in (0, 1))
    table = np.array([[counts[truth, name] for name in named] for truth in truths], dtype=float)
    shares = table / table.sum(axis=1, keepdims=True)
    size = 2.6 + 0.24 * len(named), 2.0 + 0.24 * len(truths)
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    axis.imshow(shares, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(table > 0):
        colour = "white" if shares[i, j] > 0.5 else "black"
        axis.text(j, i, f"{table[i, j]:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
    axis.set_xticks(range(len(named)), named, rotation=90, fontsize=7)
    axis.set_yticks(range(len(truths)), truths, fontsize=7)
    axis.set(xlabel="named first", ylabel="hidden")
    axis.set_title("Recordings; grey: share of the row", fontsize=8)
    return figure


def _ordered(names):
    """Sort effects by name; entries in parentheses, which are not effects, are last."""
    return sorted(names, key=lambda name: (name.startswith("("), name))
