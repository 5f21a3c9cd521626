"""Measure cocopp on runs of known length, in two arrangements of 720 runs.

They are two algorithms on 24 functions with 15 instances, and one algorithm in COCO's six
dimensions with 5 instances. Part of `python -m tests.benchmarks.page_sizes`.
"""

from __future__ import annotations

import json
import resource
import subprocess
from time import perf_counter

import numpy as np

from tests.benchmarks.peer_libraries import environment

FUNCTIONS = 24
HEAD = (
    "% function evaluation | noise-free fitness - Fopt (0) | best noise-free fitness - Fopt | "
    "measured fitness | best measured fitness | x1 | x2\n"
)
SHAPES = {
    "two algorithms": ({"quick": 0.05, "slow": 0.01}, (2,), 15),
    "six dimensions": ({"quick": 0.05}, (2, 3, 5, 10, 20, 40), 5),
}
"""By name: algorithms with the rates at which their errors fall, dimensions, instances."""
POSTPROCESSING = """
import sys
import cocopp
cocopp.genericsettings.interested_in_opening_results_in_browser = False
cocopp.main(sys.argv[1:])
"""


def measured(folder, budget):
    """Print the cost of cocopp's page for each arrangement, if cocopp can be installed."""
    python = environment(folder, ("cocopp", "six"))
    if python is None:
        return
    for shape, (algorithms, dimensions, instances) in SHAPES.items():
        data = folder / shape.replace(" ", "-")
        for name, rate in algorithms.items():
            _algorithm(data / name, name, rate, dimensions, instances, budget)
        out = data / "page"
        given = [str(data / name) for name in algorithms]
        before, began = _seconds(), perf_counter()
        done = subprocess.run(
            [python, "-c", POSTPROCESSING, "-o", str(out), *given],
            capture_output=True,
            text=True,
            check=False,
        )
        took, clock = _seconds() - before, perf_counter() - began
        if done.returncode != 0 or "ALL done" not in done.stdout:
            raise RuntimeError(done.stdout[-2000:] + done.stderr[-2000:])
        size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
        runs = len(algorithms) * FUNCTIONS * len(dimensions) * instances
        print(json.dumps({
            "cocopp": shape, "runs": runs, "seconds": round(took, 1),
            "clock_seconds": round(clock, 1), "files_MB": round(size / 1e6, 1),
        }), flush=True)  # fmt: skip


def _seconds():
    """Return the processor time of all ended child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _algorithm(folder, name, rate, dimensions, instances, budget):
    """Write the data of one algorithm in COCO's old format, which its postprocessing reads."""
    rng = np.random.default_rng(1)
    for function in range(1, FUNCTIONS + 1):
        below = folder / f"data_f{function}"
        below.mkdir(parents=True)
        index = []
        for dimension in dimensions:
            stem = f"bbobexp_f{function}_DIM{dimension}"
            text, ends = _runs(rng, rate, instances, budget)
            for ending in ("dat", "tdat"):
                (below / f"{stem}.{ending}").write_text(text)
            index.append(
                f"funcId = {function}, DIM = {dimension}, Precision = 1.000e-08, algId = '{name}'\n"
                f"% none\n{below.name}/{stem}.dat, {', '.join(ends)}\n"
            )
        (folder / f"bbobexp_f{function}.info").write_text("".join(index))


def _runs(rng, rate, instances, budget):
    """Return the log and the final values of runs whose errors fall with every evaluation."""
    k = np.arange(1, budget + 1)
    lines, ends = [], []
    for instance in range(1, instances + 1):
        error = 10 * np.exp(-rate * k) * rng.uniform(0.2, 2)
        lines.append(HEAD)
        lines += [
            f"{n} {e:.9e} {e:.9e} {e:.9e} {e:.9e} +0.0 +0.0\n"
            for n, e in zip(k, error, strict=True)
        ]
        ends.append(f"{instance}:{budget}|{error[-1]:.1e}")
    return "".join(lines), ends
