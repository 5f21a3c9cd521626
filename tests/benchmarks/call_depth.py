"""Count the project's own stack frames above the engine: ``python -m tests.benchmarks.call_depth``.

A reader follows a command through these frames. Prints one JSON line for each path with the number
of frames above `BatchEngine.integrate`, the number of files, and the limit; exits with 1 if a path
is deeper than its limit. The frames of the first call are printed with ``--show``.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from unittest.mock import patch

import simgap
from bench.benchmark.problem.experiment import load_experiment
from sims.engines.batch import BatchEngine

LIMITS = {"simulate": 7, "compare": 12, "explain": 14}
"""Maximum number of frames on the way from the public function to the engine."""
WITHIN = {"compare": "drive_tuner"}
"""Function in the counted stacks: for `compare` evaluations, not the drawing of targets."""
PACKAGES = tuple(
    str(Path(__file__).resolve().parents[2] / name) for name in ("bench", "sims", "methods")
)


def find_deepest_stack(call, within=""):
    """Return the deepest stack of the project's frames above the engine during a call.

    Only stacks with a frame of the function `within` count.
    """
    deepest: list[str] = []
    integrate = BatchEngine.integrate

    def watched(*given, **more):
        nonlocal deepest
        frame, stack = sys._getframe(1), []
        while frame is not None:
            code = frame.f_code
            if code.co_filename.startswith(PACKAGES):
                stack.append(f"{Path(code.co_filename).name}:{code.co_qualname}")
            frame = frame.f_back
        if any(frame.endswith(within) for frame in stack):
            deepest = max(deepest, stack[::-1], key=len)
        return integrate(*given, **more)

    with patch.object(BatchEngine, "integrate", watched):
        call()
    return deepest


def main():
    with tempfile.TemporaryDirectory() as place:
        swing = Path(place, "swing.csv")
        effects = {"drag.linear": 2e-4}

        def simulate():
            simgap.simulate("pendulum", effects=effects, noise=0.01, seconds=1.0).write(swing)

        def compare():
            slides = load_experiment("slider-push")
            settings = {**slides.settings, "engine": "batch"}
            simgap.compare(
                slides.chosen(settings=settings), tuners=["random"], targets=3, budget=5,
                seeds=1, jobs=0, salt="public", out=Path(place, "out"),
            )  # fmt: skip

        def explain():
            simgap.explain(swing, jobs=1)

        too_deep = False
        for call in (simulate, compare, explain):
            stack = find_deepest_stack(call, WITHIN.get(call.__name__, ""))
            limit = LIMITS[call.__name__]
            too_deep = too_deep or len(stack) > limit
            files = len({frame.partition(":")[0] for frame in stack})
            row = {"path": call.__name__, "frames": len(stack), "files": files, "limit": limit}
            print(json.dumps(row))
            if "--show" in sys.argv:
                print("  " + "\n  ".join(stack))
    return int(too_deep)


if __name__ == "__main__":
    sys.exit(main())
