"""Statistics of a misspecification study: scores and ranks of tuners in both simulators.

The simulators are the original and the extended one. Scores are signed and absolute errors of
parameters, and prediction errors of unseen runs. The value of a target is the mean over its seeds.
Means and intervals are over targets (95 % percentile bootstrap). Errors of parameters are in
training widths. A failed run has no parameter errors here; it is counted as a failure and ranks
last on its target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.statistics.bootstrap import compute_bootstrap_interval, compute_resampled_means
from bench.benchmark.statistics.error_curves import RunRowTable
from bench.benchmark.statistics.tuner_ranking import (
    MIN_PROBLEMS_FOR_RANKS,
    compute_friedman_p_value,
    compute_kendall_tau,
    compute_mean_ranks,
    compute_nemenyi_p_values,
    compute_rank_agreement,
)
from bench.benchmark.storage.result_folder import read_comparison
from bench.misspecification.calibration_recording import EXTENDED, MODEL_LABELS, PLAIN
from sims.core.simulator import Array, Parameter

BIAS, ABSOLUTE, PARAMETERS, PREDICTION = "bias", "absolute_error", "param_error", "heldout_error"
"""Metrics of a misspecification study.

They are the mean signed and the mean absolute error of one parameter, the mean absolute error of
all parameters, and the RMSE of unseen runs in the error channel.
"""
RANKED_METRICS = (PARAMETERS, PREDICTION)
"""Metrics by which tuners are ranked."""
SCORE_COLUMNS = [
    "experiment",
    "model",
    "tuner",
    "metric",
    "parameter",
    "unit",
    "mean",
    "low",
    "high",
    "targets",
    "runs",
    "failures",
]
RANK_COLUMNS = ["experiment", "metric", "tuner", *MODEL_LABELS]
RANK_AGREEMENT_COLUMNS = [
    "experiment",
    "metric",
    "tuners",
    "targets",
    "tau",
    "low",
    "high",
    "tau_of_halves",
    "p_value",
    "friedman_plain",
    "friedman_extended",
]
TRAINING_WIDTHS_UNIT = "training widths"
SIGNIFICANCE_LEVEL = 0.05
"""P-value below which the difference of two tuners is significant."""


@dataclass(frozen=True)
class StudyScores:
    """Final recommendations of all runs of a study.

    Attributes:
        experiment: the experiment.
        unit: unit of the error channel.
        channel: name of the error channel.
        parameters: tuned parameters.
        errors: one row per model, tuner and target. Columns are the signed error of each parameter
            in training widths, under the name of the parameter; `PARAMETERS` and `PREDICTION`;
            numbers of runs and failures.
    """

    experiment: Experiment
    unit: str
    channel: str
    parameters: tuple[Parameter, ...]
    errors: pd.DataFrame

    @property
    def name(self) -> str:
        """Name of the system, for tables and figures."""
        return self.experiment.name.removeprefix("misspecified-")

    def list_tuners(self) -> list[str]:
        """List the labels of the tuners with results in both simulators, as in the experiment."""
        finished_tuners = set(self.errors["tuner"])
        return [e.label for e in self.experiment.tuners if e.label in finished_tuners]

    def build_metric_matrix(
        self, model: str, metric: str, tuners: Sequence[str], targets: Sequence[str]
    ) -> Array:
        """Return a metric in one of the simulators as a matrix.

        Args:
            model: one of `MODEL_LABELS`.
            metric: name of the metric.
            tuners: labels of the tuners.
            targets: names of the targets.

        Returns:
            Values, (targets, tuners).
        """
        part = self.errors[self.errors["model"] == model]
        table = part.pivot(index="target", columns="tuner", values=metric)
        values: Array = table.reindex(index=list(targets), columns=list(tuners)).to_numpy()
        return values

    def list_targets(self) -> list[str]:
        """List the names of the targets with results of all tuners in both simulators."""
        return sorted({str(name) for name in self.errors["target"]})


def load_scores(folder: Path, experiment: Experiment) -> StudyScores:
    """Load the scores of a study: errors of parameters and of predictions, for each target.

    A study has one comparison of tuners for each model (original and extended), in a subfolder
    with the model's name. Only targets that are complete in both are kept.

    Args:
        folder: result folder of the study.
        experiment: experiment of the study.

    Raises:
        InputError: a comparison of the study is missing, unfinished or damaged.
    """
    problem = TuningProblem(experiment)
    parameters, widths = problem.cube.parameters, problem.cube.compute_training_widths()
    channel = problem.channels[problem.error_channel]
    problem.close()
    errors_by_model = [
        _build_error_rows(folder / model, model, parameters, widths) for model in MODEL_LABELS
    ]
    errors = _select_complete_targets(pd.concat(errors_by_model, ignore_index=True))
    return StudyScores(experiment, channel.unit, channel.name, parameters, errors)


def _select_complete_targets(errors: pd.DataFrame) -> pd.DataFrame:
    """Select the targets that every tuner finished in both simulators with all of its seeds.

    In an interrupted study, other targets would compare different sets of targets. A tuner that was
    skipped in one simulator is left out of both.

    Args:
        errors: rows of `StudyScores.errors` of both simulators.
    """
    # A complete target has as many runs (seeds) as any other target of the same tuner.
    seed_counts = errors.groupby(["model", "tuner"])["runs"].transform("max")
    common_tuners = set.intersection(*(set(part["tuner"]) for _, part in errors.groupby("model")))
    complete = errors[(errors["runs"] == seed_counts) & errors["tuner"].isin(common_tuners)]
    # A row is a tuner on a target in one of the two simulators.
    row_counts = complete.groupby("target").size()
    complete_targets = set(row_counts[row_counts == len(MODEL_LABELS) * len(common_tuners)].index)
    return complete[complete["target"].isin(complete_targets)].reset_index(drop=True)


def _build_error_rows(
    folder: Path, model: str, parameters: Sequence[Parameter], widths: Array
) -> pd.DataFrame:
    """Build the rows of `StudyScores.errors` for one of the comparisons.

    The errors are those of the last recommendation of each run. They are averaged over the seeds of
    a target; a target with a failed seed has no errors.

    Args:
        folder: result folder of the comparison.
        model: `PLAIN` or `EXTENDED`.
        parameters: the tuned parameters.
        widths: width of the training range of each parameter, (p,).
    """
    stored = read_comparison(folder)
    rows = RunRowTable(stored.runs, stored.statuses, stored.experiment.budget)
    frame = rows.keys[["tuner", "target"]].copy()
    # The last column of a curve is its value after the whole budget.
    for parameter, width in zip(parameters, widths, strict=True):
        column_names = (f"recommendation_{parameter.name}", f"true_{parameter.name}")
        recommended, true = (rows.build_curves(column).values[:, -1] for column in column_names)
        frame[parameter.name] = np.where(rows.failed, np.nan, (recommended - true) / width)
    names = [parameter.name for parameter in parameters]
    frame[PARAMETERS] = frame[names].abs().mean(axis=1, skipna=False)
    # The absolute errors have columns of their own, whose means over seeds are taken below.
    for name in names:
        frame[f"|{name}|"] = frame[name].abs()
    frame[PREDICTION] = np.where(rows.failed, np.nan, rows.build_curves(PREDICTION).values[:, -1])
    frame["runs"], frame["failures"] = 1, rows.failed.astype(int)
    sums = {"runs": "sum", "failures": "sum"}
    mean_columns = {c: "mean" for c in frame.columns if c not in ("tuner", "target", *sums)}
    grouped = frame.groupby(["tuner", "target"], sort=False, as_index=False).agg(
        {**mean_columns, **sums}
    )
    # A target with a failed seed counts as failed, because its other seeds are the easier ones.
    grouped.loc[grouped["failures"] > 0, list(mean_columns)] = np.nan
    grouped.insert(0, "model", model)
    return grouped


def build_score_table(scores: StudyScores) -> pd.DataFrame:
    """Build the table of means over targets with 95 % bootstrap intervals.

    Args:
        scores: scores of a misspecification study: the runs of both simulators.

    Returns:
        One row per simulator, tuner, metric and parameter; columns as in `SCORE_COLUMNS`.
    """
    lines = []
    for (model, tuner), group_errors in scores.errors.groupby(["model", "tuner"], sort=False):
        # Metric, parameter, unit, and column of the errors.
        metrics = [
            (metric, p.name, TRAINING_WIDTHS_UNIT, column)
            for p in scores.parameters
            for metric, column in ((BIAS, p.name), (ABSOLUTE, f"|{p.name}|"))
        ]
        metrics += [
            (PARAMETERS, "", TRAINING_WIDTHS_UNIT, PARAMETERS),
            (PREDICTION, "", scores.unit, PREDICTION),
        ]
        counts = (
            len(group_errors),
            int(group_errors["runs"].sum()),
            int(group_errors["failures"].sum()),
        )
        for metric, parameter, unit, column in metrics:
            values = group_errors[column].to_numpy(dtype=np.float64)
            # A matrix of one column, because the bootstrap resamples the rows of a matrix.
            values = values[np.isfinite(values)][:, None]
            names = (scores.experiment.name, str(model), str(tuner))
            low, high = compute_bootstrap_interval(
                values, compute_resampled_means, *names, metric, parameter
            )
            mean = float(values.mean()) if len(values) else np.nan
            key = (scores.experiment.name, model, tuner, metric, parameter, unit)
            lines.append((*key, mean, low[0], high[0], *counts))
    return pd.DataFrame(lines, columns=SCORE_COLUMNS)


def build_rank_table(scores: StudyScores) -> pd.DataFrame:
    """Build the table of each tuner's mean rank in the original and in the extended simulator.

    Tuners are ranked on each target, 1 for the smallest error; ranks are averaged over targets. The
    columns are `RANK_COLUMNS`.

    Args:
        scores: scores of a misspecification study: the runs of both simulators.
    """
    tuners, targets = scores.list_tuners(), scores.list_targets()
    lines = []
    for metric in RANKED_METRICS:
        mean_ranks = [
            compute_mean_ranks(scores.build_metric_matrix(model, metric, tuners, targets))
            for model in MODEL_LABELS
        ]
        lines += [
            (scores.experiment.name, metric, tuner, *ranks_of_tuner)
            for tuner, *ranks_of_tuner in zip(tuners, *mean_ranks, strict=True)
        ]
    return pd.DataFrame(lines, columns=RANK_COLUMNS)


def build_rank_agreement_table(scores: StudyScores) -> pd.DataFrame:
    """Build the table of rank agreement between simulators; columns as `RANK_AGREEMENT_COLUMNS`.

    The agreement is Kendall's tau between the mean ranks of the tuners, with an interval and the
    p-value of the hypothesis that the ranking does not change. ``tau_of_halves`` is the mean tau
    between random halves of the targets in the original simulator: two rankings that differ in
    their targets only reach this value. Friedman's p-values tell whether tuners differ at all.

    Args:
        scores: scores of a misspecification study: the runs of both simulators.
    """
    tuners, targets = scores.list_tuners(), scores.list_targets()
    lines = []
    for metric in RANKED_METRICS:
        base_errors, extended_errors = (
            scores.build_metric_matrix(model, metric, tuners, targets) for model in MODEL_LABELS
        )
        agreement = compute_rank_agreement(
            base_errors, extended_errors, scores.experiment.name, metric
        )
        friedman = [compute_friedman_p_value(errors) for errors in (base_errors, extended_errors)]
        agreement_numbers = (
            agreement.tau,
            agreement.low,
            agreement.high,
            agreement.halves,
            agreement.p_value,
            *friedman,
        )
        lines.append(
            (scores.experiment.name, metric, len(tuners), len(targets), *agreement_numbers)
        )
    return pd.DataFrame(lines, columns=RANK_AGREEMENT_COLUMNS)


@dataclass(frozen=True)
class JointRanks:
    """Mean ranks of tuners over several systems, by one metric.

    Attributes:
        ranked: table by model with one row per system and one column per tuner: ranks of the mean
            ranks, 1 is best.
        tau: Kendall's tau between the mean ranks over systems in both simulators.
        friedman: p-value of Friedman's test by model; NaN if there are too few systems.
        distinct_tuner_pairs: number of pairs of tuners by model that differ significantly by
            Nemenyi's test (p < 0.05).
    """

    ranked: Mapping[str, pd.DataFrame]
    tau: float
    friedman: Mapping[str, float]
    distinct_tuner_pairs: Mapping[str, int]


def compute_joint_ranks(ranked: pd.DataFrame, metric: str) -> JointRanks:
    """Compute the ranks of the tuners over several systems, each of which counts once.

    The differences between tuners are tested by Friedman's test over the systems, followed by
    Nemenyi's test of each pair.

    Args:
        ranked: rows of `build_rank_table` of several systems: mean rank of each tuner in both
            simulators, by experiment and metric.
        metric: name of the metric.

    Returns:
        Ranks by system and tuner in each simulator (the original and the extended one), Kendall's
        tau between both, p-values of Friedman's test, and numbers of pairs that differ.
    """
    part = ranked[ranked["metric"] == metric]
    tables, friedman, significant_pairs = {}, {}, {}
    for model in MODEL_LABELS:
        # Mean rank over targets: one row per system, one column per tuner that all systems have.
        mean_ranks_by_system = part.pivot(index="experiment", columns="tuner", values=model)
        tuners_in_order = list(dict.fromkeys(part["tuner"]))
        mean_ranks_by_system = mean_ranks_by_system[tuners_in_order].dropna(axis="columns")
        tables[model] = mean_ranks_by_system.rank(axis=1)
        friedman[model], significant_pairs[model] = float("nan"), 0
        system_count, tuner_count = tables[model].shape
        if system_count >= MIN_PROBLEMS_FOR_RANKS and tuner_count >= 3:
            friedman[model], p_values = compute_nemenyi_p_values(tables[model])
            # Each pair is once above the diagonal.
            pairs = np.triu_indices(len(p_values), k=1)
            significant_pairs[model] = int((p_values.to_numpy()[pairs] < SIGNIFICANCE_LEVEL).sum())
    tuners = [t for t in tables[PLAIN] if t in tables[EXTENDED]]
    mean_ranks = [tables[model][tuners].mean().to_numpy() for model in MODEL_LABELS]
    return JointRanks(tables, compute_kendall_tau(*mean_ranks), friedman, significant_pairs)
