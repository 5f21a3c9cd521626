"""Two figures of the robot exam, readable in grey: confusion of causes, and seconds."""

from __future__ import annotations

from tests.simple_exam.exam_figures import _confusion, _save


def draw(folder, counts, seconds):
    """Draw `figures`/confusion and `figures`/seconds as PNG and PDF, if there are data."""
    import matplotlib

    matplotlib.use("Agg")
    (folder / "figures").mkdir(exist_ok=True)
    if counts:
        _save(folder / "figures" / "confusion", _confusion(counts))
    if seconds:
        _save(folder / "figures" / "seconds", _seconds(seconds))


def _seconds(groups):
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 0.8 + 0.35 * len(groups)), layout="constrained")
    for row, values in enumerate(groups.values()):
        axis.plot(values, [row] * len(values), "o", color="black", alpha=0.5, markersize=4)
    axis.set_yticks(range(len(groups)), list(groups))
    axis.set(xscale="log", xlabel="seconds a question")
    axis.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    return figure
