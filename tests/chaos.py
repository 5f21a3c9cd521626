"""Kills the runner, its workers and a cluster's workers at random moments, resumes, and compares
with no kill at all.

`make chaos` makes 100 kills. Run `python -m tests.chaos --kills N [--seed S]` for another number.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import tomli_w

from bench.store.segments import finished
from tests.cluster import cluster, said
from tests.conftest import PLUGINS
from tests.experiments import SPRING

MEASURED = ["tuner_seconds", "simulator_seconds", "fit_seconds", "seconds"]
TUNERS = {"random": {}, "cma_es": {}, "least_squares": {}, "regressor": {"seeds": 1}}


def start(folder, experiment, address, environment):
    """A new comparison, or the rest of one that was killed."""
    begun = (
        ["--resume", str(folder)] if folder.exists() else [str(experiment), "--out", str(folder)]
    )
    where = ["--cluster", address] if address else ["--jobs", "2"]
    command = [
        sys.executable,
        "-m",
        "bench.cli",
        "compare",
        *begun,
        *where,
        "--plugin",
        str(PLUGINS / "spring.py"),
    ]
    with errors_of(folder).open("w") as errors:
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=errors)


def errors_of(folder):
    return folder.with_suffix(".stderr")


def victims(process, what, running):
    if what == "runner":
        return [psutil.Process(process.pid)]
    if what == "worker":
        return [c for c in psutil.Process(process.pid).children() if "spawn_main" in said(c)]
    return running.workers()


def disturbed(folder, experiment, kills, rng, running, environment):
    """Kills at random moments until there were `kills`, or all is done; returns how many of each
    hit.
    """
    hits = Counter()
    process = start(folder, experiment, running and running.address, environment)
    while sum(hits.values()) < kills:
        time.sleep(rng.uniform(0.0, 2.5))
        if process.poll() is not None:
            if process.returncode != 0:
                raise AssertionError(
                    f"it ended by itself with {process.returncode}: {errors_of(folder).read_text()}"
                )
            return hits
        before = finished(folder)
        what = str(rng.choice(["runner", "cluster worker" if running else "worker"]))
        try:
            chosen = victims(process, what, running)
            if not chosen:
                continue
            chosen[int(rng.integers(len(chosen)))].kill()
        except psutil.NoSuchProcess:
            continue
        hits[what] += 1
        if what == "runner":
            process.wait()
            after = finished(folder)
            lost = set(before) - set(after)
            if lost and (folder / "segments").exists():
                raise AssertionError(f"lost {len(lost)} finished runs")
            process = start(folder, experiment, running and running.address, environment)
    if process.wait(timeout=600) != 0:
        raise AssertionError(f"it ended with {process.returncode}: {errors_of(folder).read_text()}")
    return hits


def compare(folder, undisturbed):
    """Raise unless both folders hold the same, but for times."""
    for name, read in (
        ("status.csv", pd.read_csv),
        ("table.csv", pd.read_csv),
        ("runs.parquet", pd.read_parquet),
    ):
        a, b = (read(f / name) for f in (folder, undisturbed))
        pd.testing.assert_frame_equal(
            *(f.drop(columns=[c for c in MEASURED if c in f]) for f in (a, b)), check_exact=True
        )
        if name == "status.csv" and a["run"].duplicated().any():
            raise AssertionError("runs are doubled")


def chaos(folder, kills, seed, on_cluster, targets=60):
    """Rounds of a comparison, each disturbed, until there were `kills` kills; returns how many of
    each.
    """
    rng = np.random.default_rng(seed)
    experiment = folder / "chaos.toml"
    document = {
        **SPRING,
        "targets": targets,
        "seeds": 2,
        "budget": 60,
        "training_budget": 60,
        "tuners": TUNERS,
    }
    experiment.write_text(tomli_w.dumps(document))
    environment = {**os.environ, "SIMGAP_CACHE": str(folder / "cache")}
    undisturbed = folder / "undisturbed"
    start(undisturbed, experiment, None, environment).wait(timeout=600)
    hits, rounds = Counter(), 0
    with cluster(folder) if on_cluster else _nobody() as running:
        while (left := kills - sum(hits.values())) > 0:
            rounds += 1
            disturbed_folder = folder / f"round-{on_cluster:d}-{rounds}"
            hits += disturbed(disturbed_folder, experiment, left, rng, running, environment)
            compare(disturbed_folder, undisturbed)
    return hits, rounds, len(pd.read_csv(undisturbed / "status.csv"))


class _nobody:  # noqa: N801 - a context manager that gives None
    def __enter__(self):
        return None

    def __exit__(self, *_):
        return None


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    total = Counter()
    shares = ((options.kills - options.kills // 4, False), (options.kills // 4, True))
    for kills, on_cluster in shares:
        with tempfile.TemporaryDirectory() as folder:
            started = time.monotonic()
            hits, rounds, runs = chaos(Path(folder), kills, options.seed, on_cluster)
            where = "cluster" if on_cluster else "local"
            seconds = time.monotonic() - started
            print(
                f"{where}: {dict(hits)} in {rounds} rounds of {runs} runs, {seconds:.0f} s: "
                "identical",
                flush=True,
            )
            total += hits
    print(f"{sum(total.values())} kills; nothing lost, nothing doubled, every table identical")


if __name__ == "__main__":
    main()
