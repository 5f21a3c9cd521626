"""Statistics of one comparison, and of several together: tables as CSV, figures beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from bench.analysis.curves import Curves, Rows, primary
from bench.analysis.paired import PROBLEMS, nemenyi, pairs, ranks
from bench.analysis.runtimes import ert_table, solved, thresholds
from bench.figures.style import Styles
from bench.problem.experiment import Entry, Experiment
from bench.report import NEEDED
from bench.store.folder import read
from sims.base import Array, InputError


def across(folders: Sequence[Path], out: Path, say: Callable[[str], None]) -> None:
    """Statistics over several comparisons: ranks over problems, joint runtime distribution, ERT and
    pairs of each.

    Raises:
        InputError: a folder is not that of a comparison, or they share no tuners.
    """
    import matplotlib

    matplotlib.use("Agg")
    from bench.figures import runtimes as figures

    all_curves, erts, shares = [], [], []
    for folder in folders:
        stored = read(folder, NEEDED)
        if stored.runs.empty:
            raise InputError(f"{folder}: holds no runs")
        metric, runs, in_widths = primary(stored.runs)
        curves = Rows(runs, stored.statuses, stored.experiment.budget).curves(metric)
        spread, levels = thresholds(curves, in_widths)
        erts.append(ert_table(curves, levels, stored.experiment.budget))
        shares += _shares(curves, spread)
        all_curves.append(curves)
    tuners = [t for t in all_curves[0].tuners() if all(t in c.tuners() for c in all_curves)]
    if not tuners:
        raise InputError(f"{', '.join(map(str, folders))}: have no tuner in common")
    out.mkdir(parents=True, exist_ok=True)
    pd.concat(erts).to_csv(out / "ert.csv", index=False)
    pd.concat([pairs(c) for c in all_curves]).to_csv(out / "pairs.csv", index=False)
    ranked = pd.concat([ranks(c) for c in all_curves])[tuners].rank(axis=1)
    ranked.to_csv(out / "ranks.csv", index_label="problem")
    say(
        f"mean rank over {len(ranked)} problems (1 is best)\n{ranked.mean().sort_values().round(2).to_string()}"
    )
    experiment = Experiment(
        "all", f"{len(ranked)} problems", tuners=tuple(Entry(t, t) for t in tuners)
    )
    table = pd.DataFrame(
        [{"tuner": t, "run": t, "k": 0, "rank": r} for t, r in ranked.mean().items()]
    )
    style = Styles(experiment, table, "rank")
    joint = {t: np.mean([share[t] for share in shares], axis=0) for t in tuners}
    made = [figures.joint_runtime_figure(out, experiment, style, joint)]
    if len(ranked) >= PROBLEMS and len(tuners) >= 3:
        friedman, p_values = nemenyi(ranked)
        p_values.to_csv(out / "nemenyi.csv", index_label="tuner")
        made.append(figures.rank_figure(out, ranked, p_values, friedman))
    else:
        say(f"no critical-difference diagram: it needs {PROBLEMS} problems and 3 tuners")
    for path in made:
        say(f"figure  {path}")


def _shares(curves: Curves, spread: Array) -> list[dict[str, Array]]:
    """Of each range: by tuner, the share reached after 0..100 hundredths of the budget."""
    budget = curves.values.shape[1] - 1
    points = np.floor(np.linspace(0, budget, 101)).astype(np.int64)
    return [
        {t: solved(part.of(tuner=t), spread, points) for t in part.tuners()}
        for part in (curves.of(range=str(kind)) for kind in dict.fromkeys(curves.keys["range"]))
    ]
