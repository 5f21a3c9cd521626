"""Measure a comparison page: seconds, bytes and response time.

Run: `python -m tests.benchmarks.page_sizes`. Prints one JSON line per measurement; seconds are
processor time, except those of the browser and where the clock is named. The response to a click is
complete when the next frame is painted: the `duration` of the browser's Event Timing (8 ms steps).
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

import numpy as np
import pandas as pd

from bench.benchmark.comparison_charts import AxisLabels, ComparisonView
from bench.benchmark.comparison_report import ComparisonReportData, _render_figures, render_page
from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics, build_tables
from bench.benchmark.storage.result_folder import StoredComparison
from tests.browser import Opened, launched

TUNERS = ("random", "cma_es", "nelder_mead", "bayes", "least_squares", "tunenet")
RANGES = ("in", "wide")
CLICKS = 12
ANSWERED = """
() => {
  window.answered = [];
  const note = (list) => list.getEntries().filter(({ name }) => name === "click")
    .forEach(({ duration }) => window.answered.push(duration));
  new PerformanceObserver(note).observe({ type: "event", durationThreshold: 16 });
}
"""
"""Script that records milliseconds from each click to the next frame; values below 16 are missing.
"""


def invented(targets, budget):
    """Return a comparison of six tuners with random errors on targets of two ranges."""
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
    experiment = load_experiment("ball-drop").chosen(budget=budget).with_tuners(list(TUNERS))
    return StoredComparison(experiment, rows, statuses, {"tunenet": (1600.0, 30.0)})


def clicked(page):
    """Return milliseconds from each of some clicks on tuners to the next frame."""
    page.evaluate(ANSWERED)
    keys = page.locator("#error .key")
    for i in range(CLICKS):
        keys.nth(i % len(TUNERS)).click()
        # Wait until the page is idle before the next click.
        page.wait_for_timeout(300)
    answers = page.evaluate("window.answered")
    return [*answers, *[16] * (CLICKS - len(answers))]


def ours(browser, place, targets, budget):
    stored = invented(targets, budget)
    labels = AxisLabels("z [m]", "restitution")
    statistics = ComparisonStatistics(stored)
    started = process_time()
    frames = build_tables(stored, statistics)
    tabled = process_time()
    pictures = _render_figures(stored, labels, statistics)
    drawn = process_time()
    environment = {"packages": {}, "plugins": []}
    results = ComparisonReportData(
        ComparisonView(stored, labels, statistics), frames, pictures, environment, "results/x", ""
    )
    path = place / f"report-{targets}-{budget}.html"
    path.write_text(render_page(results), encoding="utf-8")
    made, opening = process_time(), perf_counter()
    with Opened(browser, path) as one:
        loaded = perf_counter() - opening
        answers = clicked(one.page)
        assert one.complaints == []
    print(json.dumps({
        "runs": len(stored.statuses), "rows": len(stored.runs),
        "tables_seconds": round(tabled - started, 2),
        "printed_figures_seconds": round(drawn - tabled, 2),
        "page_seconds": round(made - drawn, 2), "page_MB": round(path.stat().st_size / 1e6, 2),
        "opened_in_seconds": round(loaded, 2), "clicks": CLICKS,
        "click_to_frame_ms": median(answers), "slowest_click_ms": max(answers),
    }), flush=True)  # fmt: skip


def main():
    with tempfile.TemporaryDirectory() as folder, launched() as browser:
        # The first comparison is small, because its time includes imports.
        for targets, budget in ((5, 20), (60, 100), (825, 100)):
            ours(browser, Path(folder), targets, budget)


if __name__ == "__main__":
    main()
