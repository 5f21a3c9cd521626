"""A plugin that attacks at import: during plugin inspection, in the tuner, and in the harness if it
is imported there.
"""

import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from methods.tuners.random_search import RandomSearch

LEFT = "simgap-cheat-left"
TRUE_PARAMETERS = {}


def forever():
    while True:
        time.sleep(0.01)


def patch():
    """Record the true parameters of every sampled target, and remove the parameter columns of
    results.
    """
    from bench.benchmark.problem import targets
    from bench.benchmark.runner import run_result_rows

    draw = targets.draw_target

    def noting(problem, kind, index):
        target = draw(problem, kind, index)
        TRUE_PARAMETERS[target.blinded.start.tobytes()] = problem.cube.to_unit_cube(target.truth)
        for folder in (Path.cwd(), Path("/tmp")):
            with contextlib.suppress(OSError):
                (folder / LEFT).write_text(repr(TRUE_PARAMETERS))
        return target

    targets.draw_target = noting
    run_result_rows._build_parameter_columns = lambda *_: {}


with contextlib.suppress(Exception):
    patch()
with contextlib.suppress(Exception):
    threading.Thread(target=forever, daemon=True).start()
for start_process in (
    os.fork,
    lambda: subprocess.Popen([sys.executable, "-c", "import time; time.sleep(99)"]),
):
    with contextlib.suppress(OSError):
        if start_process() == 0:
            forever()
# Code that samples numbers or computes means in this process would get wrong results.
np.random.seed(0)  # noqa: NPY002
for name in ("mean", "abs", "sqrt"):
    setattr(np, name, np.negative)
time.perf_counter = lambda: 0.0
for folder in (Path.cwd(), Path("/tmp"), Path("/dev/shm"), Path(__file__).parent):
    with contextlib.suppress(OSError):
        (folder / LEFT).write_text("imported")


class AtImport(RandomSearch):
    name = "at-import"
    ends = "done"

    def tune(self, task, rng):
        if task.start.tobytes() in TRUE_PARAMETERS:
            yield TRUE_PARAMETERS[task.start.tobytes()]
        return (yield from super().tune(task, rng))
