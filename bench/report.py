"""What a finished comparison shows: table.csv, the figures, and a short table on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pandas as pd

from bench.figures import draw
from bench.problem import Problem
from bench.stats import FAILURES, summary, table
from bench.store import read


def finish(folder: Path, problem: Problem, say: Callable[[str], None]) -> None:
    """Write table and figures of the comparison in `folder` from what is stored there, and say what came out.

    Raises:
        InputError: the folder is not that of a comparison.
    """
    stored = read(folder)
    if stored.runs.empty:
        say(f"no run was made; {folder}/status.csv says why")
        return
    lines = table(stored.runs, stored.statuses, stored.experiment.budget, stored.costs)
    lines.to_csv(folder / "table.csv", index=False)
    channel = problem.channels[problem.error_channel]
    parameters = problem.cube.parameters
    single = parameters[0] if len(parameters) == 1 else None
    name = "" if single is None else single.name + (f" [{single.unit}]" if single.unit != "1" else "")
    figures = draw(folder, stored.experiment, stored.runs, f"{channel.name} [{channel.unit}]", name)
    for kind in lines["range"][lines["range"] != ""].unique():
        say("\n" + _text(lines, kind, f"{channel.name} [{channel.unit}]", name))
    for line in _failures(stored.statuses):
        say(line)
    say(f"\ntable   {folder / 'table.csv'}")
    for figure in figures:
        say(f"figure  {figure}")


def _text(lines: pd.DataFrame, kind: str, channel: str, parameter: str) -> str:
    """One range as a table for the terminal."""
    present = set(lines["metric"])
    if kind == "real":
        metric, what = ("heldout_error", "held-out") if "heldout_error" in present else ("obs_error", "fitted")
        title = f"mean {what} RMSE of {channel} after N simulations"
    else:
        metric = "param_abs_error" if "param_abs_error" in present else "param_error"
        where = "targets in the training range" if kind == "in" else "targets anywhere in the bounds"
        title = f"mean absolute error of {parameter or 'the parameters [training widths]'} after N simulations, {where}"
    means = summary(lines, metric, kind)
    fits = lines.drop_duplicates("tuner").set_index("tuner")["fit_simulations"]
    means["trained on"] = [f"{fits[t]:.0f}" if fits[t] else "-" for t in means.index]
    means.columns.name = None
    means.index.name = None
    return f"{title}\n{means.to_string(float_format=lambda v: f'{v:.2g}')}"


def _failures(statuses: pd.DataFrame) -> list[str]:
    """One line for each tuner and kind of failure, with the last line of the first reason."""
    lines = []
    failed = statuses[statuses["status"].isin(FAILURES)]
    for (tuner, status), group in failed.groupby(["tuner", "status"], sort=False):
        reason = str(group["reason"].iloc[0]).strip().splitlines()
        lines.append(f"{tuner}: {len(group)} {status}: {reason[-1] if reason else ''}")
    return lines
