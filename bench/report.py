"""What a finished comparison shows: table.csv, the figures, and a short table on the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from bench.figures import draw
from bench.figures_identifiability import identifiability_figures
from bench.problem import Problem
from bench.stats import FAILURES, summary, table
from bench.store import read
from bench.summary import NEEDED, summarise


def finish(folder: Path, problem: Problem, say: Callable[[str], None]) -> int:
    """Write table and figures of the comparison in `folder` from what is stored there, and say what came out.

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
    name = "" if single is None else single.name + (f" [{single.unit}]" if single.unit != "1" else "")
    figures = draw(folder, stored.experiment, stored.runs, f"{channel.name} [{channel.unit}]", name)
    figures += summarise(folder, stored)
    figures += identifiability_figures(folder, stored.experiment, stored.runs, f"{channel.name} [{channel.unit}]")
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


def _directions(lines: pd.DataFrame, kind: str, channel: str) -> str:
    """Errors along stiff and sloppy directions, and of prediction, of one range; empty where there are none."""
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
    columns = {"tuner": "tuner_seconds", "simulator": "simulator_seconds", "one training": "fit_seconds"}
    table = pd.DataFrame({name: last[column] for name, column in columns.items()}).rename_axis(None)
    return f"mean seconds of a run\n{table.to_string(float_format=lambda v: f'{v:.2g}')}"


def failure_lines(failed: pd.DataFrame) -> list[str]:
    """A table of failures: a line for each tuner and kind, with the first reason's error and where it was raised."""
    lines = []
    for (tuner, status), group in failed.groupby(["tuner", "status"], sort=False):
        lines.append((str(tuner), str(len(group)), str(status), first_line(str(group["reason"].iloc[0]))))
    if not lines:
        return []
    lines.insert(0, ("tuner", "runs", "status", "first reason"))
    widths = [max(len(line[i]) for line in lines) for i in range(3)]
    laid_out = [f"{a:{widths[0]}}  {b:>{widths[1]}}  {c:{widths[2]}}  {d}".rstrip() for a, b, c, d in lines]
    return ["", "failures", *laid_out]


_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+), in (?P<function>\S+)')


def first_line(reason: str) -> str:
    """What went wrong and where, of a reason that may be a traceback."""
    lines = reason.strip().splitlines() or [""]
    frames = [i for i, line in enumerate(lines) if _FRAME.search(line)]
    if not frames:
        return lines[-1].strip()
    # The error's own words begin behind the last frame, at the margin; what follows them may be pages.
    words = next((line for line in lines[frames[-1] + 1 :] if line[:1].strip()), lines[-1])
    file, number, function = _FRAME.findall(lines[frames[-1]])[0]
    return f"{words} ({Path(file).name}, line {number}, in {function})"
