"""How the cost of explain grows: ``python -m tests.benchmarks.explain_cost [--out DIR]``.

Seconds of processor time on one core against runs, samples and candidates, of recordings with a
hidden friction; slopes are of a line through the logarithms, so 1 is proportional. Writes cost.csv
and the figure cost.png|pdf.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.gap import explain as explaining
from bench.gap.model.world import World
from sims import effects
from tests.wishes import Wish, write

USUAL = Wish(
    "slider", effects=["friction.coulomb=0.3"], noise=["0.005"], observe=["x"], engine="mujoco"
)
RUNS, SAMPLES, CANDIDATES = (3, 6, 12, 24), (100, 200, 400, 800), (6, 12, 18, 24)


def seconds(wish, candidates=None):
    """Processor seconds of explain on a recording, the least of two."""
    usual, best = explaining.World, np.inf
    if candidates is not None:
        explaining.World = lambda *given, **more: World(*given, **more, candidates=candidates)
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "data.csv"
            write(wish, path)
            for _ in range(2):
                begin = time.process_time()
                explaining.explain(path)
                best = min(best, time.process_time() - begin)
    finally:
        explaining.World = usual
    return best


def measured():
    """Rows (what, how much, seconds)."""
    rows = [("runs", n, seconds(replace(USUAL, runs=n))) for n in RUNS]
    rows += [("samples a run", n, seconds(replace(USUAL, seconds=n / 100.0))) for n in SAMPLES]
    names = [n for n in effects.names() if effects.get(n).fits(_slider())]
    names.sort(key=lambda n: n != "friction.coulomb")
    rows += [("candidates", n, seconds(USUAL, names[:n])) for n in CANDIDATES]
    return rows


def _slider():
    from sims.slider.system import SliderSystem

    return SliderSystem


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("results/reference/explain-cost"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    rows = measured()
    (out / "cost.csv").write_text(
        "what,count,seconds\n" + "".join(f"{w},{n},{s:.3f}\n" for w, n, s in rows)
    )
    _draw(rows, out)
    for what in dict.fromkeys(w for w, _, _ in rows):
        print(f"{what}: slope {_slope(rows, what):.2f}")


def _slope(rows, what):
    counts, costs = np.array([(n, s) for w, n, s in rows if w == what]).T
    return float(np.polyfit(np.log(counts), np.log(costs), 1)[0])


def _draw(rows, out):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    kinds = list(dict.fromkeys(w for w, _, _ in rows))
    figure, axes = plt.subplots(1, len(kinds), figsize=(10, 3.2), sharey=True, layout="constrained")
    for axis, what in zip(axes, kinds, strict=True):
        counts, costs = np.array([(n, s) for w, n, s in rows if w == what]).T
        axis.loglog(counts, costs, "ko-", markersize=5)
        axis.loglog(counts, costs[0] * counts / counts[0], "k:", linewidth=1)
        axis.set_xticks(counts, [f"{n:g}" for n in counts])
        axis.minorticks_off()
        axis.set_xlabel(what)
        axis.set_title(f"slope {_slope(rows, what):.2f}", fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("processor time [s]")
    figure.suptitle("Cost of explain, one core; dotted: proportional", fontsize=11)
    for ending in ("png", "pdf"):
        figure.savefig(out / f"cost.{ending}", dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    main()
