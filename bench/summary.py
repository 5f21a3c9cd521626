"""Statistics of one comparison, and of several together: tables as CSV, figures beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from bench.amortisation import EVEN_COLUMNS, Price, break_even_table, prices, winners
from bench.curves import Curves, Rows, primary
from bench.experiment import Entry, Experiment
from bench.figures import Styles
from bench.paired import PROBLEMS, nemenyi, pairs, ranks
from bench.runtimes import ert_table, solved, thresholds
from bench.store import Stored, read
from methods.base import Array
from sims.base import InputError

WINNER_COLUMNS = ["experiment", "range", "threshold", "from_seconds", "to_seconds", "tuner"]
NEEDED = (
    "run", "experiment", "tuner", "target", "seed", "range", "k", "param_error", "param_abs_error", "stiff_error",
    "sloppy_error", "obs_error", "heldout_error", "outside", "tuner_seconds", "simulator_seconds",
)  # fmt: skip
"""Columns of the runs that tables and figures use."""


def summarise(folder: Path, stored: Stored) -> list[Path]:
    """Write ert.csv, pairs.csv, break_even.csv, who_wins.csv and their figures; returns the figures' PNG files."""
    import matplotlib

    matplotlib.use("Agg")
    from bench import figures_statistics as figures

    experiment = stored.experiment
    metric, runs, in_widths = primary(stored.runs)
    rows = Rows(runs, stored.statuses, experiment.budget)
    curves = rows.curves(metric)
    spread, levels = thresholds(curves, in_widths)
    ert_table(curves, levels, experiment.budget).to_csv(folder / "ert.csv", index=False)
    pairs(curves).to_csv(folder / "pairs.csv", index=False)
    held = {
        level: _prices(rows, curves, level, experiment, stored.costs) for level in levels[:3]
    }  # at every level as tables, at one as figures
    evens = [
        break_even_table(experiment.name, kind, level, table)
        for level, kinds in held.items()
        for kind, table in kinds.items()
    ]
    pd.concat([e for e in evens if len(e)] or [pd.DataFrame(columns=EVEN_COLUMNS)]).to_csv(
        folder / "break_even.csv", index=False
    )
    won = [
        (experiment.name, kind, level, *line)
        for level, kinds in held.items()
        for kind, table in kinds.items()
        for line in winners(table, figures.SHARED)
    ]
    pd.DataFrame(won, columns=WINNER_COLUMNS).to_csv(folder / "who_wins.csv", index=False)
    level = _telling(held)
    style = Styles(experiment, runs, metric)
    made = [figures.runtime_figure(folder, experiment, style, curves, spread)]
    made.append(figures.cost_figure(folder, experiment, style, held[level], level))
    if any(fit for fit, _ in stored.costs.values()):
        made.append(figures.amortisation_figure(folder, experiment, style, held[level], level))
    return made


def _telling(held: Mapping[float, Mapping[str, Mapping[str, Price]]]) -> float:
    """The tightest level that at least half of the tuners reach in some run, in every range; else the loosest."""
    for level in sorted(held):
        if all(2 * sum(np.isfinite(p.effort.ert()) for p in t.values()) >= len(t) for t in held[level].values()):
            return level
    return max(held)


def _prices(
    rows: Rows, curves: Curves, level: float, experiment: Experiment, fits: Mapping[str, tuple[float, float]]
) -> dict[str, dict[str, Price]]:
    tuner_seconds, simulator_seconds = rows.spent("tuner_seconds"), rows.spent("simulator_seconds")
    result = {}
    for kind in dict.fromkeys(curves.keys["range"]):
        mask = (curves.keys["range"] == kind).to_numpy(dtype=bool)
        part = curves.where(mask)
        result[str(kind)] = prices(
            part, level, experiment.budget, tuner_seconds[mask], simulator_seconds[mask], fits
        )  # fmt: skip
    return result


def across(folders: Sequence[Path], out: Path, say: Callable[[str], None]) -> None:
    """Statistics over several comparisons: ranks over problems, joint runtime distribution, ERT and pairs of each.

    Raises:
        InputError: a folder is not that of a comparison, or they share no tuners.
    """
    import matplotlib

    matplotlib.use("Agg")
    from bench import figures_statistics as figures

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
    say(f"mean rank over {len(ranked)} problems (1 is best)\n{ranked.mean().sort_values().round(2).to_string()}")
    experiment = Experiment("all", f"{len(ranked)} problems", tuners=tuple(Entry(t, t) for t in tuners))
    table = pd.DataFrame([{"tuner": t, "run": t, "k": 0, "rank": r} for t, r in ranked.mean().items()])
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
