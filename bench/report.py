"""What a finished comparison shows: table.csv, the figures, and a short table on the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from bench.analysis.amortisation import EVEN_COLUMNS, Price, break_even_table, prices, winners
from bench.analysis.curves import Curves, Rows, primary
from bench.analysis.paired import pairs
from bench.analysis.runtimes import ert_table, thresholds
from bench.analysis.table import FAILURES, summary, table
from bench.figures.errors import draw
from bench.figures.identifiability import identifiability_figures
from bench.figures.style import Styles
from bench.problem.experiment import Experiment
from bench.problem.problem import Problem
from bench.store.folder import Stored, read


def finish(folder: Path, problem: Problem, say: Callable[[str], None]) -> int:
    """Write table and figures of the comparison in `folder` from what is stored there, and say what
    came out.

    Returns:
        How many runs failed.

    Raises:
        InputError: the folder is not that of a comparison.
    """
    stored = read(folder, [*NEEDED])
    if stored.runs.empty:
        say(f"no run was made; {folder}/status.csv says why")
        return 0
    lines = table(stored.runs, stored.statuses, stored.experiment.budget, stored.costs)
    lines.to_csv(folder / "table.csv", index=False)
    channel = problem.channels[problem.error_channel]
    parameters = problem.cube.parameters
    single = parameters[0] if len(parameters) == 1 else None
    name = (
        "" if single is None else single.name + (f" [{single.unit}]" if single.unit != "1" else "")
    )
    figures = draw(folder, stored.experiment, stored.runs, f"{channel.name} [{channel.unit}]", name)
    figures += summarise(folder, stored)
    figures += identifiability_figures(
        folder, stored.experiment, stored.runs, f"{channel.name} [{channel.unit}]"
    )
    for kind in lines["range"][lines["range"] != ""].unique():
        say("\n" + _text(lines, kind, f"{channel.name} [{channel.unit}]", name))
        if more := _directions(lines, kind, f"{channel.name} [{channel.unit}]"):
            say("\n" + more)
    failed = stored.statuses[stored.statuses["status"].isin(FAILURES)]
    for line in failure_lines(failed):
        say(line)
    say("\n" + _seconds(lines))
    say(f"\ntable   {folder / 'table.csv'}")
    say(f"more    {folder}/ert.csv, pairs.csv, break_even.csv, who_wins.csv")
    for figure in figures:
        say(f"figure  {figure}")
    return int((failed["status"] != "skipped").sum())


def _text(lines: pd.DataFrame, kind: str, channel: str, parameter: str) -> str:
    """One range as a table for the terminal."""
    present = set(lines["metric"])
    if kind == "real":
        metric, what = (
            ("heldout_error", "held-out") if "heldout_error" in present else ("obs_error", "fitted")
        )
        title = f"mean {what} RMSE of {channel} after N simulations"
    else:
        metric = "param_abs_error" if "param_abs_error" in present else "param_error"
        where = (
            "targets in the training range" if kind == "in" else "targets anywhere in the bounds"
        )
        title = f"mean absolute error of {parameter or 'the parameters [training widths]'} after N simulations, {where}"
    means = summary(lines, metric, kind)
    fits = lines.drop_duplicates("tuner").set_index("tuner")["fit_simulations"]
    means["trained on"] = [f"{fits[t]:.0f}" if fits[t] else "-" for t in means.index]
    means.columns.name = None
    means.index.name = None
    return f"{title}\n{means.to_string(float_format=lambda v: f'{v:.2g}')}"


def _directions(lines: pd.DataFrame, kind: str, channel: str) -> str:
    """Errors along stiff and sloppy directions, and of prediction, of one range; empty where there
    are none.
    """
    titles = {"stiff_error": "stiff", "sloppy_error": "sloppy", "heldout_error": "unseen"}
    part = lines[(lines["range"] == kind) & lines["metric"].isin(titles)]
    if kind == "real" or part.empty:
        return ""
    budget = part["simulations"].max()
    part = part[part["simulations"].isin([k for k in (3, 10, budget) if k <= budget])]
    part = part.assign(column=part["metric"].map(titles) + " " + part["simulations"].astype(str))
    order = [f"{t} {k}" for t in titles.values() for k in sorted(part["simulations"].unique())]
    means = part.pivot(index="tuner", columns="column", values="mean")
    means = means[[c for c in order if c in means]].dropna(axis=1, how="all")
    means = means.sort_values(by=means.columns[-1])
    means.columns.name = None
    means.index.name = None
    title = "mean error along stiff and sloppy directions [training widths]"
    if "heldout_error" in set(part["metric"]):
        title += f" and RMSE of {channel} in unseen scenarios"
    return f"{title}, after N simulations\n{means.to_string(float_format=lambda v: f'{v:.2g}')}"


def _seconds(lines: pd.DataFrame) -> str:
    """What a tuner took beside what its simulations took, and its training."""
    last = lines[lines["runs"] > 0].sort_values("simulations").groupby("tuner", sort=False).last()
    columns = {
        "tuner": "tuner_seconds",
        "simulator": "simulator_seconds",
        "one training": "fit_seconds",
    }
    table = pd.DataFrame({name: last[column] for name, column in columns.items()}).rename_axis(None)
    return f"mean seconds of a run\n{table.to_string(float_format=lambda v: f'{v:.2g}')}"


def failure_lines(failed: pd.DataFrame) -> list[str]:
    """A table of failures: a line for each tuner and kind, with the first reason's error and where
    it was raised.
    """
    lines = []
    for (tuner, status), group in failed.groupby(["tuner", "status"], sort=False):
        lines.append(
            (str(tuner), str(len(group)), str(status), first_line(str(group["reason"].iloc[0])))
        )
    if not lines:
        return []
    lines.insert(0, ("tuner", "runs", "status", "first reason"))
    widths = [max(len(line[i]) for line in lines) for i in range(3)]
    laid_out = [
        f"{a:{widths[0]}}  {b:>{widths[1]}}  {c:{widths[2]}}  {d}".rstrip() for a, b, c, d in lines
    ]
    return ["", "failures", *laid_out]


_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+), in (?P<function>\S+)')


def first_line(reason: str) -> str:
    """What went wrong and where, of a reason that may be a traceback."""
    lines = reason.strip().splitlines() or [""]
    frames = [i for i, line in enumerate(lines) if _FRAME.search(line)]
    if not frames:
        return lines[-1].strip()
    # The error's own words begin behind the last frame, at the margin; what follows them may be
    # pages.
    words = next((line for line in lines[frames[-1] + 1 :] if line[:1].strip()), lines[-1])
    file, number, function = _FRAME.findall(lines[frames[-1]])[0]
    return f"{words} ({Path(file).name}, line {number}, in {function})"


WINNER_COLUMNS = ["experiment", "range", "threshold", "from_seconds", "to_seconds", "tuner"]


NEEDED = (
    "run",
    "experiment",
    "tuner",
    "target",
    "seed",
    "range",
    "k",
    "param_error",
    "param_abs_error",
    "stiff_error",
    "sloppy_error",
    "obs_error",
    "heldout_error",
    "outside",
    "tuner_seconds",
    "simulator_seconds",
)
"""Columns of the runs that tables and figures use."""


def summarise(folder: Path, stored: Stored) -> list[Path]:
    """Write ert.csv, pairs.csv, break_even.csv, who_wins.csv and their figures; returns the
    figures' PNG files.
    """
    import matplotlib

    matplotlib.use("Agg")
    from bench.figures import runtimes as figures

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
    """The tightest level that at least half of the tuners reach in some run, in every range; else
    the loosest.
    """
    for level in sorted(held):
        if all(
            2 * sum(np.isfinite(p.effort.ert()) for p in t.values()) >= len(t)
            for t in held[level].values()
        ):
            return level
    return max(held)


def _prices(
    rows: Rows,
    curves: Curves,
    level: float,
    experiment: Experiment,
    fits: Mapping[str, tuple[float, float]],
) -> dict[str, dict[str, Price]]:
    tuner_seconds, simulator_seconds = rows.spent("tuner_seconds"), rows.spent("simulator_seconds")
    result = {}
    for kind in dict.fromkeys(curves.keys["range"]):
        mask = (curves.keys["range"] == kind).to_numpy(dtype=bool)
        part = curves.where(mask)
        result[str(kind)] = prices(
            part, level, experiment.budget, tuner_seconds[mask], simulator_seconds[mask], fits
        )
    return result
