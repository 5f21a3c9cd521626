"""Tests that the page of the history-reading tuner agrees with its tables."""

from tests.benchmarks.history_tuner_study import AFTER
from tests.docs.page_numbers.number_sources import Account
from tests.docs.page_numbers.source_tables import frame, one

ERRORS, MISSING = "history/errors.csv", "history/missing.csv"


def held(experiment, kind, tuner, k):
    """Return the mean parameter error after k simulations.

    A run that ended earlier counts with its last value.
    """
    table = frame(ERRORS).set_index(["experiment", "range", "tuner"]).loc[(experiment, kind, tuner)]
    table = table[table.simulations <= k]
    return table["mean"].iloc[-1]


def error_rows():
    """Yield the table rows of errors against simulations."""
    cases = frame(ERRORS)[["experiment", "range", "tuner"]].drop_duplicates()
    for experiment, kind, tuner in sorted(cases.itertuples(index=False)):
        cells = [f"{held(experiment, kind, tuner, k):.2g}" for k in AFTER]
        yield f"| {experiment} | {kind} | {tuner} | {' | '.join(cells)} |"


def missing_rows():
    """Yield the table rows of errors before and after explain, for parameters and held-out runs."""
    table = frame(MISSING).set_index(["experiment", "tuner", "metric", "model"])["mean"]
    for experiment, tuner in sorted({key[:2] for key in table.index}):
        cells = [
            f"{table[experiment, tuner, metric, model]:.2g}"
            for metric in ("param_error", "heldout_error")
            for model in ("plain", "extended")
        ]
        yield f"| {experiment.removeprefix('misspecified-')} | {tuner} | {' | '.join(cells)} |"


def test_its_tables_are_those_of_the_files():
    page = Account("results/reference/history/README.md")
    errors, missing = list(error_rows()), list(missing_rows())
    assert (len(errors), len(missing)) == (36, 16)
    page.written("\n".join([*errors, *missing]))
    assert page.wrong == []


def test_who_wins_is_as_it_says():
    for experiment in ("ball-drop", "pendulum-swing"):
        for kind in ("in", "wide"):
            one_step = {t: held(experiment, kind, t, 1) for t in ("in_context", "tunenet")}
            last = {t: held(experiment, kind, t, 20) for t in ("in_context", "hybrid", "tunenet")}
            assert min(last, key=last.get) == ("tunenet" if "drop" in experiment else "hybrid")
            if (experiment, kind) != ("ball-drop", "wide"):
                assert min(one_step, key=one_step.get) == "in_context"
            # The effect of the history is smaller than the difference between two trainings.
            windows = [held(experiment, kind, t, 3) for t in ("window-1", "in_context")]
            assert 0.5 < windows[0] / windows[1] < 2.0
            assert held(experiment, kind, "published-3", 20) > 6 * held(
                experiment, kind, "in_context", 20
            )
    for system in ("ball", "shot"):
        where = {"experiment": f"misspecified-{system}", "metric": "param_error"}
        of = {t: one(MISSING, "mean", tuner=t, model="extended", **where) for t in
              ("in_context", "least_squares", "hybrid")}  # fmt: skip
        assert of["in_context"] > max(of["least_squares"], of["hybrid"])
