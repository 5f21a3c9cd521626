"""Compare sentences and tables of the pages below docs/ with the reference tables."""

import re

import numpy as np
from scipy.stats import spearmanr

from bench.benchmark.problem.experiment import load_experiment
from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.problem.tuning_problem import TuningProblem
from tests.docs.page_numbers.number_sources import NUMBER, Account
from tests.docs.page_numbers.source_tables import REFERENCE, errors, frame, one, rows
from tests.exams import exam_report
from tests.exams.answer_rows import read_table
from tests.sims.test_engines import TOLERANCE

STUDY = "tunenet-study"
COSTS = {
    "samples": {
        "score": (100, 1000, 10000, 30000, 100000),
        "explain": (100, 1600, 6400, 25600, 100000),
    },
    "candidates": {"score": (5, 10, 30, 100, 300), "explain": (6, 12, 18, 24, 0)},
    "runs": {"score": (1, 3, 10, 30, 100), "explain": (0, 3, 10, 30, 100)},
}
"""Sizes in the table of costs, by growing quantity and measured command; 0 if not measured."""
PARTS = {"score": ("a score, ms", 1e3), "explain": ("explain, s", 1.0)}
"""Label of each measured command in the table, and factor from seconds to its unit."""


def tunenet():
    """Check docs/tunenet.md."""
    page = Account("docs/tunenet.md")
    for place, name in enumerate(("ablation", "ablation", "noise", "ensemble")):
        header = "network | in 1 | in 2" if name == "ensemble" else "network | in 1 | in 3"
        _study(page, header, name, 0 if name == "ensemble" else place)
    spread = frame(f"{STUDY}/spread.csv")
    order = [
        spearmanr(mine["spread"], mine["error"]).statistic
        for mine in (spread[spread["range"] == kind] for kind in ("in", "wide"))
    ]
    page.says("error of the mean {} in range, {} wide)", *order)
    within = 100 * (spread.error <= 2 * spread.spread).groupby(spread["range"]).mean()
    page.says("two spreads on {} to {} % of", within.min(), within.max())
    page.says("typically {} times the spread", (spread.error / spread.spread).median())
    page.written("\n".join(hybrid_rows()))
    assert not frame("ball-drop/behind.csv").behind.any()
    _marks(page)
    _cost(page)
    _misspecified(page)
    _history(page)
    return page


def hybrid_rows():
    """Yield the table rows of hybrid and of the two tuners it combines.

    Each cell is the mean error. The median follows in brackets if the mean is more than twice as
    large, from the third simulation on.
    """
    for kind in ("in", "wide"):
        for tuner in ("hybrid", "tunenet", "least_squares"):
            cells = []
            for k in (1, 2, 3, 5, 10, 20, 50):
                mean, median = errors("ball-drop", tuner, kind, k, "param_abs_error")
                apart = k >= 3 and mean > 2 * median
                cells.append(f"{mean:.2g}" + (f" ({median:.0e})" if apart else ""))
            line = f"| {' | '.join([tuner, kind, *cells])} |"
            yield line.replace("e-0", "e-")


def _marks(page):
    """Check the targets that the reference results reach."""

    def error(tuner, kind, k):
        """Return the mean error on the ball experiment of the publication."""
        return errors("ball-drop", tuner, kind, k, "param_abs_error")[0]

    reached = [error("tunenet", kind, 3) for kind in ("in", "wide")]
    seeds = frame("ball-drop/training.csv").query("tuner == 'tunenet'")
    page.says("| {} and {} ({} trainings, [", *reached, len(seeds))
    first = "reaches {} after three simulations in range, the published network {}."
    page.says(first, reached[0], error("tunenet-published", "in", 3))
    for kind, words in (("in", "after 1 / 3 / 5"), ("wide", "wide")):
        of = [error("tunenet-published", kind, k) for k in (1, 3, 5)]
        page.says(f"{words} | {{}} / {{}} / {{}} |", *of)
    ranks = frame("multi/all/ranks.csv")
    of = ranks.drop(columns="problem")
    page.says("has the best mean rank ({} of {})", of["hybrid"].mean(), of.shape[1])
    assert of.mean().idxmin() == "hybrid"
    real = {
        "hybrid": "later", "least_squares": "", "tunenet": "", "tunenet-published": "later",
    }  # fmt: skip
    for tuner, folder in real.items():
        path = f"pendulum-real/{folder}".rstrip("/")
        values = [errors(path, tuner, "real", k, "heldout_error")[0] for k in (0, 1, 5, 10)]
        after = " rad after 0 / 1 / 5 / 10" if tuner == "hybrid" else ""
        page.says(f"`{tuner}` {{}} / {{}} / {{}} / {{}}{after}", *values)


def _study(page, header, name, place):
    """Check a table of the TuneNet study."""

    def value(row, heading):
        """Return the mean error, or the seconds of one training."""
        where = {"variant": row["network"]}
        if heading == "network":
            return None
        if heading == "training [s]":
            return [rows(f"{STUDY}/{name}.csv", **where, range="in").train_seconds.item()]
        kind, k = heading.split()
        return [one(f"{STUDY}/{name}.csv", f"mean_{k}", **where, range=kind)]

    assert page.table(header, value, place) >= 16


def _cost(page):
    """Check the costs of a training and an iteration, as far as they are stored."""
    cost = frame(f"{STUDY}/cost.csv").set_index("tuner")
    ours, published = cost.loc["tunenet"], cost.loc["tunenet-published"]
    iteration = [ours.iteration_ms_median, ours.iteration_ms_95]
    page.says("{} s on the busy machine | {} ms ({} ms) |", ours.train_seconds, *iteration)
    iteration = [published.iteration_ms_median, published.iteration_ms_95]
    page.says("{} s, busy machine | {} ms ({} ms) |", published.train_seconds, *iteration)
    page.says("≤ 1 ms | {} ms; where", ours.iteration_ms_median)


def _misspecified(page):
    """Check the errors of networks when the simulator lacks an effect."""

    def error(system, tuner, randomised):
        """Return the mean error in training widths."""
        where = {"system": system, "tuner": tuner, "randomised": randomised}
        return one("misspecified/learned.csv", "error", **where)

    page.says(
        "`regressor` errs by {} training widths instead of {} on a bounce shot whose restitution "
        "falls with speed, and by {} instead of {} on a ball with drag - `tunenet` errs by {} "
        "instead of {} on the ball; on the shot by {} instead of {}, which is no gain",
        *(error("shot", "regressor", told) for told in (True, False)),
        *(error("ball", "regressor", told) for told in (True, False)),
        *(error("ball", "tunenet", told) for told in (True, False)),
        *(error("shot", "tunenet", told) for told in (True, False)),
    )
    table = frame("misspecified/learned.csv")
    narrow = table[~table.randomised]
    assert (narrow.covered == 0).all()
    page.says("hold the truth of none of {} targets", narrow.targets.unique().item())
    wide = 100 * table[table.randomised].covered
    page.says("hold {} to {} % of the truths", wide.min(), wide.max())

    def mended(tuner, system):
        """Return the mean error of a learned tuner in the extended simulator."""
        where = {"model": "extended", "tuner": tuner, "metric": "param_error"}
        return one("misspecified/table.csv", "mean", experiment=f"misspecified-{system}", **where)

    page.says(
        "(shot, ball), `regressor` errs by {} and {}, `tunenet` by {} and {}",
        *(
            mended(tuner, system)
            for tuner in ("regressor", "tunenet")
            for system in ("shot", "ball")
        ),
    )


def _history(page):
    """Check the errors of the network that reads the history."""

    def error(experiment, kind, k, *tuners):
        """Return the mean errors in training widths."""
        where = {"experiment": experiment, "range": kind, "simulations": k}
        return [one("history/errors.csv", "mean", tuner=tuner, **where) for tuner in tuners]

    def mended(tuner, model):
        """Return the mean errors on shot and ball, before or after explain."""
        where = {"tuner": tuner, "model": model, "metric": "param_error"}
        return [
            one("history/missing.csv", "mean", experiment=f"misspecified-{system}", **where)
            for system in ("shot", "ball")
        ]

    drop, swing = "ball-drop", "pendulum-swing"
    both = "in_context", "tunenet"
    page.says("in range {} against `tunenet`'s {}, on", *error(drop, "in", 1, *both))
    page.says("on `pendulum-swing` {} against {}, outside", *error(swing, "in", 1, *both))
    page.says("outside its range {} against {}. On", *error(swing, "wide", 1, *both))
    page.says("range it is worse, {} against {}.", *error(drop, "wide", 1, *both))
    page.says(
        "`hybrid` is at {} after 20 simulations of the pendulum where it is at {}.",
        *error(swing, "in", 20, "hybrid", "in_context"),
    )
    windows = "window-1", "in_context"
    page.says("as good: {} against {} after three", *error(drop, "in", 3, *windows))
    page.says("of `ball-drop`, {} against {} on", *error(swing, "in", 3, *windows))
    ends = [error(name, "in", 20, "published-3")[0] for name in (drop, swing)]
    page.says("most of the loss**: {} and {} after 20", *ends)
    page.says("{} widths on the shot and {} on the ball. ", *mended("in_context", "plain"))
    page.says("the errors are {} and {}, and", *mended("in_context", "extended"))
    page.says("those of `least_squares` {} and {}.", *mended("least_squares", "extended"))


def performance():
    """Check docs/performance.md."""
    page = Account("docs/performance.md")
    page.written("\n".join(cost_rows()))
    items = exam_report.graded(read_table(REFERENCE / "exam/items.csv"))
    names = {
        "nothing hidden": "clean", "one cause": "single", "two causes": "double",
        "a foreign cause": "foreign",
    }  # fmt: skip

    def value(row, heading):
        """Return statistics of the seconds for cases of one kind."""
        seconds = items[items.kind == names[row[""]]].wall_s
        values = {
            "questions": len(seconds), "median, s": seconds.median(),
            "95th percentile": seconds.quantile(0.95), "most": seconds.max(),
        }  # fmt: skip
        return [values[heading]] if heading in values else None

    assert page.table("| questions | median, s", value) == 16
    page.known("All 883 cases", "those that cannot be marked stand in no table")
    return page


def cost_rows():
    """Yield the rows of the table of costs as they are on the page."""
    for what, columns in COSTS.items():
        for part, (head, times) in PARTS.items():
            mine = rows("explain-cost/cost.csv", part=part, what=what)
            seconds = mine.set_index("count").seconds
            cells = [short(times * seconds[n]) if n else "" for n in columns[part]]
            larger = mine.iloc[len(mine) // 2 :]
            slope = np.polyfit(np.log(larger["count"]), np.log(larger.seconds), 1)[0]
            yield f"| {' | '.join([head, *cells, f'{slope:.2f}'])} |".replace("|  |", "| |")


def short(value):
    """Format a value with two significant digits, or as an integer from 10 on."""
    return f"{value:.0f}" if value >= 10 else f"{value:#.2g}"


def problems():
    """Check docs/problems.md."""
    page = Account("docs/problems.md")
    table = frame("multi/identified.csv")

    def parameters(row, heading):
        """Return the number of parameters or of held-out runs of an experiment."""
        name = row["experiment"].strip("`")
        if heading not in ("parameters", "unseen runs") or name.startswith("robot"):
            return None
        experiment = load_experiment(name)
        unseen = experiment.held_out.scenarios
        return [
            unseen if heading == "unseen runs" else len(TuningProblem(experiment).cube.parameters)
        ]

    assert page.table("experiment | parameters", parameters) == 2 * table.experiment.nunique()
    above = [""]

    def spectrum(row, heading):
        """Return the parameter combinations that the data of a problem identify."""
        above[0] = row["experiment"].strip("`") or above[0]
        mine = table[(table.experiment == above[0]) & (table["range"] == row["range"])].iloc[0]
        if heading == "stiffest":
            return [mine.stiffest]
        if heading == "sloppiest":
            assert (row[heading] == "none") == (mine.sloppiest > 1e3)
            return [] if row[heading] == "none" else [mine.sloppiest]
        column = {"stiff directions (targets)": "stiff", "the sloppiest is mostly": "made_of"}
        if heading not in column:
            return None
        # The page lists only the largest shares, with other names for the parameters.
        values = [float(number) for number in re.findall(r"\b\d+", mine[column[heading]])]
        joint = re.findall(r"of (?:joint|link) (\d)$", row[heading])
        return [*values[: len(NUMBER.findall(row[heading])) - len(joint)], *joint]

    assert page.table("experiment | range | stiffest", spectrum) > 100
    counts = table.groupby("experiment").targets.unique().str[0]
    page.says("Medians over {} targets (arms: {})", counts["ball-wind"], counts["arm-swing"])
    noise = {
        name: [1e3 * value for value in load_experiment(name).noise.values()]
        for name in ("ball-wind", "slider-push", "pendulum-swing", "servo-step", "arm-swing")
    }
    page.says(
        "noise of {} mm (balls), {} mm and {} mm/s (slider), {} mrad (pendulums), {} mrad (servos) "
        "or {} mrad (arms)",
        noise["ball-wind"][0], *noise["slider-push"], *noise["pendulum-swing"],
        *noise["servo-step"], noise["arm-swing"][0],
    )  # fmt: skip
    page.says("where that is below {} is called", STIFF_SIGMA_THRESHOLD)
    return page


def engines():
    """Check docs/engines.md: the tolerances of the engine tests."""
    page = Account("docs/engines.md")
    bounds = [TOLERANCE[system] for system in ("ball", "pendulum", "slider", "servo")]
    page.says("every entry below {} (ball), {} (pendulum), {} (slider), {} (servo),", *bounds)
    return page


def robots():
    """Check docs/robots.md: the results for robots with a floating base."""
    page = Account("docs/robots.md")
    told = read_table(REFERENCE / "robots/afloat.csv")
    of = {kind: told[told.kind == kind] for kind in ("single", "clean", "foreign")}
    single, clean, foreign = of.values()
    good = {kind: rows.outcome.isin(["right", "set"]) for kind, rows in of.items()}
    alone = single.outcome == "right"
    sets = single[~alone].causes
    page.says("All {} cases were evaluated", len(told))
    page.says("| one cause | {} | {} |", len(single), good["single"].sum())
    page.says("| {} named alone; {} in sets", alone.sum(), len(sets))
    offsets, drags = sets.str.contains("input.bias"), sets.str.contains("actuator.damping")
    page.says("offset of a motor's command ({} times, once", offsets.sum())
    assert sets.str.contains("sensor.bias").sum() == 1
    page.says("drag at its joint ({}), a gain of an encoder", drags.sum())
    assert sets[~offsets & ~drags].tolist() == ["sensor.gain@q.elbow|sensor.eccentricity@q.elbow"]
    page.says("| nothing | {} | {} | one alarm", len(clean), good["clean"].sum())
    page.says("another joint, encoder slip | {} | {} |", len(foreign), good["foreign"].sum())
    unknown = (foreign.verdict == "unknown").sum()
    page.says("| {} `unknown`, {} `partial` |", unknown, (foreign.verdict == "partial").sum())
    held, count = told.intervals_held.sum(), told.intervals.sum()
    page.says("Of {} intervals {} contain the true value ({} %)", count, held, 100 * held / count)
    page.says("median processor time is {} s for a case with one", single.cpu_s.median())
    page.says("one cause, {} s for a clean one", clean.cpu_s.median())
    page.says("and {} s for a cause outside the library", foreign.cpu_s.median())
    page.says("first {} clean recordings there were two", len(clean))
    page.says("the {} cases of the hanging body", (clean.system == "hung-motor").sum())
    return page


PAGES = {
    "robots": robots,
    "tunenet": tunenet,
    "performance": performance,
    "problems": problems,
    "engines": engines,
}
"""Checks of the pages of docs/ that quote tables, except pages with their own test."""
