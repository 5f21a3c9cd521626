"""Figures of an exam, readable in grey: power against size, and confusion of causes."""

from __future__ import annotations

import numpy as np
import pandas as pd

from tests.exams.exam_report import SIZES, drawn, graded, share

WANTED = 0.97


def draw_figures(folder, table):
    """Draw power and confusion as PNG and PDF, if there are data."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(exist_ok=True)
    figures = {"power": _power(power_groups(table)), "confusion": _confusion(table)}
    for name, figure in figures.items():
        for suffix in (".png", ".pdf") if figure else ():
            metadata = {"CreationDate": None} if suffix == ".pdf" else None
            figure.savefig(folder / f"{name}{suffix}", dpi=150, metadata=metadata)
        plt.close(figure) if figure else None


def power_groups(table):
    """Return (size, share, share up to equivalence) by group of sizes of single causes."""
    singles = drawn(table)[drawn(table).kind == "single"]
    counted = graded(singles)
    rest = singles.drop(counted.index)
    labels = pd.cut(counted["size"], SIZES, right=False)
    parts = [(float(size), own) for size, own in rest.groupby("size")]
    for limits, own in counted.groupby(labels, observed=True):
        parts.append((float(np.sqrt(max(limits.left, 0.1) * min(limits.right, 30.0))), own))
    return [(size, share(own.few), share(own.equivalent)) for size, own in parts]


def _power(groups):
    from matplotlib import pyplot as plt

    if not groups:
        return None
    figure, axis = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    sizes = np.array([size for size, _, _ in groups])
    for place, label, marker, colour, shift in (
        (1, "by name, alone or in a small set", "o", "#000000", 0.985),
        (2, "the same, equivalent effects counted as one", "s", "#888888", 1.015),
    ):
        _, _, ratio, low, high = np.array([group[place] for group in groups], dtype=float).T
        axis.errorbar(
            sizes * shift, ratio, yerr=np.maximum([ratio - low, high - ratio], 0.0),
            fmt=f"{marker}-", color=colour, markersize=4.5, linewidth=1.1, capsize=2.5, label=label,
        )  # fmt: skip
    for size, got, _ in groups:
        axis.annotate(f"{got[1]}", (size, -0.07), ha="center", fontsize=7)
    axis.axhline(WANTED, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
    axis.set(
        xscale="log", ylim=(-0.09, 1.03), xlabel="size of the hidden effect [noise]",
        ylabel="share found",
    )  # fmt: skip
    ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 30]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.set_title(
        "Bars: 95 % (Wilson). Numbers: recordings. Dashes: target from 1 on.", fontsize=8
    )
    axis.legend(loc="center right", fontsize=8, frameon=False)
    axis.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    return figure


def count_confusion(table):
    """Return counts of answers: rows are hidden effects, columns the effect named first."""
    rows = graded(table)
    rows = rows[rows.kind != "double"]
    hidden = rows.effect.where(~rows.kind.isin(["clean", "foreign", "numerics"]))
    hidden = hidden.fillna("(" + rows.kind + ")")
    first = rows.causes.str.split(r"\||@| \+ ", regex=True).str[0]
    is_named = (first != "") & ~rows.verdict.isin(["adequate", "unknown", "unidentifiable"])
    # Tables of imported answers have no verdicts.
    without_verdict = rows.outcome.where(rows.outcome == "failed", "no cause")
    verdict = rows.verdict.where(rows.verdict != "", without_verdict)
    first = first.where(is_named, "(" + verdict + ")")
    return pd.crosstab(hidden, first)


def _confusion(table):
    from matplotlib import pyplot as plt

    counts = count_confusion(table)
    if counts.empty:
        return None
    truths, named = (sorted(index, key=lambda n: (n.startswith("("), n)) for index in counts.axes)
    values = counts.loc[truths, named].to_numpy(dtype=float)
    shares = values / values.sum(axis=1, keepdims=True)
    size = 2.6 + 0.24 * len(named), 2.0 + 0.24 * len(truths)
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    axis.imshow(shares, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(values > 0):
        colour = "white" if shares[i, j] > 0.5 else "black"
        axis.text(j, i, f"{values[i, j]:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
    axis.set_xticks(range(len(named)), named, rotation=90, fontsize=7)
    axis.set_yticks(range(len(truths)), truths, fontsize=7)
    axis.set(xlabel="named first", ylabel="hidden")
    axis.set_title("Recordings; grey: share of the row", fontsize=8)
    return figure
