"""Tables and figures of a misspecification study, and of several studies together.

The figures show the bias of a parameter, the prediction of unseen runs, and ranks, in the simulator
as it is and in the extended one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.benchmark.comparison_report import format_failures
from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.runner.stored_study import PrintLine, Study
from bench.benchmark.statistics.comparison_statistics import add_trust_column, build_tables
from bench.benchmark.storage.result_folder import (
    read_comparison,
    read_configuration,
)
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.figures.figure_output import write_figure
from bench.figures.style import (
    BLUE,
    VERMILION,
    ZERO_LINE_GREY,
    TunerStyles,
    add_caption,
    add_trust_note,
    make_panel_grid,
    style_axis,
)
from bench.misspecification import misspecification_scores
from bench.misspecification.calibration import EXTENDED, MODEL_LABELS, PLAIN
from bench.misspecification.misspecification_scores import StudyScores
from sims.core.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_MARKER_STYLES: dict[str, dict[str, Any]] = {
    "plain": {"color": VERMILION, "marker": "s", "markerfacecolor": "white"},
    "extended": {"color": BLUE, "marker": "o"},
}
"""Marker styles by simulator: hollow before, filled after, distinguishable in greyscale."""
_MODEL_NAMES = {"plain": "simulator as it is", "extended": "extended by explain"}
_REFERENCE_TUNER = "least_squares"
"""Tuner whose bias is taken as the model's own, since it finds the best fit if there is one."""
_PANEL_COLUMNS = 3


def draw_bias_figure(studies: Sequence[StudyScores], table: pd.DataFrame) -> Figure:
    """Draw the signed error of each study's most biased parameter, by tuner.

    That parameter is the one with the largest error of least squares in the original simulator.

    Args:
        studies: The studies, one panel each.
        table: Rows of their error tables.
    """
    figure, panels = _make_panels(len(studies))
    for panel, study in zip(panels, studies, strict=False):
        bias_rows = table[
            (table["experiment"] == study.experiment.name) & (table["metric"] == "bias")
        ]
        parameter = _find_largest_bias(bias_rows)
        _draw_means(panel, study, bias_rows[bias_rows["parameter"] == parameter])
        panel.axvline(0.0, color=ZERO_LINE_GREY, linewidth=0.8)
        panel.set_title(f"{study.name}: {parameter}\n{_format_missing_effects(study)}", fontsize=9)
        panel.set_xlabel("mean signed error [training widths]", fontsize=8)
    caption = (
        "The parameter with the largest error of least squares in the simulator as it is. Point: "
        f"mean over {_format_target_count(studies)} of the recommendation after the whole budget "
        "minus the true value. "
        "Bar: 95 % bootstrap interval. Left and right of zero: too small, too large."
    )
    return _finish_figure(
        figure, panels[0], "Bias of a parameter where an effect is missing", caption
    )


def draw_prediction_figure(studies: Sequence[StudyScores], table: pd.DataFrame) -> Figure:
    """Draw the prediction error in unseen runs, by tuner.

    Args:
        studies: The studies, one panel each.
        table: Rows of their error tables.
    """
    figure, panels = _make_panels(len(studies))
    for panel, study in zip(panels, studies, strict=False):
        is_of_study = table["experiment"] == study.experiment.name
        _draw_means(panel, study, table[is_of_study & (table["metric"] == "heldout_error")])
        panel.set_xscale("log")
        panel.set_title(f"{study.name}\n{_format_missing_effects(study)}", fontsize=9)
        panel.set_xlabel(f"RMSE of {study.channel} in unseen runs [{study.unit}]", fontsize=8)
    caption = (
        f"Point: mean over {_format_target_count(studies)} of the error of the tuned simulator in "
        "runs that no tuner saw, without sensor noise. Bar: 95 % bootstrap interval."
    )
    heading = "Prediction of unseen runs where an effect is missing"
    return _finish_figure(figure, panels[0], heading, caption)


def draw_rank_slope_figure(
    systems: Sequence[StudyScores], ranks: pd.DataFrame, ranking: pd.DataFrame
) -> Figure:
    """Draw mean ranks in both simulators, one row of panels per metric, one column per system.

    Args:
        systems: The studies.
        ranks: Rows of their rank tables.
        ranking: Rank agreement (Kendall's tau, p-value) of each study and metric.
    """
    metrics = {"param_error": "error of the parameters", "heldout_error": "prediction"}
    # Width in inches, with the space for each system.
    width = max(6.0, 2.6 + 1.75 * len(systems))
    figure, axes = make_panel_grid(len(metrics), len(systems), (width, 6.6), sharey=True)
    for row, (metric, label) in zip(axes, metrics.items(), strict=True):
        for panel, study in zip(row, systems, strict=True):
            study_ranks = ranks[
                (ranks["experiment"] == study.experiment.name) & (ranks["metric"] == metric)
            ]
            _draw_rank_lines(panel, study, study_ranks)
            agreement = ranking[ranking["experiment"] == study.experiment.name].set_index("metric")
            tau, p = (float(agreement[column].loc[metric]) for column in ("tau", "p_value"))
            panel.set_title(f"{study.name}\nτ = {tau:.2f}, p = {p:.2g}", fontsize=8)
        row[0].set_ylabel(f"mean rank by {label}\n(1 is best)", fontsize=9)
    axes[0][0].invert_yaxis()
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8, frameon=False)
    caption = (
        f"Mean over {_format_target_count(systems)} of a tuner's rank on a target (its mean error "
        "over seeds). τ: Kendall's between the mean ranks in the two simulators; p: that mean "
        "ranks differ as much where the simulators are exchanged at random target by target."
    )
    figure.suptitle("Does the ranking of tuners change with a corrected model?", fontsize=11)
    add_caption(figure, caption, letters=15)
    return figure


def _make_panels(count: int) -> tuple[Figure, list[Axes]]:
    """Make a grid of panels, at most three in a row, one per study.

    Args:
        count: number of studies.

    Returns:
        The figure and its panels; surplus panels of the last row are empty.
    """
    columns = min(count, _PANEL_COLUMNS)
    rows = -(-count // columns)
    # Width and height in inches, with the space for each panel.
    figure, axes = make_panel_grid(rows, columns, (1.6 + 3.4 * columns, 1.3 + 2.9 * rows))
    panels = list(np.ravel(axes))
    for panel in panels[:count]:
        style_axis(panel)
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, panels


def _draw_means(panel: Axes, study: StudyScores, lines: pd.DataFrame) -> None:
    """Draw one row per tuner with its mean and 95 % interval in both simulators.

    Args:
        panel: axes to draw on.
        study: the study, which determines the order of the tuners.
        lines: rows of the score table for one metric and study.
    """
    tuners = study.list_tuners()
    # The two simulators are shifted vertically, so that their bars do not overlap.
    for shift, model in zip((-0.16, 0.16), MODEL_LABELS, strict=True):
        part = lines[lines["model"] == model].set_index("tuner").reindex(tuners)
        mean = part["mean"].to_numpy(dtype=np.float64)
        # A mean's own interval contains it except for rounding.
        bars = [np.maximum(mean - part["low"], 0.0), np.maximum(part["high"] - mean, 0.0)]
        panel.errorbar(
            mean,
            np.arange(len(tuners)) + shift,
            xerr=np.nan_to_num(np.array(bars, dtype=np.float64)),
            linestyle="none",
            markersize=4.5,
            linewidth=1.1,
            capsize=2,
            label=_MODEL_NAMES[model],
            **_MARKER_STYLES[model],
        )
    panel.set_yticks(range(len(tuners)), tuners, fontsize=8)
    panel.tick_params(axis="x", labelsize=8)
    panel.invert_yaxis()


def _find_largest_bias(lines: pd.DataFrame) -> str:
    """Return the parameter with the largest bias in the simulator as it is.

    The bias is that of the reference tuner, least squares, or of all tuners if it did not take
    part.

    Args:
        lines: rows of the score table of one study, with the metric "bias".
    """
    plain_lines = lines[lines["model"] == "plain"]
    reference = plain_lines[plain_lines["tuner"] == _REFERENCE_TUNER]
    sizes = (reference if len(reference) else plain_lines).groupby("parameter", sort=False)["mean"]
    largest = sizes.mean().abs().fillna(0.0)
    return [str(name) for name in largest.index][int(largest.to_numpy().argmax())]


def _draw_rank_lines(panel: Axes, study: StudyScores, ranks: pd.DataFrame) -> None:
    """Draw a line for each tuner between its mean ranks in the original and extended simulator.

    Crossing lines are tuners whose order changes. Colours are given by rank in the original
    simulator.

    Args:
        panel: axes to draw on.
        study: the study, which determines the styles of the tuners.
        ranks: rows of the rank table for one metric and study.
    """
    style_axis(panel)
    style = TunerStyles(study.experiment, list(ranks.sort_values("plain", kind="stable")["tuner"]))
    for tuner, plain_rank, extended_rank in zip(
        ranks["tuner"], ranks["plain"], ranks["extended"], strict=True
    ):
        panel.plot(
            [0, 1], [plain_rank, extended_rank], markersize=5, **style.get_plot_style(str(tuner))
        )
    panel.set_xticks([0, 1], ["as it is", "extended"], fontsize=8)
    # The two simulators are at 0 and 1.
    panel.set_xlim(-0.25, 1.25)


def _format_missing_effects(study: StudyScores) -> str:
    """Format which effects the original simulator lacks, and the number of targets."""
    names = list(study.experiment.world.get("fixed", {}))
    return f"lacks {', '.join(names) or 'nothing'}; {len(study.list_targets())} targets"


def _format_target_count(systems: Sequence[StudyScores]) -> str:
    """Format the number of targets of all studies, as one number or a range."""
    counts = sorted({len(study.list_targets()) for study in systems})
    count_text = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
    return f"{count_text} targets"


def _finish_figure(figure: Figure, panel: Axes, heading: str, caption: str) -> Figure:
    """Add legend, heading and caption to a figure, and return it.

    Args:
        figure: figure of Matplotlib.
        panel: a panel whose legend entries serve for all panels.
        heading: title of the figure.
        caption: text below the figure.
    """
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    figure.suptitle(heading, fontsize=11, x=0.01, ha="left")
    add_caption(figure, caption, letters=14)
    return figure


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
        "bias": draw_bias_figure(outcomes, frames["table"]),
        "prediction": draw_prediction_figure(outcomes, frames["table"]),
        "ranks": draw_rank_slope_figure(outcomes, frames["ranks"], frames["ranking"]),
    }
    for name, figure in drawn_figures.items():
        path = write_figure(add_trust_note(figure, experiment.trusted), folder / "figures" / name)[
            0
        ]
        print_line(f"figure  {path}")


def _list_summary_texts(
    folder: Path,
    outcomes: Sequence[StudyScores],
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


def _format_verdict(scores: StudyScores, folder: Path) -> str:
    """Format which effects the true system has, and which verdict and causes explain gave.

    Args:
        scores: scores of a misspecification study: the runs of both simulators.
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


def _format_error_table(scores: StudyScores, lines: pd.DataFrame) -> str:
    """Format the errors of parameters and of prediction by tuner, in both simulators.

    Args:
        scores: scores of a misspecification study: the runs of both simulators.
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
