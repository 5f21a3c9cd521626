"""Values that pages insert from the tables below results/reference.

Expressions in the marks of a page (`inserted_numbers.py`) may use every name of this module.
"""

import json
from functools import cache
from math import hypot

import pandas as pd
from scipy.stats import friedmanchisquare, spearmanr

from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from sims.core.toml_validation import read_toml
from tests.benchmarks.vision_error_bound import BOUND
from tests.docs.documentation_pages import ROOT, tables
from tests.exams import exam_report
from tests.exams.exam import read_table
from tests.sims.test_engines import TOLERANCE

__all__ = ["STIFF_SIGMA_THRESHOLD", "TOLERANCE", "hypot"]
REFERENCE = ROOT / "results" / "reference"
SEVERAL = ("ball-tilt", "pendulum-driven", "servo-friction", "arm-swing")
SIX = ("ball-drop", "slider-push", "pendulum-swing", "servo-step", "ball-wind", "ball-crossengine")


@cache
def frame(path):
    """Return a table below results/reference."""
    return pd.read_csv(REFERENCE / path)


@cache
def document(path):
    """Return a JSON file below results/reference."""
    return json.loads((REFERENCE / path).read_text(encoding="utf-8"))


def select(table, where):
    """Return the rows of a frame in which columns have these values."""
    for column, value in where.items():
        table = table[table[column] == value]
    return table


def rows(path, **where):
    """Return the rows of a table in which columns have these values."""
    return select(frame(path), where)


def one(path, column, **where):
    """Return the only cell of a column in the selected rows."""
    return rows(path, **where)[column].item()


def error(folder, tuner, kind, simulations, metric="param_abs_error", statistic="mean"):
    """Return a statistic of an error over targets after a number of simulations.

    A run that ended earlier counts with its last value.
    """
    table = rows(f"{folder}/table.csv", tuner=tuner, range=kind, metric=metric)
    row = table[table.simulations <= simulations].sort_values("simulations").iloc[-1]
    return row[statistic]


def median(folder, tuner, kind, simulations, metric="stiff_error"):
    """Return the median of `error`."""
    return error(folder, tuner, kind, simulations, metric, "median")


def history(experiment, kind, simulations, tuner):
    """Return the mean parameter error of a tuner; a run that ended keeps its last value."""
    table = rows("history/errors.csv", experiment=experiment, range=kind, tuner=tuner)
    return table[table.simulations <= simulations]["mean"].iloc[-1]


def missing(system, tuner, model):
    """Return the mean parameter error on a study of a missing effect, plain or extended."""
    where = {"experiment": f"misspecified-{system}", "tuner": tuner, "model": model}
    return one("history/missing.csv", "mean", metric="param_error", **where)


def noise(experiment):
    """Return the noise of an experiment's channels, in thousandths of their units."""
    return [1e3 * value for value in load_experiment(experiment).noise.values()]


def run_count(folder, problems):
    """Return the number of runs of several comparisons."""
    return sum(len(frame(f"{folder}/{problem}/status.csv")) for problem in problems)


def trainings(*folders):
    """Return the trainings of tunenet and hybrid."""
    table = pd.concat([frame(f"{folder}/training.csv") for folder in folders])
    return table[table.tuner.isin(["tunenet", "hybrid"])]


def break_even(folder, column, learned="tunenet", kind="in", threshold=0.1):
    """Return a cell of the table of break-even points against least_squares."""
    where = {"learned": learned, "search": "least_squares", "range": kind, "threshold": threshold}
    return one(f"{folder}/break_even.csv", column, **where)


def spread_correlation(kind):
    """Return the rank correlation of spread and error of the ensemble."""
    table = rows("tunenet-study/spread.csv", range=kind)
    return spearmanr(table["spread"], table["error"]).statistic


def within_two_spreads():
    """Return the percentage of errors within two spreads, by range."""
    table = frame("tunenet-study/spread.csv")
    return 100 * (table.error <= 2 * table.spread).groupby(table["range"]).mean()


def friedman_p_value():
    """Return the p-value of Friedman's test of the ranks of the comparison."""
    ranks = frame("comparison/all/ranks.csv").drop(columns="problem")
    return friedmanchisquare(*(ranks[tuner] for tuner in ranks)).pvalue


def simulations_to_pass_tunenet():
    """Return after how many simulations least_squares passes tunenet's first step."""
    runs = pd.read_parquet(REFERENCE / "pendulum-real" / "later" / "runs.parquet")
    search = runs[runs.tuner == "least_squares"].groupby("k").heldout_error.mean()
    return (search < error("pendulum-real", "tunenet", "real", 1, "heldout_error")).idxmax()


def hits(method):
    """Return the hits of a method over all balls."""
    return one("bounce-shot/table.csv", "hits", ball="all", method=method)


def drag_shots(ball):
    """Return how often explain names drag for a ball."""
    shots = rows("bounce-shot/shots.csv", method="explain", ball=ball)
    return shots.effects.fillna("").str.contains("drag").sum()


def shot_verdicts(word, ball=""):
    """Return how often explain gives a verdict for a ball; for all balls if it is empty."""
    status = rows("bounce-shot/status.csv", tuner="explain")
    verdicts = status[status.target.str.startswith(ball)].reason.str.partition(":")[0]
    return (verdicts == word).sum()


def at_bound(trained):
    """Return how often a training of the vision network ends at its bound."""
    return (rows("bounce-shot/vision.csv", trained=trained).restitution >= BOUND).sum()


def shots_at_bound():
    """Return which table-tennis shots of tunenet-vision + explain end at the bound."""
    where = {"method": "tunenet-vision + explain", "ball": "table-tennis"}
    return rows("bounce-shot/shots.csv", **where).restitution >= BOUND


def vision_distance(trained, effects):
    """Return the mean distance of restitutions from the fit of explain."""
    table = rows("bounce-shot/vision.csv", trained=trained, effects=effects)
    return (table.restitution - table.explained).abs().mean()


@cache
def exam_table(path):
    """Return the drawn answers of an exam."""
    return exam_report.drawn(read_table(REFERENCE / path))


def answers(path, **where):
    """Return the answers of an exam in which columns have these values."""
    return select(exam_table(path), where)


def grade(path, kind, level):
    """Return (count, total, share, low, high) of the graded answers that reach a level."""
    table = exam_report.graded(exam_table(path))
    return exam_report.share(table[table.kind == kind][level], exact=kind == "clean")


def covered(path):
    """Return (count, total, share, low, high) of the intervals that contain the true value."""
    table = exam_report.graded(exam_table(path))
    held, count = int(table.intervals_held.sum()), int(table.intervals.sum())
    return exam_report.share([True] * held + [False] * (count - held))


def missed_size(effect):
    """Return the size of the only hidden effect of this name that was not named."""
    table = exam_report.graded(answers("exam/items.csv", effect=effect))
    return table[table.outcome.isin(["unnamed", "missed"])]["size"].item()


def frictions(path):
    """Return the answers about friction."""
    table = answers(path)
    return table[table.effect.str.startswith("friction")]


def designed(name="sets", is_predicted=True, **where):
    """Return the sets of causes that a run was predicted to distinguish, or the others."""
    table = rows(f"next-recording/{name}.csv", **where)
    return table[table.groups.str.contains("|", regex=False) == is_predicted]


def is_confirmed(table):
    """Return whether the prediction of a set came true and the true cause remained."""
    return table.kept & table.outcome.isin(["settled", "split"])


def separations(*effects):
    """Return the largest predicted separations of undistinguished sets of only these effects."""
    return [value for members, value in _undistinguished() if members <= set(effects)]


def separation_with(effect):
    """Return the largest predicted separation of the undistinguished set with an effect."""
    (value,) = [value for members, value in _undistinguished() if effect in members]
    return value


def _undistinguished():
    for row in designed(is_predicted=False).itertuples():
        members = set(row.groups.replace(" | ", "/").split("/"))
        yield members, max(json.loads(row.worth).values())


def held_out(folder, key):
    """Return a held-out error of a verdict."""
    return document(f"{folder}/verdict.json")["heldout"][key]


def parameter(folder, name):
    """Return a base parameter of a verdict."""
    return document(f"{folder}/verdict.json")["parameters"][name]["value"]


def estimates(folder, effect):
    """Return the coefficients of a diagnosed cause, each with value, low and high."""
    causes = document(f"{folder}/verdict.json")["causes"]
    return next(cause["coefficients"] for cause in causes if cause["effect"] == effect)


def cause(folder, effect, name="coefficient"):
    """Return a coefficient of a diagnosed cause."""
    return estimates(folder, effect)[name]["value"]


def half_width(estimate):
    """Return half the width of an interval."""
    return (estimate["high"] - estimate["low"]) / 2


def quantity(sheet, name):
    """Return a quantity of a data sheet with value, low and high."""
    path = REFERENCE / "real" / "datasheets" / sheet / "sheet.toml"
    return read_toml(path)["quantities"][name]


@cache
def so101_errors():
    """Return the cells of the SO-101's table by motion, model and joint."""
    text = (REFERENCE / "real" / "so101" / "table.md").read_text(encoding="utf-8")
    (head, *body) = tables(text)[0]
    return {
        (row[0].strip("*"), row[1], joint): cell
        for row in body
        for joint, cell in zip(head[2:], row[2:], strict=True)
    }
