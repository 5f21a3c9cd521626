"""Tables and figures of a misspecification study, and of several studies together."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.results_report import format_failures
from bench.benchmark.statistics.comparison_tables import add_trust_column, build_tables
from bench.benchmark.storage.result_folder import (
    FolderConfiguration,
    read_comparison,
    read_configuration,
)
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.figures.style import add_trust_note, write_figure
from bench.misspecification import misspecification_figures as figures
from bench.misspecification import misspecification_scores
from bench.misspecification.calibration import EXTENDED, MODEL_LABELS, PLAIN
from sims.core.files import write_atomically

PrintLine = Callable[[str], None]
VERDICT_FILE = "explain/verdict.json"
"""Path of the verdict of explain, in the folder of a study."""


class ReportableMisspecificationStudy(Protocol):
    """Protocol of the studies that can be reported."""

    folder: Path
    configuration: FolderConfiguration


def write_report(study: ReportableMisspecificationStudy, print_line: PrintLine) -> int:
    """Write tables and figures of a study, and print a summary.

    Args:
        study: the study.
        print_line: prints a line.

    Returns:
        Number of failed runs.
    """
    folder, experiment = study.folder, study.configuration.experiment
    failed = _write_comparison_tables(folder, print_line)
    scores = (
        misspecification_scores.load_scores(folder, experiment)
        if has_both_comparisons(folder)
        else None
    )
    if scores is None or not scores.list_targets():
        print_line(f"{experiment.name}: no target has results in both simulators yet")
        return failed
    _write_tables_and_figures(folder, [scores], print_line, is_joint=False)
    return failed


def write_joint_report(folder: Path, parts: Sequence[Path], print_line: PrintLine) -> None:
    """Write tables and figures of several studies together, and print a summary.

    Args:
        folder: folder that contains the studies.
        parts: folders of the studies.
        print_line: prints a line.
    """
    complete_parts = [part for part in parts if has_both_comparisons(part)]
    outcomes = [
        misspecification_scores.load_scores(part, read_configuration(part).experiment)
        for part in complete_parts
    ]
    outcomes = [outcome for outcome in outcomes if outcome.list_targets()]
    if len(outcomes) < 2:
        return
    print_line(f"\ntogether, {len(outcomes)} systems")
    _write_tables_and_figures(folder, outcomes, print_line, is_joint=True)


def has_both_comparisons(folder: Path) -> bool:
    """Return whether a study has runs of both comparisons."""
    return all((folder / model / "runs.parquet").is_file() for model in MODEL_LABELS)


def _write_comparison_tables(folder: Path, print_line: PrintLine) -> int:
    """Write the tables of the comparisons that exist.

    Returns:
        Number of failed runs.
    """
    failed = 0
    for model in MODEL_LABELS:
        if not (folder / model / "runs.parquet").is_file():
            continue
        stored = read_comparison(folder / model)
        for name, frame in build_tables(stored).items():
            write_atomically(folder / model / f"{name}.csv", frame.to_csv(index=False))
        failures = stored.statuses[stored.statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
        for text in format_failures(failures):
            print_line(text)
        failed += int((failures["status"] != "skipped").sum())
    return failed


def _write_tables_and_figures(
    folder: Path,
    outcomes: Sequence[misspecification_scores.StudyScores],
    print_line: PrintLine,
    is_joint: bool,
) -> None:
    """Write tables and figures of one study, or of all together, and print a summary.

    Args:
        folder: folder to write to.
        outcomes: scores of each study.
        print_line: prints a line.
        is_joint: whether several studies are reported together.
    """
    experiment: Experiment = outcomes[0].experiment
    frames = {
        "table": pd.concat(
            [misspecification_scores.build_score_table(outcome) for outcome in outcomes]
        ),
        "ranks": pd.concat(
            [misspecification_scores.build_rank_table(outcome) for outcome in outcomes]
        ),
        "ranking": pd.concat(
            [misspecification_scores.build_rank_agreement_table(outcome) for outcome in outcomes]
        ),
    }
    for name, frame in frames.items():
        write_atomically(
            folder / f"{name}.csv", add_trust_column(frame, experiment).to_csv(index=False)
        )
    for text in _list_summary_texts(folder, outcomes, frames, is_joint):
        print_line(text)
    drawn_figures = {
        "bias": figures.draw_bias_figure(outcomes, frames["table"]),
        "prediction": figures.draw_prediction_figure(outcomes, frames["table"]),
        "ranks": figures.draw_rank_slope_figure(outcomes, frames["ranks"], frames["ranking"]),
    }
    for name, figure in drawn_figures.items():
        path = write_figure(add_trust_note(figure, experiment.trusted), folder / "figures" / name)[
            0
        ]
        print_line(f"figure  {path}")


def _list_summary_texts(
    folder: Path,
    outcomes: Sequence[misspecification_scores.StudyScores],
    frames: dict[str, pd.DataFrame],
    is_joint: bool,
) -> list[str]:
    """List the texts of the printed summary.

    For each study they are the hidden effects with the verdict of explain, the errors of the
    tuners, and the rank agreement. For several studies the mean ranks over them follow.

    Args:
        folder: result folder of the study, or the folder that contains the studies.
        outcomes: scores of each study.
        frames: tables by name: ``table``, ``ranks`` and ``ranking``.
        is_joint: whether several studies are reported together.
    """
    texts = []
    for scores in outcomes:
        study_folder = folder / scores.experiment.name if is_joint else folder
        texts += [
            "",
            _format_verdict(scores, study_folder),
            _format_error_table(scores, frames["table"]),
        ]
        rows = frames["ranking"][frames["ranking"]["experiment"] == scores.experiment.name]
        texts += [_format_rank_agreement(row) for _, row in rows.iterrows()]
    if is_joint:
        for metric in misspecification_scores.RANKED_METRICS:
            texts += ["", _format_joint_ranks(frames["ranks"], metric)]
    return texts


def _format_verdict(scores: misspecification_scores.StudyScores, folder: Path) -> str:
    """Format which effects the true system has, and which verdict and causes explain gave.

    Args:
        scores: the scores of the study.
        folder: its result folder, with the verdict of explain.
    """
    hidden = scores.experiment.world.get("fixed", {})
    world = ", ".join(f"{name} {value}" for name, value in hidden.items()) or "no further effects"
    path = folder / VERDICT_FILE
    answer = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    causes = ", ".join(str(c["effect"]) for c in answer.get("causes", ())) or "nothing"
    return (
        f"{scores.name}: the true system has {world}; explain reports {answer.get('verdict')}: "
        f"{causes}"
    )


def _format_error_table(scores: misspecification_scores.StudyScores, lines: pd.DataFrame) -> str:
    """Format the errors of parameters and of prediction by tuner, in both simulators.

    Args:
        scores: the scores of the study.
        lines: score table of this study, or of several.
    """
    study_lines = lines[
        (lines["experiment"] == scores.experiment.name)
        & lines["metric"].isin(misspecification_scores.RANKED_METRICS)
    ]
    heads = {
        misspecification_scores.PARAMETERS: "parameters",
        misspecification_scores.PREDICTION: f"unseen {scores.channel}",
    }
    study_lines = study_lines.assign(
        column=study_lines["metric"].map(heads) + " " + study_lines["model"]
    )
    errors_by_column = study_lines.pivot(index="tuner", columns="column", values="mean")
    order = [f"{head} {model}" for head in heads.values() for model in MODEL_LABELS]
    errors_by_column = (
        errors_by_column[order].sort_values(order[-1]).rename_axis(index=None, columns=None)
    )
    title = (
        f"mean error of the parameters [{misspecification_scores.TRAINING_WIDTHS_UNIT}] "
        f"and RMSE of unseen runs [{scores.unit}]"
    )
    return f"{title}\n{errors_by_column.to_string(float_format=lambda value: f'{value:.2g}')}"


def _format_rank_agreement(row: pd.Series) -> str:
    """Format how well the rankings of the tuners in both simulators agree, by one metric.

    Kendall's tau is 1 for equal rankings and -1 for reversed ones. The agreement between two halves
    of the targets shows how much a ranking varies with the drawn targets.

    Args:
        row: row of the table of rank agreement.
    """
    metric_name = (
        "parameters" if row["metric"] == misspecification_scores.PARAMETERS else "prediction"
    )
    return (
        f"ranking by {metric_name}: Kendall's tau {row['tau']:.2f} ({row['low']:.2f} to "
        f"{row['high']:.2f}) between the simulators, {row['tau_of_halves']:.2f} between halves of "
        f"the targets in the unchanged one; p of no change {row['p_value']:.2g}"
    )


def _format_joint_ranks(ranked: pd.DataFrame, metric: str) -> str:
    """Format the mean ranks over several systems, with tests of Friedman and Nemenyi.

    Args:
        ranked: rows of the rank tables of all studies.
        metric: one of `misspecification_scores.RANKED_METRICS`.
    """
    joint = misspecification_scores.compute_joint_ranks(ranked, metric)
    mean_ranks = pd.DataFrame({model: joint.ranked[model].mean() for model in MODEL_LABELS})
    mean_ranks = mean_ranks.sort_values(EXTENDED).rename_axis(index=None)
    quantity = "parameters" if metric == misspecification_scores.PARAMETERS else "prediction"
    head = f"mean rank over {len(joint.ranked[PLAIN])} systems by {quantity}, tau {joint.tau:.2f}"
    tests = "; ".join(
        f"{model}: Friedman p {joint.friedman[model]:.2g}, "
        f"{joint.distinct_tuner_pairs[model]} significantly different pairs (Nemenyi)"
        for model in MODEL_LABELS
    )
    return f"{head}\n{mean_ranks.to_string(float_format=lambda value: f'{value:.1f}')}\n{tests}"
