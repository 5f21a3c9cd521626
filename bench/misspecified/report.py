"""Tables and figures of a misspecification study, and of several studies together."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import pandas as pd

from bench.analysis.marks import marked
from bench.figures import misspecified as figures
from bench.figures.style import mark, save
from bench.misspecified import scores
from bench.misspecified.calibration import EXTENDED, MODELS, PLAIN
from bench.problem.experiment import Experiment
from bench.report import failure_lines, tables
from bench.store.folder import Configuration, configuration, read
from bench.store.status import FAILURES
from sims.files import write

Say = Callable[[str], None]
VERDICT = "explain/verdict.json"
"""Path of the verdict of explain, in the folder of a study."""


class Studied(Protocol):
    """Protocol of the studies that can be reported."""

    folder: Path
    configuration: Configuration


def finish(study: Studied, say: Say) -> int:
    """Write tables and figures of a study, and print a summary.

    Args:
        study: the study.
        say: prints a line.

    Returns:
        Number of failed runs.
    """
    folder, experiment = study.folder, study.configuration.experiment
    failed = _comparisons(folder, say)
    one = scores.outcome(folder, experiment) if has_both(folder) else None
    if one is None or not one.targets():
        say(f"{experiment.name}: no target has been met in both simulators yet")
        return failed
    _written(folder, [one], say, whole=False)
    return failed


def conclude(folder: Path, parts: Sequence[Path], say: Say) -> None:
    """Write tables and figures of several studies together, and print a summary.

    Args:
        folder: folder that contains the studies.
        parts: folders of the studies.
        say: prints a line.
    """
    there = [part for part in parts if has_both(part)]
    outcomes = [scores.outcome(part, configuration(part).experiment) for part in there]
    outcomes = [one for one in outcomes if one.targets()]
    if len(outcomes) < 2:
        return
    say(f"\ntogether, {len(outcomes)} systems")
    _written(folder, outcomes, say, whole=True)


def has_both(folder: Path) -> bool:
    """Return whether a study has runs of both comparisons."""
    return all((folder / model / "runs.parquet").is_file() for model in MODELS)


def _comparisons(folder: Path, say: Say) -> int:
    """Write the tables of the comparisons that exist.

    Returns:
        Number of failed runs.
    """
    failed = 0
    for model in MODELS:
        if not (folder / model / "runs.parquet").is_file():
            continue
        stored = read(folder / model)
        for name, frame in tables(stored).items():
            write(folder / model / f"{name}.csv", frame.to_csv(index=False))
        bad = stored.statuses[stored.statuses["status"].isin(FAILURES)]
        for text in failure_lines(bad):
            say(text)
        failed += int((bad["status"] != "skipped").sum())
    return failed


def _written(folder: Path, outcomes: Sequence[scores.Outcome], say: Say, whole: bool) -> None:
    """Write tables and figures of one study, or of all together, and print a summary."""
    experiment: Experiment = outcomes[0].experiment
    frames = {
        "table": pd.concat([scores.table(one) for one in outcomes]),
        "ranks": pd.concat([scores.ranks(one) for one in outcomes]),
        "ranking": pd.concat([scores.ranking(one) for one in outcomes]),
    }
    for name, frame in frames.items():
        write(folder / f"{name}.csv", marked(frame, experiment).to_csv(index=False))
    for text in _said(folder, outcomes, frames, whole):
        say(text)
    drawn = {
        "bias": figures.bias(outcomes, frames["table"]),
        "prediction": figures.prediction(outcomes, frames["table"]),
        "ranks": figures.slopes(outcomes, frames["ranks"], frames["ranking"]),
    }
    for name, figure in drawn.items():
        path = save(mark(figure, experiment.trusted), folder / "figures" / name)[0]
        say(f"figure  {path}")


def _said(
    folder: Path,
    outcomes: Sequence[scores.Outcome],
    frames: dict[str, pd.DataFrame],
    whole: bool,
) -> list[str]:
    texts = []
    for one in outcomes:
        place = folder / one.experiment.name if whole else folder
        texts += ["", _explained(one, place), _table(one, frames["table"])]
        rows = frames["ranking"][frames["ranking"]["experiment"] == one.experiment.name]
        texts += [_tau(row) for _, row in rows.iterrows()]
    if whole:
        for metric in scores.RANKED:
            texts += ["", _together(frames["ranks"], metric)]
    return texts


def _explained(one: scores.Outcome, folder: Path) -> str:
    """Format the effects of the true system and the causes that explain named."""
    hidden = one.experiment.world.get("fixed", {})
    world = ", ".join(f"{name} {value}" for name, value in hidden.items()) or "nothing more"
    path = folder / VERDICT
    answer = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    causes = ", ".join(str(c["effect"]) for c in answer.get("causes", ())) or "nothing"
    return f"{one.name}: the world has {world}; explain says {answer.get('verdict')}: {causes}"


def _table(one: scores.Outcome, lines: pd.DataFrame) -> str:
    """Format the errors of parameters and of prediction by tuner, in both simulators."""
    mine = lines[(lines["experiment"] == one.experiment.name) & lines["metric"].isin(scores.RANKED)]
    heads = {scores.PARAMETERS: "parameters", scores.PREDICTION: f"unseen {one.channel}"}
    mine = mine.assign(column=mine["metric"].map(heads) + " " + mine["model"])
    wide = mine.pivot(index="tuner", columns="column", values="mean")
    order = [f"{head} {model}" for head in heads.values() for model in MODELS]
    wide = wide[order].sort_values(order[-1]).rename_axis(index=None, columns=None)
    title = f"mean error of the parameters [{scores.WIDTHS}] and RMSE of unseen runs [{one.unit}]"
    return f"{title}\n{wide.to_string(float_format=lambda value: f'{value:.2g}')}"


def _tau(row: pd.Series) -> str:
    what = "parameters" if row["metric"] == scores.PARAMETERS else "prediction"
    return (
        f"ranking by {what}: Kendall's tau {row['tau']:.2f} ({row['low']:.2f} to {row['high']:.2f})"
        f" between the simulators, {row['tau_of_halves']:.2f} between halves of the targets in the"
        f" plain one; p of no change {row['p_value']:.2g}"
    )


def _together(ranked: pd.DataFrame, metric: str) -> str:
    """Format the mean ranks over several systems."""
    joint = scores.joint(ranked, metric)
    means = pd.DataFrame({model: joint.ranked[model].mean() for model in MODELS})
    means = means.sort_values(EXTENDED).rename_axis(index=None)
    what = "parameters" if metric == scores.PARAMETERS else "prediction"
    head = f"mean rank over {len(joint.ranked[PLAIN])} systems by {what}, tau {joint.tau:.2f}"
    tests = "; ".join(
        f"{model}: Friedman p {joint.friedman[model]:.2g}, "
        f"{joint.apart[model]} pairs apart (Nemenyi)"
        for model in MODELS
    )
    return f"{head}\n{means.to_string(float_format=lambda value: f'{value:.1f}')}\n{tests}"
