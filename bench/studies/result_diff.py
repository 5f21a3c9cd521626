"""Differences between two results (`simgap diff`): two tuner comparisons, or two explanations.

Two comparisons: which errors differ significantly. If both have the same targets (the same true
parameters and start; names are not sufficient, because every salt draws its own targets), errors
are compared target by target: Wilcoxon's signed-rank test of the logarithms of the mean over the
common seeds. Otherwise the targets are two samples, and the test is that of H. B. Mann,
D. R. Whitney, Ann. Math. Stat. 18, 50, 1947. Holm's correction is over all lines.

Two explanations: verdict, causes, settings, and numbers that changed significantly. Half of a 95 %
interval is 1.96 standard errors. The standard error of the difference of two numbers is the root of
the sum of squares if the explanations use different recordings. For the same recording the numbers
are not independent and the difference is known more accurately, so the test is conservative. Holm's
correction is over all numbers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.benchmark.statistics.comparison_statistics import REQUIRED_RUN_COLUMNS
from bench.benchmark.statistics.error_curves import (
    RunCurves,
    RunRowTable,
    compute_log_errors,
    select_primary_metric,
)
from bench.benchmark.statistics.paired_tests import compare_pair, correct_holm
from bench.benchmark.storage.provenance import read_environment
from bench.benchmark.storage.result_folder import StoredComparison, read_comparison
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.diagnosis.verdict import VERDICT_FILE, Verdict, read_verdict
from bench.pages.template import render_text
from sims.core.simulator import Array, InputError
from sims.core.toml_validation import read_toml
from sims.extended_simulator import EXTENDED_MODEL_FILE, FittedValue

_TEMPLATE = Path(__file__).with_name("diff.txt")
FAMILYWISE_ERROR_RATE = 0.05
"""Familywise error rate: probability of any false alarm among all numbers of one diff."""
_MAX_CHANGES = 12
"""Maximum number of changes that are printed."""
RESULT_RELEVANT_KEYS = ("simgap", "python", "platform", "machine", "stepping", "seals", "packages")
"""Keys of an environment that may influence the results."""
COMPARED_SIMULATION_COUNTS = (3, 10)
"""Numbers of simulations at which errors are compared, in addition to the last common one."""
_TARGET_KEY_COLUMNS = ("true_", "recommendation_")
"""Prefixes of the columns that identify a target: its true parameters and its start."""
_TARGET_TOLERANCE = 1e-9
"""Relative difference up to which numbers of two targets are equal."""
_MAX_COMPARED_CANDIDATES = 5
"""Number of the best candidates of each explanation that are compared."""
_HELD_OUT_FIELDS = ("rmse_base", "rmse_extended", "noise_floor", "gap_closed", "low", "high")
"""Numbers on held-out runs that are compared: attributes of `verdict.heldout`."""
_NORMAL_95 = 1.96
"""Half width of a 95 % interval, in standard errors."""


def compare_folders(a: Path, b: Path) -> ComparisonDiff | ExplanationDiff:
    """Compare two result folders of one kind: two comparisons, or two explanations.

    Args:
        a: folder of the first comparison or explanation.
        b: folder of the second one.

    Returns:
        The differences, which are printed, tabulated and judged in the same way for both kinds.

    Raises:
        InputError: they are of two kinds, or one is neither.
    """
    is_explanation = [(folder / VERDICT_FILE).is_file() for folder in (a, b)]
    if all(is_explanation):
        return ExplanationDiff(load_explanation_side(a), load_explanation_side(b))
    if any(is_explanation):
        explanation, comparison = (a, b) if is_explanation[0] else (b, a)
        raise InputError(
            f"expected two comparisons or two explanations: {explanation} is an explanation, "
            f"{comparison} is not"
        )
    return diff_comparisons(a, b)


def diff_comparisons(a: Path, b: Path) -> ComparisonDiff:
    """Compare two comparisons by the errors of their tuners.

    Both are compared by the primary metric of the first one.

    Args:
        a: folder of the first comparison.
        b: folder of the second comparison.

    Raises:
        InputError: a folder has no comparison, or nothing that can be compared.
    """
    first = load_comparison_side(a)
    metric = select_primary_metric(first.stored.runs).metric
    return ComparisonDiff(first, load_comparison_side(b, metric), metric)


@dataclass(frozen=True)
class ComparisonSide:
    """One of two comparisons.

    Attributes:
        folder: its folder.
        stored: its stored runs.
        curves: its error curves by the compared metric.
        targets: true parameters and start by name of the target.
    """

    folder: Path
    stored: StoredComparison
    curves: RunCurves
    targets: pd.DataFrame

    def index_errors(self, kind: str, tuner: str, k: int) -> pd.Series[float]:
        """Return the errors of a tuner after k simulations.

        Args:
            kind: range of the targets.
            tuner: label of the tuner.
            k: number of simulations.

        Returns:
            Errors by (target, seed); infinite for a run without an error, and after all simulations
            also for one that failed.
        """
        part = self.curves.select(range=kind, tuner=tuner)
        # Before the end of the budget, a failed run keeps the errors of its recommendations.
        is_last = k >= part.values.shape[1] - 1
        errors = part.values[:, k]
        is_failed = np.isnan(errors) | (part.failed & is_last)
        index = pd.MultiIndex.from_frame(part.keys[["target", "seed"]])
        return pd.Series(np.where(is_failed, np.inf, errors), index=index)


def load_comparison_side(folder: Path, metric: str | None = None) -> ComparisonSide:
    """Load one of two comparisons.

    Args:
        folder: its folder.
        metric: error to compare; None for the deciding error of the comparison.

    Returns:
        Its stored runs, the error curves of the metric, and what identifies each target: its true
        parameters and its start.

    Raises:
        InputError: the folder has no comparison, no runs, or no runs with the metric.
    """
    stored = read_comparison(folder, [*REQUIRED_RUN_COLUMNS, *_TARGET_KEY_COLUMNS])
    if stored.runs.empty:
        raise InputError(f"{folder}: contains no runs")
    name = metric or select_primary_metric(stored.runs).metric
    if name not in stored.runs or stored.runs[name].isna().all():
        raise InputError(f"{folder}: has no {name}, which the other comparison is ranked by")
    runs = stored.runs[stored.runs[name].notna()]
    curves = RunRowTable(runs, stored.statuses, stored.experiment.budget).build_curves(name)
    # Before the first simulation (k = 0), the recommendation of a run is its start.
    columns = [c for c in runs if str(c).startswith(_TARGET_KEY_COLUMNS)]
    targets = stored.runs[stored.runs["k"] == 0].groupby("target")[columns].first()
    return ComparisonSide(folder, stored, curves, targets)


@dataclass(frozen=True)
class ComparisonDiff:
    """Differences between two comparisons.

    Attributes:
        a: first comparison, from which changes are counted.
        b: second comparison.
        metric: the deciding error.
    """

    a: ComparisonSide
    b: ComparisonSide
    metric: str

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Table of errors, a line per range, tuner and number of simulations (schema ``diff``).

        The p-values of all lines are corrected together (Holm).
        """
        lines = list(self._compare_all_errors())
        if not lines:
            return pd.DataFrame()
        frame = pd.DataFrame(lines)
        frame["p_holm"] = correct_holm(frame["p_value"].to_numpy(dtype=float))
        frame["significant"] = frame["p_holm"] < FAMILYWISE_ERROR_RATE
        return frame

    def _compare_all_errors(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each range, tuner and number of simulations that both comparisons have.

        Errors are compared at `COMPARED_SIMULATION_COUNTS` and at the smaller one of the two
        budgets.
        """
        ranges = set(self.b.curves.keys["range"])
        budget = min(side.stored.experiment.budget for side in (self.a, self.b))
        checkpoints = sorted({k for k in COMPARED_SIMULATION_COUNTS if k < budget} | {budget})
        for kind in dict.fromkeys(self.a.curves.keys["range"]):
            if kind not in ranges:
                continue
            tuners_a, tuners_b = (
                s.curves.select(range=str(kind)).list_tuners() for s in (self.a, self.b)
            )
            for tuner in (t for t in tuners_a if t in tuners_b):
                for k in checkpoints:
                    yield self._compare_errors(str(kind), tuner, k)

    def _compare_errors(self, kind: str, tuner: str, k: int) -> dict[str, Any]:
        """Compare the errors of one tuner in one range after k simulations.

        On shared targets the test is Wilcoxon's signed-rank test, otherwise the Mann-Whitney test;
        both use the logarithm of each target's mean error over seeds. Infinite errors count as
        failures.

        Args:
            kind: range of the targets, such as ``wide``.
            tuner: label of the tuner.
            k: number of simulations.

        Returns:
            Row of the schema ``diff``. ``median_a`` and ``median_b`` are the median errors over
            targets. ``ratio`` is the error of b divided by that of a: the median over shared
            targets, or else the ratio of both medians. ``paired`` is True with shared targets.
        """
        # Errors by (target, seed).
        errors_a, errors_b = (side.index_errors(kind, tuner, k) for side in (self.a, self.b))
        common_keys = [
            (target, seed)
            for target, seed in errors_a.index
            if (target, seed) in errors_b.index and target in self.shared_targets
        ]
        is_paired = bool(common_keys)
        if is_paired:
            errors_a, errors_b = errors_a[common_keys], errors_b[common_keys]
        target_means = [errors.groupby(level="target").mean() for errors in (errors_a, errors_b)]
        log_errors_a, log_errors_b = (
            compute_log_errors(np.asarray(errors, dtype=np.float64)) for errors in target_means
        )
        if is_paired:
            # In this order the ratio of errors is that of b over a.
            test = compare_pair(log_errors_b, log_errors_a)
            count, ratio, p_value = test.targets, test.ratio, test.p_value
        else:
            count = min(len(log_errors_a), len(log_errors_b))
            ratio, p_value = _compare_unpaired(log_errors_a, log_errors_b)
        median_a, median_b = (float(errors.median()) for errors in target_means)
        return {
            "range": kind,
            "tuner": tuner,
            "simulations": k,
            "metric": self.metric,
            "median_a": median_a,
            "median_b": median_b,
            "ratio": ratio,
            "targets": count,
            "paired": is_paired,
            "p_value": p_value,
            "failures_a": int(np.isinf(errors_a).sum()),
            "failures_b": int(np.isinf(errors_b).sum()),
        }

    @cached_property
    def shared_targets(self) -> set[str]:
        """Targets that both comparisons have, with the same true parameters and the same start.

        Only runs on shared targets can be compared in pairs.
        """
        a, b = self.a.targets, self.b.targets
        if list(a.columns) != list(b.columns):
            return set()
        names = [name for name in a.index if name in b.index]
        is_close = np.isclose(
            a.loc[names].to_numpy(dtype=float),
            b.loc[names].to_numpy(dtype=float),
            rtol=_TARGET_TOLERANCE,
            atol=0.0,
            equal_nan=True,
        )
        return {
            name for name, is_equal in zip(names, is_close.all(axis=1), strict=True) if is_equal
        }

    @cached_property
    def statuses(self) -> list[dict[str, Any]]:
        """Numbers of runs by tuner and status that differ between the comparisons.

        A status is the way a run ended, such as ``done`` or ``timeout``. There is one row for each
        tuner and status, with the numbers of both comparisons under ``a`` and ``b``.
        """
        counts_a, counts_b = (
            Counter(zip(s.stored.statuses["tuner"], s.stored.statuses["status"], strict=True))
            for s in (self.a, self.b)
        )
        return [
            {
                "tuner": tuner,
                "status": status,
                "a": counts_a[tuner, status],
                "b": counts_b[tuner, status],
            }
            for tuner, status in sorted({*counts_a, *counts_b})
            if counts_a[tuner, status] != counts_b[tuner, status]
        ]

    @cached_property
    def unshared_tuners(self) -> dict[str, list[str]]:
        """Tuners that only one of the comparisons has."""
        tuners_a, tuners_b = (s.curves.list_tuners() for s in (self.a, self.b))
        return {
            "a": [t for t in tuners_a if t not in tuners_b],
            "b": [t for t in tuners_b if t not in tuners_a],
        }

    @property
    def has_changed(self) -> bool:
        """True if an error differs significantly, or the fraction of failed runs differs."""
        return bool(len(self._select_significant_errors())) or any(
            a != b for a, b in self._compute_failure_shares()
        )

    @property
    def is_worse(self) -> bool:
        """True if an error has grown significantly, or the fraction of failed runs has grown."""
        significant_errors = self._select_significant_errors()
        has_grown = bool(len(significant_errors) and (significant_errors["ratio"] > 1).any())
        return has_grown or any(b > a for a, b in self._compute_failure_shares())

    def _select_significant_errors(self) -> pd.DataFrame:
        return self.errors[self.errors["significant"]] if len(self.errors) else self.errors

    def _compute_failure_shares(self) -> Iterator[tuple[float, float]]:
        """Yield the fractions of failed runs in both comparisons, for each common tuner.

        Skipped runs count as failed, because they have no result either.
        """
        frames = [s.stored.statuses for s in (self.a, self.b)]
        for tuner in self.a.curves.list_tuners():
            if tuner not in self.unshared_tuners["a"]:
                share_a, share_b = (
                    f.loc[f["tuner"] == tuner, "status"].isin(FAILED_OR_SKIPPED_STATUSES).mean()
                    for f in frames
                )
                yield float(share_a), float(share_b)

    def _list_shown_statuses(self) -> list[dict[str, Any]]:
        """List the changed status counts that are printed.

        Counts other than failures are included only if both comparisons have the same number of
        runs of the tuner; otherwise they differ in any case.
        """
        runs_a, runs_b = (s.stored.statuses["tuner"].value_counts() for s in (self.a, self.b))
        return [
            change
            for change in self.statuses
            if change["status"] in FAILED_OR_SKIPPED_STATUSES
            or runs_a.get(change["tuner"]) == runs_b.get(change["tuner"])
        ]

    @cached_property
    def notes(self) -> list[str]:
        """Notes on limitations of the comparison.

        One note says that no difference can be significant if there are too few targets for the
        number of lines that are compared.
        """
        notes = []
        error_table = self.errors
        if not len(error_table):
            return ["no range and tuner is in both comparisons"]
        if not error_table["paired"].any():
            notes.append("no target is in both (each salt draws its own): not paired")
        elif not error_table["paired"].all():
            notes.append("some lines are not paired: their targets are not in both")
        min_p_value = min(
            _compute_min_attainable_p_value(n, p)
            for n, p in zip(error_table["targets"], error_table["paired"], strict=True)
        )
        if min_p_value * len(error_table) > FAMILYWISE_ERROR_RATE:
            notes.append(
                f"no difference can be significant: with {error_table['targets'].max()} targets "
                f"a p-value is at least {min_p_value:.2g}, and {len(error_table)} lines are "
                "compared"
            )
        return notes

    def to_document(self) -> dict[str, Any]:
        """Convert the differences between two comparisons to a JSON document.

        The document follows the schema ``diff``; `a` and `b` are the two comparisons.
        """
        experiments = [s.stored.experiment for s in (self.a, self.b)]
        environments = [read_environment(s.folder) for s in (self.a, self.b)]
        side_documents = [
            describe_side(s.folder, e.name, environment)
            for s, e, environment in zip((self.a, self.b), experiments, environments, strict=True)
        ]
        return {
            "kind": "comparison",
            "changed": self.has_changed,
            "worse": self.is_worse,
            "a": side_documents[0],
            "b": side_documents[1],
            "errors": self.errors.to_dict("records"),
            "statuses": self.statuses,
            "only": self.unshared_tuners,
            "configuration": find_changes(*(experiment.document() for experiment in experiments)),
            "environment": find_changes(*map(select_relevant_environment, environments)),
            "notes": self.notes,
        }

    def format_lines(self) -> list[str]:
        """Format the differences as text lines.

        The table has the significant lines and those after all simulations; changed statuses,
        tuners, settings and notes follow.
        """
        document = self.to_document()
        rows = document["errors"]
        last = max((row["simulations"] for row in rows), default=0)
        return format_diff(
            document,
            metric=self.metric,
            listed=[row for row in rows if row["significant"] or row["simulations"] == last],
            shown_statuses=self._list_shown_statuses(),
        )

    def to_table(self) -> pd.DataFrame:
        """Return the table for a CSV file."""
        return self.errors


def _compare_unpaired(a: Array, b: Array) -> tuple[float, float]:
    """Compute the ratio of the medians of b over a, and the p-value of the Mann-Whitney test."""
    from scipy.stats import mannwhitneyu

    ratio = float(np.exp(np.clip(np.median(b) - np.median(a), -700, 700)))
    return ratio, float(mannwhitneyu(a, b).pvalue)


def _compute_min_attainable_p_value(targets: int, paired: bool) -> float:
    """Compute the smallest two-sided p-value that is possible with a number of targets.

    It is reached if one comparison is better on all of them: of the 2^n signs of n differences
    (Wilcoxon's signed-rank test), or of the (2n over n) orders of two samples (Mann-Whitney test),
    only two are so extreme.

    Args:
        targets: number n of targets of each comparison.
        paired: whether both comparisons have the same targets.
    """
    return 2.0 / 2**targets if paired else 2.0 / math.comb(2 * targets, targets)


@dataclass(frozen=True)
class ExplanationSide:
    """One of two explanations.

    Attributes:
        folder: its folder.
        verdict: its verdict.
        title: title of its extended simulator.
        environment: versions, settings and machine with which it was made.
    """

    folder: Path
    verdict: Verdict
    title: str
    environment: Mapping[str, Any]

    @property
    def settings(self) -> dict[str, Any]:
        """System, settings, recordings, versions and machine of the explanation.

        Two explanations can only be expected to agree if these are equal.
        """
        environment = self.environment
        recordings = {
            recording["file"]: recording["sha256"]
            for recording in environment.get("recordings", [])
        }
        base_settings = {"system": self.verdict.system, "engine": self.verdict.engine}
        return {
            **base_settings,
            "settings": environment.get("settings", {}),
            "recordings": recordings,
            **select_relevant_environment(environment),
        }

    def classify_effect(self, effect: str) -> str:
        """Return whether an effect is a cause, an alternative to one, or neither."""
        if any(cause.effect == effect for cause in self.verdict.causes):
            return "cause"
        if any(effect in cause.alternatives for cause in self.verdict.causes):
            return "alternative"
        return "no"


def load_explanation_side(folder: Path) -> ExplanationSide:
    """Load one of two explanations.

    Raises:
        InputError: the folder has no explanation, or it is damaged.
    """
    verdict = read_verdict(folder)
    title = str(read_toml(folder / EXTENDED_MODEL_FILE).get("title", ""))
    return ExplanationSide(folder, verdict, title, read_environment(folder))


@dataclass(frozen=True)
class ExplanationDiff:
    """Differences between two explanations.

    Attributes:
        a: first explanation.
        b: second explanation.
    """

    a: ExplanationSide
    b: ExplanationSide

    @cached_property
    def causes(self) -> list[dict[str, Any]]:
        """All effects that either explanation names, with their roles in both.

        A cause is an effect that explains the data; an alternative is one that the data do not
        distinguish from it.

        Roles are those of `ExplanationSide.classify_effect`: a cause, an alternative of a cause, or
        neither.
        """
        effect_names = [
            effect
            for side in (self.a, self.b)
            for cause in side.verdict.causes
            for effect in (cause.effect, *cause.alternatives)
        ]
        return [
            {
                "effect": effect,
                "in_a": self.a.classify_effect(effect),
                "in_b": self.b.classify_effect(effect),
            }
            for effect in dict.fromkeys(effect_names)
        ]

    @cached_property
    def numbers(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Coefficients and parameters of either explanation, with intervals and significance.

        A difference is significant if its p-value, with Holm's correction over all numbers, is
        below `FAMILYWISE_ERROR_RATE`.

        Returns:
            Rows of coefficients, and rows of parameters.
        """
        coefficients = _pair_coefficients(
            _collect_coefficients(self.a), _collect_coefficients(self.b)
        )
        parameters = _pair_coefficients(self.a.verdict.parameters, self.b.verdict.parameters)
        # The rows of both lists together; each row gets a further entry below.
        rows = [*coefficients, *parameters]
        corrected = correct_holm(np.array([_compute_normal_p_value(row) for row in rows]))
        for row, value in zip(rows, corrected, strict=True):
            # A number without a p-value, because a side or an interval is missing, gets None.
            row["significant"] = bool(value < FAMILYWISE_ERROR_RATE) if np.isfinite(value) else None
        return coefficients, parameters

    @property
    def has_changed(self) -> bool:
        """True if verdict or causes differ, or a number differs significantly."""
        has_other_verdict = self.a.verdict.verdict != self.b.verdict.verdict
        has_other_numbers = any(row["significant"] for rows in self.numbers for row in rows)
        # An effect is a cause in one explanation, and not in the other one.
        has_other_causes = any(
            "cause" in pair and len(set(pair)) > 1 for pair in self._list_cause_places()
        )
        return has_other_verdict or has_other_numbers or has_other_causes

    def _list_cause_places(self) -> list[tuple[str, str]]:
        """Return the role of each effect in both explanations; see `causes`."""
        return [(cause["in_a"], cause["in_b"]) for cause in self.causes]

    @property
    def is_worse(self) -> bool:
        """Unavailable: of two explanations, neither is worse.

        Raises:
            InputError: always.
        """
        raise InputError("--fail-on worse: only for comparisons; for explanations use change")

    def _list_held_out_errors(self) -> list[dict[str, Any]]:
        """List errors on held-out runs and the closed gap of both explanations; None if missing."""
        errors = [side.verdict.heldout for side in (self.a, self.b)]
        return [
            {"name": name, "a": getattr(errors[0], name, None), "b": getattr(errors[1], name, None)}
            for name in _HELD_OUT_FIELDS
        ]

    def _compare_candidates(self) -> list[dict[str, Any]]:
        """Return the best candidates of either explanation, with score and rank in both.

        Candidates are the effects that were tested as causes, ranked by their score (the gain of
        log-likelihood by the effect alone). One that an explanation does not rank has None as its
        score and rank there.
        """
        # Rank and score of each candidate by its effect, for both explanations.
        ranked = [
            {c.effect: (rank, c.score) for rank, c in enumerate(side.verdict.candidates, 1)}
            for side in (self.a, self.b)
        ]
        # Those among the best of at least one explanation.
        names = [
            effect
            for side in ranked
            for effect, (rank, _) in side.items()
            if rank <= _MAX_COMPARED_CANDIDATES
        ]
        rows = []
        for name in dict.fromkeys(names):
            (rank_a, score_a), (rank_b, score_b) = (side.get(name, (None, None)) for side in ranked)
            scores = {"score_a": score_a, "score_b": score_b}
            rows.append({"effect": name, **scores, "rank_a": rank_a, "rank_b": rank_b})
        return rows

    @cached_property
    def notes(self) -> list[str]:
        """Notes on limitations of the comparison."""
        notes = []
        if not (self.a.environment and self.b.environment):
            notes.append("settings and versions of the older explanation are not known")
        units = [side.verdict.heldout.unit for side in (self.a, self.b) if side.verdict.heldout]
        if len(set(units)) > 1:
            notes.append(f"held-out errors are in {units[0]} and in {units[1]}")
        if self.a.verdict.system != self.b.verdict.system:
            notes.append(f"different systems: {self.a.verdict.system} and {self.b.verdict.system}")
        return notes

    def to_document(self) -> dict[str, Any]:
        """Convert the differences between two explanations to a JSON document.

        The document follows the schema ``diff``; `a` and `b` are the two explanations.
        """
        coefficients, parameters = self.numbers
        side_documents = [
            describe_side(side.folder, side.title, side.environment) for side in (self.a, self.b)
        ]
        return {
            "kind": "explanation",
            "changed": self.has_changed,
            "a": side_documents[0],
            "b": side_documents[1],
            "verdict": {"a": self.a.verdict.verdict, "b": self.b.verdict.verdict},
            "causes": self.causes,
            "coefficients": coefficients,
            "parameters": parameters,
            "heldout": self._list_held_out_errors(),
            "candidates": self._compare_candidates(),
            "settings": find_changes(self.a.settings, self.b.settings),
            "notes": self.notes,
        }

    def format_lines(self) -> list[str]:
        """Format the differences as text lines.

        The lines have the verdict, causes, fitted numbers, held-out errors, ranks of candidates,
        settings and notes.
        """
        return format_diff(self.to_document())

    def to_table(self) -> pd.DataFrame:
        """Return the table for a CSV file."""
        coefficients, parameters = self.numbers
        held_out = [
            {**row, "name": f"heldout {row['name']}"} for row in self._list_held_out_errors()
        ]
        return pd.DataFrame([*coefficients, *parameters, *held_out])


def _collect_coefficients(side: ExplanationSide) -> dict[str, FittedValue]:
    """Return the coefficients of all causes of an explanation, by effect and coefficient name."""
    return {
        f"{cause.effect} {name}": value
        for cause in side.verdict.causes
        for name, value in cause.coefficients.items()
    }


def _pair_coefficients(
    a: Mapping[str, FittedValue], b: Mapping[str, FittedValue]
) -> list[dict[str, Any]]:
    """Write the numbers of two explanations into one row per name.

    A row has name and unit, and for each explanation the value and its 95 % interval (low, high).
    An explanation without this number has None in all three columns.

    Args:
        a: numbers of the first explanation, by name.
        b: numbers of the second one.
    """
    rows = []
    for name in dict.fromkeys([*a, *b]):
        value_a, value_b = a.get(name), b.get(name)
        any_value = value_a or value_b
        assert any_value is not None
        row: dict[str, Any] = {"name": name, "unit": any_value.unit}
        for side_name, value in (("a", value_a), ("b", value_b)):
            row |= {
                side_name: value.value if value else None,
                f"low_{side_name}": value.low if value else None,
                f"high_{side_name}": value.high if value else None,
            }
        rows.append(row)
    return rows


def _compute_normal_p_value(row: Mapping[str, Any]) -> float:
    """Compute the p-value of no difference; NaN if an interval is open or a number is missing.

    The standard errors follow from the 95 % intervals of both numbers; the difference is assumed to
    be normally distributed.

    Args:
        row: Values `a` and `b` with the limits `low_a`, `high_a`, `low_b` and `high_b`.
    """
    numbers = [row[key] for key in ("low_a", "high_a", "low_b", "high_b", "a", "b")]
    if any(number is None for number in numbers):
        return math.nan
    standard_errors = [
        (row[f"high_{side}"] - row[f"low_{side}"]) / (2 * _NORMAL_95) for side in ("a", "b")
    ]
    difference = abs(row["a"] - row["b"])
    # Standard error of the difference of two independent numbers.
    difference_error = math.hypot(*standard_errors)
    if difference_error == 0:
        return 1.0 if difference == 0 else 0.0
    # Two-sided tail of the normal distribution.
    return math.erfc(difference / difference_error / math.sqrt(2))


def find_changes(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Find the differences between two trees of values.

    Args:
        a: first tree.
        b: second tree.

    Returns:
        For each dotted key that differs, the values in both; None where the key does not exist.
    """
    flat_a, flat_b = dict(_flatten_table(a)), dict(_flatten_table(b))
    return [
        {"what": key, "a": flat_a.get(key), "b": flat_b.get(key)}
        for key in sorted({*flat_a, *flat_b})
        if flat_a.get(key) != flat_b.get(key)
    ]


def _flatten_table(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables, each with its path such as ``noise.q``.

    A tuple becomes a list, so that it equals the list read from a file.

    Args:
        value: tables that may contain tables.
        prefix: path of `value` with its final dot, such as ``noise.``; empty for the outermost one.

    Yields:
        Path and value.
    """
    for key, item in value.items():
        if isinstance(item, Mapping):
            yield from _flatten_table(item, f"{prefix}{key}.")
        elif isinstance(item, list | tuple):
            yield f"{prefix}{key}", list(item)
        else:
            yield f"{prefix}{key}", item


def select_relevant_environment(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Select the part of an environment that may influence results, with the hash of the code."""
    selected = {key: environment[key] for key in RESULT_RELEVANT_KEYS if key in environment}
    code = environment.get("fingerprint", {}).get("code")
    return {**selected, **({"code": code} if code else {})}


def describe_side(folder: Any, name: str, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Describe one of the two compared results for the JSON document.

    Args:
        folder: its folder.
        name: name of the experiment, or title of the explanation.
        environment: content of its environment.json.
    """
    return {
        "folder": folder,
        "name": name,
        "simgap": environment.get("simgap", ""),
        "started": environment.get("started"),
    }


def format_diff(document: Mapping[str, Any], **values: Any) -> list[str]:
    """Format a document of the schema ``diff`` as text lines.

    Args:
        document: differences between two comparisons or two explanations.
        **values: further values of the template.
    """
    # Lists of changes that only one of the two kinds of documents has.
    changes: dict[str, Any] = {"configuration": (), "environment": (), "settings": ()}
    return render_text(_TEMPLATE, **{**changes, **document, **values}, max_changes=_MAX_CHANGES)
