"""Numbers of the cells of tables on pages, and tables that are written as a whole.

A function returns a function from a row (cells by heading, and the number of the column) and a
heading to the numbers of that cell; see `inserted_numbers`.
"""

import re

import numpy as np

from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.problem.tuning_problem import TuningProblem
from tests.benchmarks import real_recordings
from tests.docs.page_numbers.page_values import (
    SEVERAL,
    answers,
    covered,
    document,
    error,
    frame,
    grade,
    history,
    one,
    rows,
    so101_errors,
)
from tests.exams import exam_report

COSTS = {
    "samples": {
        "score": (100, 1000, 10000, 30000, 100000),
        "explain": (100, 1600, 6400, 25600, 100000),
    },
    "candidates": {"score": (5, 10, 30, 100, 300), "explain": (6, 12, 18, 24, 0)},
    "runs": {"score": (1, 3, 10, 30, 100), "explain": (0, 3, 10, 30, 100)},
}
"""Sizes in the table of costs, by growing quantity and measured command; 0 if not measured."""


def errors_by_simulations(folder):
    """Mean and, in brackets, median error of tuner and range after a number of simulations."""

    def numbers(row, heading):
        if not (heading.isdigit() or heading == "trained on"):
            return None
        if heading == "trained on":
            return [rows(f"{folder}/table.csv", tuner=row["tuner"]).fit_simulations.max()]
        where = folder, row["tuner"], row["range"], int(heading), "param_abs_error"
        return [error(*where), error(*where, "median")]

    return numbers


def errors_on_real_pendulum(row, heading):
    """Mean error on held-out runs; rows with one training come from a later run."""
    folder = "pendulum-real/later" if "(one training)" in row["tuner"] else "pendulum-real"
    tuner = row["tuner"].partition(" (")[0]
    if heading == "trained on":
        return [rows(f"{folder}/table.csv", tuner=tuner).fit_simulations.max()]
    if heading == "tuner" or row[heading] == "–":
        return None
    return [error(folder, tuner, "real", int(heading), "heldout_error")]


def errors_across_engines(row, heading):
    """Observation error, or error of restitution, after 50 simulations."""
    if heading == "tuner":
        return None
    kind = "wide" if "wide" in heading else "in"
    metric = "obs_error" if "[m]" in heading else "param_abs_error"
    return [error("ball-crossengine", row["tuner"], kind, 50, metric)]


def errors_of_comparison(row, heading):
    """Medians after 30 simulations, or the mean rank."""
    if heading == "tuner":
        return None
    if heading == "mean rank":
        return [frame("comparison/all/ranks.csv")[row["tuner"]].mean()]
    where = f"comparison/{heading}", row["tuner"]
    return [error(*where, kind, 30, "param_error", "median") for kind in ("in", "wide")]


def errors_of_several_parameters(row, heading):
    """Medians in range and wide after 50 simulations; each problem has a pair of columns."""
    if heading == "tuner":
        return None
    folder = f"multi/{SEVERAL[(row['column'] - 1) // 2]}"
    metric = "stiff_error" if heading.endswith("stiff") else "heldout_error"
    return [error(folder, row["tuner"], kind, 50, metric, "median") for kind in ("in", "wide")]


def study(name):
    """Mean errors of a variant of the TuneNet study, or the seconds of one training."""

    def numbers(row, heading):
        if heading == "network":
            return None
        path, where = f"tunenet-study/{name}.csv", {"variant": row["network"]}
        if heading == "training [s]":
            return [one(path, "train_seconds", **where, range="in")]
        kind, simulations = heading.split()
        return [one(path, f"mean_{simulations}", **where, range=kind)]

    return numbers


def exam_seconds(row, heading):
    """Statistics of the seconds of cases of one kind."""
    names = {
        "nothing hidden": "clean", "one cause": "single", "two causes": "double",
        "a foreign cause": "foreign",
    }  # fmt: skip
    graded = exam_report.graded(answers("exam/items.csv", kind=names[row[""]]))
    seconds = graded.cpu_s
    numbers = {
        "questions": len(seconds), "median, s": seconds.median(),
        "95th percentile": seconds.quantile(0.95), "most": seconds.max(),
    }  # fmt: skip
    return [numbers[heading]] if heading in numbers else None


def problem_sizes(row, heading):
    """Number of parameters or of held-out runs of an experiment."""
    name = row["experiment"].strip("`")
    if heading not in ("parameters", "unseen runs") or name.startswith("robot"):
        return None
    experiment = load_experiment(name)
    if heading == "unseen runs":
        return [experiment.held_out.scenarios]
    return [len(TuningProblem(experiment).cube.parameters)]


def identified_combinations(row, heading):
    """Parameter combinations that the data of a problem identify."""
    where = {"experiment": row["experiment"].strip("`"), "range": row["range"]}
    (mine,) = rows("multi/identified.csv", **where).itertuples()
    if heading in ("stiffest", "sloppiest"):
        value = getattr(mine, heading)
        assert (row[heading] == "none") == (value > 1e3)
        return [value]
    column = {"stiff directions (targets)": "stiff", "the sloppiest is mostly": "made_of"}
    if heading not in column:
        return None
    # The page lists only the largest shares, with other names for the parameters.
    shares = [float(number) for number in re.findall(r"\b\d+", getattr(mine, column[heading]))]
    joint = re.findall(r"of (?:joint|link) (\d)$", row[heading])
    count = len(re.findall(r"\b\d+", row[heading])) - len(joint)
    return [*shares[:count], *map(float, joint)]


def shot_hits(row, heading):
    """Hits and misses of a method."""
    method = row["method"].partition(" (its own")[0]
    if heading == "method":
        return None
    (whole,) = rows("bounce-shot/table.csv", ball="all", method=method).itertuples()
    mine = rows("bounce-shot/shots.csv", method=method)
    if heading.startswith("hits of 300"):
        return [whole.hits, *(100 * share for share in (whole.rate, whole.low, whole.high))]
    if heading.startswith("hits of 256"):
        seen = mine[mine.seen >= 0.95]
        return [seen.hit.sum(), 100 * seen.hit.mean()]
    if heading == "within 10 cm":
        return [100 * (mine.off.abs() <= 0.1).mean()]
    is_miss = heading == "median miss of the centre"
    return [100 * (whole.off_median if is_miss else whole.prediction_error_mean)]


def accuracy(row, heading):
    """Count, total, percentage and interval of the exams of systems and robots."""
    if heading == "":
        return None
    path = "robots/items.csv" if "robots" in heading else "exam/items.csv"
    kinds = {
        "one cause: named, or": ("single", "fair"), "one cause: named alone": ("single", "strict"),
        "two causes": ("double", "fair"), "a cause that": ("foreign", "strict"),
    }  # fmt: skip
    if row[""].startswith("nothing hidden"):
        clean = answers(path, kind="clean")
        got = exam_report.share(~clean.strict, exact=path.startswith("exam"))
    elif row[""].startswith("95 % intervals"):
        got = covered(path)
    else:
        ((kind, level),) = (names for words, names in kinds.items() if row[""].startswith(words))
        got = grade(path, kind, level)
    return [*got[:2], *(100 * part for part in got[2:])]


def so101_summary(row, joint):
    """Errors of a model over all held-out motions of the SO-101."""
    key = "six motions not fitted, RMSE in mrad"
    return None if joint == key else [so101_errors()["all six", row[key], joint]]


def costs():
    """Cost of a score or of explain at a size of the quantity named above, and the exponent."""
    quantity = ""

    def numbers(row, heading):
        nonlocal quantity
        parts = {"a score, ms": ("score", 1e3), "explain, s": ("explain", 1.0)}
        if row["against"] not in parts:
            quantity = row["against"].split()[0]
        if row["against"] not in parts or heading == "against" or not row["column"]:
            return None
        part, factor = parts[row["against"]]
        mine = rows("explain-cost/cost.csv", part=part, what=quantity)
        if heading == "exponent":
            larger = mine.iloc[len(mine) // 2 :]
            return [np.polyfit(np.log(larger["count"]), np.log(larger.seconds), 1)[0]]
        size = COSTS[quantity][part][row["column"] - 1]
        return [factor * mine.set_index("count").seconds[size]] if size else []

    return numbers


def history_errors(row, heading):
    """Mean error of a tuner after a number of simulations."""
    if not heading.isdigit():
        return None
    return [history(row["problem"], row["range"], int(heading), row["tuner"])]


def history_missing(row, heading):
    """Mean error of parameters or held-out runs before and after explain."""
    if heading in ("system", "tuner"):
        return None
    metric, model = divmod(row["column"] - 2, 2)
    where = {"experiment": f"misspecified-{row['system']}", "tuner": row["tuner"]}
    where |= {"metric": ("param_error", "heldout_error")[metric]}
    where |= {"model": ("plain", "extended")[model]}
    return [one("history/missing.csv", "mean", **where)]


def real_table():
    """Return the lines of the table of measured recordings."""
    verdicts = {name: document(f"real/{name}/verdict.json") for name in real_recordings.RECORDINGS}
    lines = [real_recordings.row(name, verdict) for name, verdict in verdicts.items()]
    return [*real_recordings.HEAD.splitlines(), *lines]
