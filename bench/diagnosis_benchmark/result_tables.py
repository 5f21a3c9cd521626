"""Tables of a comparison of diagnosers: one row per answer, and the tables computed from them.

Fractions of false alarms and of missing answers have 95 % intervals of Clopper and Pearson
(Biometrika 26, 404, 1934), which keep their level for rare events too; other fractions have 95 %
intervals of Wilson (J. Am. Stat. Assoc. 22, 209, 1927). Two diagnosers are compared on the same
cases by McNemar's exact test (Psychometrika 12, 153, 1947); all pairs with simgap are corrected
together by Holm's method (Scand. J. Stat. 6, 65, 1979).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bench.benchmark.statistics.paired_tests import compute_mcnemar_p_value, correct_holm
from bench.benchmark.statistics.proportion_interval import compute_proportion_interval
from bench.benchmark.storage.csv_reader import CsvTable
from bench.benchmark.storage.table_schemas import Columns, ColumnSpec, EmptyCellRule
from bench.diagnosis_benchmark.answer_store import AnswersByCase
from bench.diagnosis_benchmark.case_generation.benchmark_case import CASE_KINDS, BenchmarkCase
from bench.diagnosis_benchmark.grading import grade_answer

MIN_GRADED_SIZE = 1.0
"""Minimum size of an effect that must be diagnosed, in units of the noise."""
P_VALUE_LEVELS = (0.01, 0.05, 0.1, 0.2, 0.5)
"""Significance levels at which p-values of clean recordings are counted."""
TARGET_FALSE_ALARM_RATE = 0.01
"""Maximum acceptable fraction of false alarms, drawn as a reference line."""
REFERENCE_DIAGNOSER = "simgap"
"""Diagnoser with which all others are compared."""
SET_SIZE_BINS = {"1": (1, 1), "2": (2, 2), "3 to 4": (3, 4), "5 or more": (5, 10**6)}
"""Bins of set sizes, as inclusive (low, high), by label."""
CONDITIONS = ("system", "noise", "stated", "rate", "runs", "source", "driven")
"""Recording conditions by which answers are counted."""

PRIMARY_METRIC = "the same, up to equivalence"
"""Primary metric: cause named alone or in a set of at most two, equivalent effects counted once."""

CASE_COLUMNS = ("noise", "stated", "rate", "seconds", "runs", "source", "driven", "size", "beyond")
"""Attributes of a case that are columns of a result row."""
SKIPPED_STATUS = "skipped"
"""Status and outcome of a case that the diagnoser does not support."""
RUN_SECONDS_COLUMN = "run_seconds"
"""Column of the length of a run; the column `seconds` is the time of an answer."""
_MAX_REASON_LENGTH = 200
"""Maximum length of the reason of a missing answer in a result row, characters."""


def build_answer_rows(answered: AnswersByCase, diagnosers: Sequence[str]) -> pd.DataFrame:
    """Build the result rows, one per answer, ordered by diagnoser and then by case.

    Args:
        answered: stored answers by name of the case.
        diagnosers: names of the diagnosers.
    """
    rows = [row for name in diagnosers for row in _iterate_rows(name, answered)]
    return pd.DataFrame(rows)


def _iterate_rows(diagnoser: str, answers: AnswersByCase) -> Iterator[dict[str, Any]]:
    """Yield the result rows of one diagnoser, ordered by the name of the case.

    A case is left out if it was not drawn (its stored document has no hidden effects) or if this
    diagnoser has not answered it.

    Args:
        diagnoser: name of the diagnoser.
        answers: by name of the case, its document (``item``) and the stored answers (``rows``).
    """
    for question, answer in sorted(answers.items()):
        # The case could not be drawn, or its worker was lost before it was drawn.
        if "effects" not in answer["item"] or diagnoser not in answer["rows"]:
            continue
        yield build_answer_row(
            question, BenchmarkCase.from_document(answer["item"]), answer["rows"][diagnoser]
        )


def build_answer_row(
    question: str, case: BenchmarkCase, stored_answer: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the result row of one answer: its case, true causes, answer, grade and cost.

    The rows of all answers are the file items.csv, from which all tables and figures are computed.

    Args:
        question: name of the case.
        case: the case with its true causes.
        stored_answer: stored answer of one diagnoser, with its status, reason and cost.

    Returns:
        Values by column. ``found`` and ``found_class`` tell whether the cause was identified
        without and with equivalent effects counted as one. ``alarm`` tells whether the diagnoser
        says that something is missing; a missing answer counts as an alarm. ``intervals`` is the
        number of closed 95 % intervals, ``holding`` how many of them contain the true value.
    """
    answer = stored_answer["answer"]
    grade = grade_answer(case, answer)
    known_coverage = [covered for covered in grade.covered.values() if covered is not None]
    causes = answer["causes"] if answer else []
    # The last line of a traceback states the error.
    reason_lines = stored_answer["reason"].strip().splitlines()
    case_columns = {name: getattr(case, name) for name in CASE_COLUMNS}
    # The column "seconds" is the time of the answer; the length of a run has another name.
    case_columns[RUN_SECONDS_COLUMN] = case_columns.pop("seconds")
    return {
        "question": question,
        "diagnoser": stored_answer["diagnoser"],
        "kind": case.kind,
        "system": case.system,
        "hidden": " + ".join(case.effects),
        **case_columns,
        "channels": " ".join(case.channels),
        "status": stored_answer["status"],
        "reason": reason_lines[-1][:_MAX_REASON_LENGTH] if reason_lines else "",
        "verdict": answer["verdict"] if answer else "",
        "named": grade.named,
        "outcome": SKIPPED_STATUS if stored_answer["status"] == SKIPPED_STATUS else grade.outcome,
        "set_size": grade.set_size,
        "class_size": grade.class_size,
        "largest_set": max((1 + len(cause["alternatives"]) for cause in causes), default=0),
        "found": grade.is_correct,
        "found_class": grade.is_correct_up_to_equivalence,
        "alarm": answer is None or answer["verdict"] != "adequate",
        "p_value": answer["p_value"] if answer else None,
        "intervals": len(known_coverage),
        "holding": sum(known_coverage),
        "simulations": stored_answer["simulations"],
        "seconds": stored_answer["seconds"],
        "processor_seconds": stored_answer["processor_seconds"],
        "trusted": stored_answer["trusted"],
    }


TableRow = dict[str, Any]
RowFilter = Callable[[pd.DataFrame], pd.DataFrame]
RowPredicate = Callable[[pd.DataFrame], "pd.Series[bool]"]


class Metric(NamedTuple):
    """Fraction of the selected answers for which a predicate holds.

    Attributes:
        name: name of the metric.
        select: selects the answers that count.
        predicate: returns whether each of them is a success.
        is_exact: whether to use the Clopper-Pearson interval instead of Wilson's.
    """

    name: str
    select: RowFilter
    predicate: RowPredicate
    is_exact: bool = False


def compute_share(hits: int, of: int, exact: bool = False) -> TableRow:
    """Compute a fraction with its 95 % interval.

    Args:
        hits: number of successes.
        of: number of trials.
        exact: whether to use the Clopper-Pearson interval instead of Wilson's.

    Returns:
        The keys count, of, share, low and high; the last three are NaN without trials.
    """
    low, high = compute_proportion_interval(hits, of, "exact" if exact else "wilson")
    share = hits / of if of else np.nan
    return {"count": hits, "of": of, "share": share, "low": low, "high": high}


def _compute_share(successes: pd.Series[bool], is_exact: bool = False) -> TableRow:
    """Count the successes and compute their fraction with its 95 % interval, as one table row.

    Args:
        successes: whether each case is a success.
        is_exact: whether the interval is exact (Clopper-Pearson) and not Wilson's.
    """
    return compute_share(int(successes.sum()), len(successes), is_exact)


def select_single_effects(rows: pd.DataFrame) -> pd.DataFrame:
    """Select cases with one hidden effect that is large enough to be diagnosed."""
    return rows[(rows["kind"] == "single") & (rows["size"] >= MIN_GRADED_SIZE)]


def select_clean(rows: pd.DataFrame) -> pd.DataFrame:
    """Select cases without a hidden cause."""
    return rows[rows["kind"] == "clean"]


def _select_foreign(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["kind"] == "foreign"]


def _is_in_any_set(rows: pd.DataFrame) -> pd.Series[bool]:
    """Return whether the cause is in a named set of any size and no other cause is named."""
    return rows["outcome"].isin(("right", "set"))


def _is_right(rows: pd.DataFrame) -> pd.Series[bool]:
    return rows["outcome"] == "right"


def _is_named(rows: pd.DataFrame) -> pd.Series[bool]:
    return rows["found_class"]


def _is_alarm(rows: pd.DataFrame) -> pd.Series[bool]:
    return rows["alarm"]


METRICS = (
    Metric("false alarms", select_clean, _is_alarm, is_exact=True),
    Metric("named, alone", select_single_effects, _is_right),
    Metric("named, in a set of at most two", select_single_effects, lambda rows: rows["found"]),
    Metric(PRIMARY_METRIC, select_single_effects, _is_named),
    Metric("named, in a set of any size", select_single_effects, _is_in_any_set),
    Metric("something seen", select_single_effects, _is_alarm),
    Metric("pairs: both named", lambda rows: rows[rows["kind"] == "double"], _is_named),
    Metric("foreign causes: unknown or partial", _select_foreign, _is_right),
    Metric("without an answer", lambda rows: rows, lambda rows: rows["status"] != "done", True),
)
"""Metrics of the table of all metrics."""
GROUPED_METRICS = (
    (Metric("false alarms", select_clean, _is_alarm, is_exact=True), CONDITIONS),
    (Metric("named", select_single_effects, _is_named), (*CONDITIONS, "hidden")),
    (Metric("foreign", _select_foreign, _is_right), ("hidden", "system")),
)
"""Metrics that are counted by group, with the columns that define the groups."""
PAIR_METRICS = (
    Metric("named", select_single_effects, _is_named),
    Metric("named, alone", select_single_effects, _is_right),
    Metric("no false alarm", select_clean, lambda rows: ~rows["alarm"]),
)
"""Metrics by which each diagnoser is compared with simgap."""


def _list_metrics(diagnoser_rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the lines of table.csv for one diagnoser: the fraction of each metric.

    Args:
        diagnoser_rows: Graded answers of one diagnoser, one row per case.
    """
    for metric in METRICS:
        successes = metric.predicate(metric.select(diagnoser_rows))
        yield {"metric": metric.name, **_compute_share(successes, metric.is_exact)}
    intervals = compute_share(
        int(diagnoser_rows["holding"].sum()), int(diagnoser_rows["intervals"].sum())
    )
    yield {"metric": "95 % intervals that hold", **intervals}


def _list_groups(diagnoser_rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the lines of groups.csv for one diagnoser: metrics by system, noise, rate and so on.

    Args:
        diagnoser_rows: graded answers of one diagnoser, one row per case.

    Yields:
        Metric, column that defines the groups (``by``), its value in this group, and the fraction.
    """
    for metric, columns in GROUPED_METRICS:
        for column in columns:
            for value, part in metric.select(diagnoser_rows).groupby(column):
                group = {"metric": metric.name, "by": column, "value": str(value)}
                yield {**group, **_compute_share(metric.predicate(part), metric.is_exact)}


def _list_power(diagnoser_rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the lines of power.csv: fractions of single effects named and detected, by their size.

    All sizes are counted, also those that are too small to be graded.
    """
    for size, part in diagnoser_rows[diagnoser_rows["kind"] == "single"].groupby("size"):
        for metric, successes in (("named", _is_named(part)), ("seen", _is_alarm(part))):
            yield {"size": size, "metric": metric, **_compute_share(successes)}


def _list_calibration(diagnoser_rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the lines of calibration.csv: fraction of clean recordings with p at most a level.

    A diagnoser without p-values has no lines. For a calibrated p-value this fraction equals the
    level.

    Args:
        diagnoser_rows: graded answers of one diagnoser, one row per case.
    """
    p_values = pd.to_numeric(select_clean(diagnoser_rows)["p_value"]).dropna()
    for level in P_VALUE_LEVELS if len(p_values) else ():
        yield {"level": level, **_compute_share(p_values <= level, is_exact=True)}


def _list_set_sizes(diagnoser_rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the lines of sets.csv: answers about single effects by the size of their largest set.

    A set contains the effects that an answer cannot distinguish. The fraction is that of the
    answers whose sets contain the true cause. Large sets contain it more easily but tell less.

    Args:
        diagnoser_rows: graded answers of one diagnoser, one row per case.
    """
    single_rows = select_single_effects(diagnoser_rows)
    for label, (low, high) in SET_SIZE_BINS.items():
        part = single_rows[single_rows["largest_set"].between(low, high)]
        yield {"largest_set": label, **_compute_share(_is_in_any_set(part))}


def _list_costs(diagnoser_rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the line of costs.csv for one diagnoser: medians and 95 % quantiles.

    Args:
        diagnoser_rows: rows of the diagnoser. Only finished answers count; the costs are
            simulations, processor time and elapsed time, s.
    """
    finished_rows = diagnoser_rows[diagnoser_rows["status"] == "done"]
    line: TableRow = {"answers": len(finished_rows)}
    for column in ("simulations", "processor_seconds", "seconds"):
        values = pd.to_numeric(finished_rows[column]).dropna().to_numpy(dtype=float)
        for name, quantile in (("median", 0.5), ("p95", 0.95)):
            line[f"{column}_{name}"] = np.quantile(values, quantile) if values.size else np.nan
    yield line


def build_confusion_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build confusion.csv: how often each hidden cause was answered with each name.

    An answer counts under the leading name of its cause. Cases with two hidden effects are left
    out.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.

    Returns:
        Columns ``diagnoser``, ``hidden`` (the hidden cause), ``said`` (the answer) and ``count``.
    """
    graded_rows = rows[(rows["kind"] != "double") & rows["diagnoser"].isin(order)]
    # Cases without an effect of the library are counted under their kind, as "(clean)": `where`
    # replaces the rows for which the condition does not hold.
    hidden = graded_rows["hidden"].where(
        graded_rows["kind"] == "single", "(" + graded_rows["kind"] + ")"
    )
    answers = zip(graded_rows["verdict"].astype(str), graded_rows["named"].astype(str), strict=True)
    graded_rows = graded_rows.assign(
        hidden=hidden, said=[_get_confusion_column(*answer) for answer in answers]
    )
    counted = graded_rows.groupby(["diagnoser", "hidden", "said"]).size()
    counts: pd.DataFrame = counted.rename("count").reset_index()
    return counts


def _get_confusion_column(verdict: str, named_effects: str) -> str:
    """Return the column of confusion.csv for an answer.

    Args:
        verdict: verdict of the answer; empty without an answer.
        named_effects: named causes, separated by " + ", alternatives separated by bars.

    Returns:
        Leading name of the only cause, ``(several)`` for several causes, or the verdict in brackets
        if no cause is named.
    """
    if verdict in ("", "adequate", "unknown", "unidentifiable") or not named_effects:
        return f"({verdict or 'nothing'})"
    return "(several)" if " + " in named_effects else named_effects.partition("|")[0]


def build_pair_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Compare each diagnoser with simgap on the same cases by McNemar's test.

    The test counts only the cases that exactly one of the two answered correctly. P-values are
    corrected by Holm's method for the number of diagnosers, within each metric. The table is empty
    if simgap takes no part.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.

    Returns:
        One row per metric and diagnoser: number of cases (``questions``), numbers of cases that
        only simgap or only the other one answered correctly, and the p-value before and after the
        correction.
    """
    columns = ["metric", "diagnoser", "questions", "only_simgap", "only_other", "p_value"]
    lines = []
    for metric in PAIR_METRICS:
        part = metric.select(rows)
        results_by_diagnoser = part.assign(right=metric.predicate(part)).pivot(
            index="question", columns="diagnoser", values="right"
        )
        if REFERENCE_DIAGNOSER not in results_by_diagnoser:
            continue
        for name in order:
            if name == REFERENCE_DIAGNOSER or name not in results_by_diagnoser:
                continue
            # Cases without a result of either of the two are left out.
            pairs = results_by_diagnoser[[REFERENCE_DIAGNOSER, name]].dropna().astype(int)
            advantages = pairs[REFERENCE_DIAGNOSER] - pairs[name]
            only_simgap, only_other = int((advantages > 0).sum()), int((advantages < 0).sum())
            p_value = compute_mcnemar_p_value(only_simgap, only_other)
            lines.append((metric.name, name, len(pairs), only_simgap, only_other, p_value))
    frame = pd.DataFrame(lines, columns=columns)
    frame["p_holm"] = frame.groupby("metric")["p_value"].transform(
        lambda p_values: correct_holm(p_values.to_numpy())
    )
    return frame


def index_by_diagnoser(frame: pd.DataFrame, metric: str = "") -> dict[str, TableRow]:
    """Convert the rows of a table to dictionaries, by the name of the diagnoser.

    Args:
        frame: table with a column diagnoser, and one row per diagnoser (and metric).
        metric: metric whose rows are used; empty for a table without a column metric.
    """
    if metric:
        frame = frame[frame["metric"] == metric]
    lines = [{str(key): value for key, value in line.items()} for line in frame.to_dict("records")]
    return {str(line["diagnoser"]): line for line in lines}


def select_fully_answered_cases(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Select the cases that every diagnoser has answered, so that comparisons are fair.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    counts = rows.groupby("question")["diagnoser"].transform("nunique")
    selected: pd.DataFrame = rows[counts == len(order)]
    return selected


def build_all_tables(
    rows: pd.DataFrame, order: Sequence[str], training: Sequence[dict[str, str]]
) -> dict[str, pd.DataFrame]:
    """Build every table, by the name of its file.

    Most tables have lines for each diagnoser; two compare diagnosers or causes and are built from
    all rows.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
        training: rows of training.csv, one per diagnoser and system.
    """
    lines: dict[str, list[TableRow]] = {name: [] for name in _LINES_OF_TABLES}
    for name in order:
        diagnoser_rows = rows[rows["diagnoser"] == name]
        for table, list_lines in _LINES_OF_TABLES.items():
            lines[table] += [{"diagnoser": name, **line} for line in list_lines(diagnoser_rows)]
    # The cost of the training is stored apart from the answers.
    for line in lines["costs"]:
        costs = [cost for cost in training if cost["diagnoser"] == line["diagnoser"]]
        line["training_simulations"] = sum(int(cost["simulations"]) for cost in costs)
        line["training_seconds"] = sum(float(cost["seconds"]) for cost in costs)
    return {
        **{
            table: pd.DataFrame(part, columns=[column.name for column in TABLE_COLUMNS[table]])
            for table, part in lines.items()
        },
        "confusion": build_confusion_table(rows, order),
        "pairs": build_pair_table(rows, order),
    }


_LINES_OF_TABLES: dict[str, Callable[[pd.DataFrame], Iterator[TableRow]]] = {
    "table": _list_metrics,
    "groups": _list_groups,
    "power": _list_power,
    "calibration": _list_calibration,
    "sets": _list_set_sizes,
    "costs": _list_costs,
}
"""Functions that list the lines of one diagnoser in a table, from its rows, by table."""
FAILURE_COLUMNS = (
    "diagnoser",
    "question",
    "kind",
    "system",
    "hidden",
    "size",
    "noise",
    "rate",
    "runs",
    "status",
    "verdict",
    "named",
    "outcome",
    "largest_set",
    "right_by",
)
"""Columns of the table of failures: a selection of items.csv, and who answered correctly."""


def is_correct(rows: pd.DataFrame) -> pd.Series[bool]:
    """Return whether each answer is correct.

    Correct is: no alarm for a clean recording; for hidden effects, all named alone or in sets of at
    most two, equivalent effects counted once; for an unmodelled cause (kind "foreign"), the
    statement that no effect of the library explains it. A missing answer is not correct.

    Args:
        rows: rows of items.csv, one per answer.
    """
    # True if all hidden effects are named, equivalent effects counted once.
    is_right = rows["found_class"].astype(bool)
    # `where` replaces the rows for which the condition does not hold.
    is_right = is_right.where(rows["kind"] != "clean", ~rows["alarm"].astype(bool))
    is_right = is_right.where(rows["kind"] != "foreign", _is_right(rows))
    return is_right & (rows["status"] == "done")


def select_graded_answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the graded answers: all except those on single effects smaller than one noise."""
    return rows[(rows["kind"] != "single") | (rows["size"] >= MIN_GRADED_SIZE)]


def build_failure_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build the table of incorrect graded answers, ordered by diagnoser, kind and case.

    The column ``right_by`` names the diagnosers that answered the same case correctly, or "nobody".

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    graded_rows = select_graded_answers(rows)
    graded_rows = graded_rows.assign(right=is_correct(graded_rows))
    correct_names = (
        graded_rows[graded_rows["right"]].groupby("question")["diagnoser"].agg(list).to_dict()
    )
    wrong_rows = graded_rows[~graded_rows["right"]].copy()
    correct_by_case = [
        [name for name in order if name in correct_names.get(question, ())]
        for question in wrong_rows["question"]
    ]
    wrong_rows["right_by"] = [" ".join(names) or "nobody" for names in correct_by_case]
    wrong_rows["position"] = wrong_rows["diagnoser"].map({name: i for i, name in enumerate(order)})
    failure_table: pd.DataFrame = wrong_rows.sort_values(["position", "kind", "question"])[
        list(FAILURE_COLUMNS)
    ]
    return failure_table.reset_index(drop=True)


def _declare(names: str, kind: type, **limits: Any) -> dict[str, ColumnSpec]:
    """Declare columns of one kind; `limits` are further attributes of `ColumnSpec`."""
    return {name: ColumnSpec(name, kind, **limits) for name in names.split()}


_COLUMNS = {
    **_declare("question diagnoser system noise source outcome metric by value said", str),
    **_declare("right_by", str),
    **_declare("kind", str, words=CASE_KINDS),
    **_declare("hidden channels status reason verdict named", str, empty=EmptyCellRule.MAY),
    **_declare("stated driven found found_class alarm trusted", bool),
    **_declare(
        "rate runs set_size class_size largest_set intervals holding simulations count of answers "
        "training_simulations questions only_simgap only_other",
        int,
        low=0,
    ),
    **_declare(
        "size beyond run_seconds seconds processor_seconds training_seconds simulations_median "
        "simulations_p95 processor_seconds_median processor_seconds_p95 seconds_median seconds_p95",
        float,
        low=0.0,
        empty=EmptyCellRule.MAY,
    ),
    **_declare(
        "share low high p_value p_holm level", float, low=0.0, high=1.0, empty=EmptyCellRule.MAY
    ),
}
"""Columns of all tables by name."""
TABLE_COLUMNS: dict[str, Columns] = {
    table: tuple(_COLUMNS[name] for name in names.split())
    for table, names in {
        "table": "diagnoser metric count of share low high",
        "failures": " ".join(FAILURE_COLUMNS),
        "groups": "diagnoser metric by value count of share low high",
        "power": "diagnoser size metric count of share low high",
        "confusion": "diagnoser hidden said count",
        "calibration": "diagnoser level count of share low high",
        "sets": "diagnoser largest_set count of share low high",
        "costs": "diagnoser answers simulations_median simulations_p95 processor_seconds_median "
        "processor_seconds_p95 seconds_median seconds_p95 training_simulations training_seconds",
        "pairs": "metric diagnoser questions only_simgap only_other p_value p_holm",
        "items": "question diagnoser kind system hidden noise stated rate runs source driven size "
        "beyond run_seconds channels status reason verdict named outcome set_size class_size "
        "largest_set found found_class alarm p_value intervals holding simulations seconds "
        "processor_seconds trusted",
    }.items()
}
# In this table, the size of the largest set is a range in words.
TABLE_COLUMNS["sets"] = tuple(
    ColumnSpec("largest_set", str) if column.name == "largest_set" else column
    for column in TABLE_COLUMNS["sets"]
)
STATUS_COLUMNS = ("question", "diagnoser", "status", "reason", "simulations", "seconds")
"""Columns of items.csv that describe how an answer was produced."""


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Read a table of a comparison of diagnosers.

    Args:
        folder: result folder of the comparison.
        name: one of `TABLE_COLUMNS`.

    Raises:
        InputError: the file does not exist or is damaged.
    """
    path = folder / f"{name}.csv"
    remedy = f"write it again with simgap plot {folder}"
    table: pd.DataFrame = CsvTable(path, TABLE_COLUMNS[name], remedy).table.to_pandas()
    return table


def build_leaderboard(table: pd.DataFrame) -> pd.DataFrame:
    """Build the leaderboard: one row per diagnoser and one column per metric.

    Args:
        table: the table of all metrics, see `result_tables.METRICS`.

    Returns:
        Fractions; the diagnoser with the highest primary metric comes first.
    """
    shares_by_metric = table.pivot(index="diagnoser", columns="metric", values="share")
    shares_by_metric = shares_by_metric[list(dict.fromkeys(table["metric"]))]
    sorted_shares: pd.DataFrame = shares_by_metric.sort_values(
        PRIMARY_METRIC, ascending=False, kind="stable"
    )
    return sorted_shares.rename_axis(columns=None).reset_index()
