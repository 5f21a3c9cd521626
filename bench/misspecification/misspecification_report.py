"""Tables and figures of a misspecification study, and of several studies together.

The figures show the bias of a parameter, the prediction of unseen runs, and ranks, in the simulator
as it is and in the extended one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from bench.benchmark.comparison_report import format_failures
from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.runner.study_base import PrintLine, Study
from bench.benchmark.statistics.comparison_statistics import add_trust_column, build_tables
from bench.benchmark.storage.result_folder import (
    read_comparison,
    read_configuration,
)
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.figures.figure_layout import add_trust_note, finish_chart
from bench.figures.figure_output import write_figure
from bench.figures.style import BLUE, VERMILION, TunerStyles, make_mark_style
from bench.misspecification import misspecification_statistics
from bench.misspecification.calibration_recording import EXTENDED, MODEL_LABELS, PLAIN
from bench.misspecification.misspecification_statistics import (
    BIAS,
    PARAMETERS,
    PREDICTION,
    StudyScores,
)
from bench.pages.chart import Axis, Panel, ReferenceLine, Series, draw_chart, make_method_series
from bench.pages.template import render_text
from sims.core.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_MODELS = {
    PLAIN: ("simulator as it is", make_mark_style(VERMILION, (), "s"), -0.16),
    EXTENDED: ("extended by explain", make_mark_style(BLUE, (), "o"), 0.16),
}
"""Name, style and shift along the axis of tuners of each simulator."""
_REFERENCE_TUNER = "least_squares"
"""Tuner whose bias is taken as the model's own, since it finds the best fit if there is one."""
_PANEL_COLUMNS = 3
_METRIC_NAMES = {PARAMETERS: "error of the parameters", PREDICTION: "prediction"}


def draw_figures(
    studies: Sequence[StudyScores], frames: Mapping[str, pd.DataFrame]
) -> dict[str, Figure]:
    """Draw the bias of a parameter, the prediction of unseen runs, and the ranks of the tuners.

    Args:
        studies: The studies.
        frames: Their tables: scores, ranks, and the agreement of ranks.

    Returns:
        Figures by name.
    """
    # `place` is the position of a tuner on the axis of tuners of its study.
    positions = {
        (study.experiment.name, tuner): position
        for study in studies
        for position, tuner in enumerate(study.list_tuners())
    }
    table = frames["table"]
    keys = zip(table["experiment"], table["tuner"], strict=True)
    table = table.assign(place=[positions[key] for key in keys])
    counts = [len(study.list_targets()) for study in studies]
    count_range = dict.fromkeys((min(counts), max(counts)))  # one number if both are equal
    targets = f"{' to '.join(map(str, count_range))} targets"
    bias, prediction = [], []
    for study in studies:
        parameter = _find_largest_bias(table[table["experiment"] == study.experiment.name])
        axis = Axis("mean signed error [training widths]", holds=(0.0,))
        title = f"{study.name}: {parameter}"
        bias.append(_make_mean_panel(study, title, axis, metric=BIAS, parameter=parameter))
        axis = Axis(f"RMSE of {study.channel} in unseen runs [{study.unit}]", "log")
        prediction.append(_make_mean_panel(study, study.name, axis, metric=PREDICTION))
    return {
        "bias": _draw_means(
            bias,
            table,
            "Bias of a parameter where an effect is missing",
            "The parameter with the largest error of least squares in the simulator as it is. "
            f"Point: mean over {targets} of the recommendation after the whole budget minus the "
            "true value. Bar: 95 % bootstrap interval. Left and right of zero: too small, too "
            "large.",
        ),
        "prediction": _draw_means(
            prediction,
            table,
            "Prediction of unseen runs where an effect is missing",
            f"Point: mean over {targets} of the error of the tuned simulator in runs that no tuner "
            "saw, without sensor noise. Bar: 95 % bootstrap interval.",
        ),
        "ranks": _draw_ranks(studies, frames, targets),
    }


def _make_mean_panel(study: StudyScores, title: str, axis: Axis, **where: str) -> Panel:
    """Make the panel of one study: the mean of each tuner in both simulators, with its interval.

    Args:
        study: the study, which determines the order of the tuners.
        title: title of the panel.
        axis: axis of the means.
        **where: cells of the score table that select the means.
    """
    # The true system has these effects, and the simulator lacks them.
    missing = ", ".join(study.experiment.world.get("fixed", {})) or "nothing"
    where = {"experiment": study.experiment.name, **where}
    series = tuple(
        Series(name, "mean", look, {"model": model, **where}, "low", "high", "points", shift)
        for model, (name, look, shift) in _MODELS.items()
    )
    rules = (ReferenceLine(0.0, ""),) if axis.holds else ()
    title = f"{title}\nlacks {missing}; {len(study.list_targets())} targets"
    across = Axis("", names=tuple(study.list_tuners()))
    return Panel(title, "table", "place", series, across, axis, rules=rules)


def _draw_means(panels: Sequence[Panel], table: pd.DataFrame, title: str, caption: str) -> Figure:
    """Draw panels of means, at most `_PANEL_COLUMNS` in a row, with the tuners from top to bottom.

    Args:
        panels: panels of the studies.
        table: score table of the studies.
        title: title of the figure.
        caption: text below the figure.
    """
    columns = min(len(panels), _PANEL_COLUMNS)
    figure, axes = draw_chart(panels, {"table": table}, columns, (3.4, 2.9), horizontal=True)
    return finish_chart(figure, axes[0], title, caption)


def _draw_ranks(
    studies: Sequence[StudyScores], frames: Mapping[str, pd.DataFrame], targets: str
) -> Figure:
    """Draw a line for each tuner between its mean ranks in the original and extended simulator.

    Crossing lines are tuners whose order changes. There is a row of panels for each metric, and a
    column for each study.

    Args:
        studies: the studies.
        frames: ranks, and their agreement (Kendall's tau, p-value) for each study and metric.
        targets: number of targets in words.
    """
    keys = ["experiment", "metric", "tuner"]
    ranks = frames["ranks"].melt(keys, list(MODEL_LABELS), "model", "rank")
    ranks["place"] = ranks["model"].map(MODEL_LABELS.index)
    agreement = {
        (row["experiment"], row["metric"]): row for row in frames["ranking"].to_dict("records")
    }
    across = Axis("", names=("as it is", "extended"))
    panels = []
    for metric, label in _METRIC_NAMES.items():
        # The best rank is at the top.
        up = Axis(f"mean rank by {label}\n(1 is best)", ends=(ranks["rank"].max() + 0.3, 0.7))
        for study in studies:
            name, tuners = study.experiment.name, study.list_tuners()
            style = TunerStyles(study.experiment, tuners)
            styles = {tuner: style.get_mark_style(tuner) for tuner in tuners}
            where = {"experiment": name, "metric": metric}
            series = make_method_series(styles, "tuner", "rank", where=where)
            row = agreement[name, metric]
            title = f"{study.name}\nτ = {row['tau']:.2f}, p = {row['p_value']:.2g}"
            panels.append(Panel(title, "ranks", "place", series, across, up))
    figure, axes = draw_chart(
        panels, {"ranks": ranks}, len(studies), (max(1.75, 4.5 / len(studies)), 2.9)
    )
    return finish_chart(
        figure,
        axes[0],
        "Does the ranking of tuners change with a corrected model?",
        f"Mean over {targets} of a tuner's rank on a target (its mean error over seeds). τ: "
        "Kendall's between the mean ranks in the two simulators; p: that mean ranks differ as much "
        "where the simulators are exchanged at random target by target.",
    )


def _find_largest_bias(lines: pd.DataFrame) -> str:
    """Return the parameter with the largest bias in the simulator as it is.

    The bias is that of the reference tuner, least squares, or of all tuners if it did not take
    part.

    Args:
        lines: rows of the score table of one study.
    """
    plain_lines = lines[(lines["model"] == PLAIN) & (lines["metric"] == BIAS)]
    reference = plain_lines[plain_lines["tuner"] == _REFERENCE_TUNER]
    shown_lines = reference if len(reference) else plain_lines
    biases = shown_lines.groupby("parameter", sort=False)["mean"].mean().abs().fillna(0.0)
    return str(biases.idxmax())


_TEMPLATE = Path(__file__).with_name("misspecification.txt")
VERDICT_FILE = "explain/verdict.json"
"""Path of the verdict of explain, in the folder of a study."""


def write_report(study: Study, print_line: PrintLine) -> int:
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
        misspecification_statistics.load_scores(folder, experiment)
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
        misspecification_statistics.load_scores(part, read_configuration(part).experiment)
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
    """Write the tables of the comparisons in both simulators, and print their failures.

    A comparison that has no runs yet is left out.

    Args:
        folder: folder of the study.
        print_line: prints one line of text.

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
    outcomes: Sequence[StudyScores],
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
            [misspecification_statistics.build_score_table(outcome) for outcome in outcomes]
        ),
        "ranks": pd.concat(
            [misspecification_statistics.build_rank_table(outcome) for outcome in outcomes]
        ),
        "ranking": pd.concat(
            [
                misspecification_statistics.build_rank_agreement_table(outcome)
                for outcome in outcomes
            ]
        ),
    }
    for name, frame in frames.items():
        write_atomically(
            folder / f"{name}.csv", add_trust_column(frame, experiment).to_csv(index=False)
        )
    values: dict[str, Any] = {
        "studies": [
            (scores, _read_verdict(folder / scores.experiment.name if is_joint else folder))
            for scores in outcomes
        ],
        "error_tables": [_build_error_table(scores, frames["table"]) for scores in outcomes],
        "agreement": frames["ranking"].to_dict("records"),
        "joint": [],
    }
    if is_joint:
        # Each metric, the ranks over all systems, and the mean rank of each tuner by simulator.
        for metric in misspecification_statistics.RANKED_METRICS:
            ranks = misspecification_statistics.compute_joint_ranks(frames["ranks"], metric)
            mean_ranks = pd.DataFrame({m: ranks.ranked[m].mean() for m in MODEL_LABELS})
            values["joint"].append((metric, ranks, mean_ranks))
    for line in render_text(_TEMPLATE, **values, PARAMETERS=PARAMETERS, models=MODEL_LABELS):
        print_line(line)
    for name, figure in draw_figures(outcomes, frames).items():
        figure = add_trust_note(figure, experiment.trusted)
        print_line(f"figure  {write_figure(figure, folder / 'figures' / name)[0]}")


def _read_verdict(folder: Path) -> dict[str, Any]:
    """Read the verdict of explain in the folder of a study; empty if there is none."""
    path = folder / VERDICT_FILE
    verdict: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return verdict


def _build_error_table(scores: StudyScores, lines: pd.DataFrame) -> pd.DataFrame:
    """Build the errors of parameters and of prediction by tuner, in both simulators.

    Args:
        scores: scores of a misspecification study: the runs of both simulators.
        lines: score table of this study, or of several.

    Returns:
        One row per tuner and one column per metric and simulator, sorted by the last column: the
        prediction error in the extended simulator.
    """
    heads = {PARAMETERS: "parameters", PREDICTION: f"unseen {scores.channel}"}
    lines = lines[(lines["experiment"] == scores.experiment.name) & lines["metric"].isin(heads)]
    lines = lines.assign(column=lines["metric"].map(heads) + " " + lines["model"])
    order = [f"{head} {model}" for head in heads.values() for model in MODEL_LABELS]
    errors: pd.DataFrame = lines.pivot(index="tuner", columns="column", values="mean")[order]
    return errors.sort_values(order[-1])
