"""What the page of a comparison costs: seconds, bytes, and how soon it answers, beside cocopp's.
Run: `python -m tests.benchmarks.pages`.

Prints one JSON line a measurement; seconds are the processor's, but for those of the browser.
cocopp (`pip install cocopp six`) is measured where it is installed, on as many runs of the same
lengths: 24 functions, 15 instances each, two algorithms.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pandas as pd

from bench.figures import comparison
from bench.figures.comparison import Labels
from bench.pages.comparison.page import comparison_page
from bench.pages.comparison.results import Results
from bench.problem.experiment import load
from bench.report import _drawn, tables
from bench.store.folder import Stored
from tests.browser import Opened, launched

TUNERS = ("random", "cma_es", "nelder_mead", "bayes", "least_squares", "tunenet")
RANGES = ("in", "wide")
FUNCTIONS, INSTANCES = 24, 15


def invented(targets, budget):
    """A comparison of six tuners on so many targets of each of two ranges."""
    rng = np.random.default_rng(0)
    k = np.arange(budget + 1)
    parts = []
    for place, tuner in enumerate(TUNERS):
        for kind in RANGES:
            for i in range(targets):
                error = np.exp(-0.02 * (place + 1) * k) * rng.uniform(0.2, 2)
                parts.append((f"{tuner}/{kind}-{i}/0", tuner, kind, f"{kind}-{i}", error))
    runs, tuners, kinds, names, errors = zip(*parts, strict=True)
    rows = pd.DataFrame(
        {
            "run": np.repeat(runs, budget + 1),
            "experiment": "ball-drop",
            "tuner": np.repeat(tuners, budget + 1),
            "target": np.repeat(names, budget + 1),
            "seed": 0,
            "range": np.repeat(kinds, budget + 1),
            "k": np.tile(k, len(runs)),
            "param_error": np.concatenate(errors),
            "param_abs_error": 0.4 * np.concatenate(errors),
            "obs_error": 0.01 + np.concatenate(errors),
            "outside": np.repeat(
                [0.0 if kind == "in" else rng.uniform(0, 1) for kind in kinds], budget + 1
            ),
            "tuner_seconds": 1e-3,
            "simulator_seconds": 2e-3,
        }
    )
    statuses = pd.DataFrame({"run": runs, "tuner": tuners, "status": "done", "reason": ""})
    experiment = load("ball-drop").chosen(budget=budget).with_tuners(list(TUNERS))
    return Stored(experiment, rows, statuses, {"tunenet": (1600.0, 30.0)})


def ours(browser, place, targets, budget):
    stored = invented(targets, budget)
    labels = Labels("z [m]", "restitution")
    statistics = comparison.statistics_of(stored)
    started = process_time()
    frames = tables(stored, statistics)
    tabled = process_time()
    pictures = _drawn(stored, labels, statistics)
    drawn = process_time()
    environment = {"packages": {}, "plugins": []}
    results = Results(stored, labels, statistics, frames, pictures, environment, "results/x", "")
    path = place / f"report-{targets}-{budget}.html"
    path.write_text(comparison_page(results), encoding="utf-8")
    made, opening = process_time(), perf_counter()
    with Opened(browser, path) as one:
        loaded = perf_counter() - opening
        # From a click to the next frame, all figures and tables drawn anew.
        answer = one.page.evaluate(
            "() => { const keys = document.querySelectorAll('#error .key'); const began ="
            " performance.now(); for (let i = 0; i < 10; i += 1) keys[i % 6]?.click();"
            " return (performance.now() - began) / 10; }"
        )
        assert one.complaints == []
    print(json.dumps({
        "runs": len(stored.statuses), "rows": len(stored.runs),
        "tables_seconds": round(tabled - started, 2),
        "printed_figures_seconds": round(drawn - tabled, 2),
        "page_seconds": round(made - drawn, 2), "page_MB": round(path.stat().st_size / 1e6, 2),
        "opened_in_seconds": round(loaded, 2), "a_click_milliseconds": round(answer, 1),
    }), flush=True)  # fmt: skip


def algorithm(folder, name, rate, budget):
    """Data of one algorithm in COCO's old format, as its postprocessing reads it."""
    rng = np.random.default_rng(1)
    k = np.arange(1, budget + 1)
    for function in range(1, FUNCTIONS + 1):
        below = folder / name / f"data_f{function}"
        below.mkdir(parents=True)
        dat, runs = [], []
        for instance in range(1, INSTANCES + 1):
            error = 10 * np.exp(-rate * k) * rng.uniform(0.2, 2)
            dat.append(
                "% function evaluation | noise-free fitness - Fopt (0) | best noise-free fitness - "
                "Fopt | measured fitness | best measured fitness | x1 | x2\n"
            )
            dat += [
                f"{n} {e:.9e} {e:.9e} {e:.9e} {e:.9e} +0.0 +0.0\n"
                for n, e in zip(k, error, strict=False)
            ]
            runs.append(f"{instance}:{budget}|{error[-1]:.1e}")
        stem = f"bbobexp_f{function}_DIM2"
        (below / f"{stem}.dat").write_text("".join(dat))
        (below / f"{stem}.tdat").write_text("".join(dat))
        (folder / name / f"bbobexp_f{function}.info").write_text(
            f"funcId = {function}, DIM = 2, Precision = 1.000e-08, algId = '{name}'\n% none\n"
            f"data_f{function}/{stem}.dat, {', '.join(runs)}\n"
        )


def theirs(place, budget):
    if find_spec("cocopp") is None:
        print(json.dumps({"cocopp": "not installed: pip install cocopp"}))
        return
    import cocopp

    for name, rate in (("quick", 0.05), ("slow", 0.01)):
        algorithm(place / "data", name, rate, budget)
    cocopp.genericsettings.interested_in_opening_results_in_browser = False
    out = place / "ppdata"
    started = process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        cocopp.main(f"-o {out} {place / 'data' / 'quick'} {place / 'data' / 'slow'}")
    took = process_time() - started
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    print(json.dumps({
        "cocopp_runs": 2 * FUNCTIONS * INSTANCES, "seconds": round(took, 1),
        "files_MB": round(size / 1e6, 1),
    }), flush=True)  # fmt: skip


def main():
    with tempfile.TemporaryDirectory() as folder:
        with launched() as browser:
            # The first pays for imports.
            for targets, budget in ((5, 20), (60, 100), (825, 100)):
                ours(browser, Path(folder), targets, budget)
        theirs(Path(folder), 100)


if __name__ == "__main__":
    main()
