"""Conformance check of a tuner in its isolated process."""

from __future__ import annotations

import inspect
import sys

import numpy as np

from bench.benchmark.isolation.isolation_layers import PROJECT_ROOT
from bench.benchmark.isolation.process_limits import KilledExternallyError, RunEndedError
from bench.benchmark.isolation.tuner_client import IsolatedRun, TunerSpec
from bench.benchmark.runner.sandboxed_tuner import find_preloadable_packages, start_isolated_tuner
from bench.benchmark.runner.tuner_loop import drive_tuner
from bench.conformance.check_base import NotApplicable, check
from bench.conformance.toy_problem import make_evaluate, make_task, make_trained_tuner, run_tuner
from methods.tuner import Tuner

_RUN_SIMULATIONS = 5
"""Number of simulations of a run, enough for a tuner to use all of its features."""
_SEED = 0
"""Seed of the runs that are compared."""


def check_same_run_when_sealed(kind: type[Tuner]) -> NotApplicable | None:
    """Check that the tuner runs in an isolated process, with the same result as in this process.

    An isolated process cannot start other processes and cannot access files or the network.
    """
    tuned = _make_tuner_spec(kind)
    if tuned is None:
        return NotApplicable("its class is in no plugin file and no installed package")
    local_trace = run_tuner(make_trained_tuner(kind, 2), 2, _RUN_SIMULATIONS, _SEED)
    state = make_trained_tuner(kind, 2).state() if kind.learned else None
    task, _ = make_task(2, _RUN_SIMULATIONS)
    location = f"{kind.__name__}: what needs files, the network or processes; docs/isolation.md"
    try:
        with start_isolated_tuner(tuned, _SEED, "run", state=state) as tuner:
            words = np.array([_SEED], dtype=np.uint32)
            sealed = IsolatedRun(tuner, words, float("inf"))
            sandboxed_trace = drive_tuner(
                sealed, task, make_evaluate(task), np.random.default_rng(_SEED)
            )
    except (RunEndedError, KilledExternallyError) as error:
        last_line = str(error).strip().splitlines()[-1:]
        check(False, "a run in a process of its own", last_line, location)
        raise
    end_text = (
        sandboxed_trace.reason.strip().splitlines()[-1:]
        if sandboxed_trace.status != local_trace.status
        else ""
    )
    check(
        sandboxed_trace.status == local_trace.status,
        f"the status {local_trace.status} when isolated",
        end_text,
        location,
    )
    is_same = np.array_equal(sandboxed_trace.proposals, local_trace.proposals)
    check(is_same, "the same run when isolated", "another one", location)
    return None


def _make_tuner_spec(kind: type[Tuner]) -> TunerSpec | None:
    """Return the tuner specification for an isolated process; None if the class cannot load."""
    module = sys.modules.get(kind.__module__)
    if getattr(module, kind.__name__, None) is not kind:
        return None
    file = inspect.getsourcefile(kind) or ""
    if kind.__module__.startswith("simgap_plugin_"):
        return TunerSpec(kind.name, "", file, {}, find_preloadable_packages(file))
    # A class of a script or a test is in a file that an isolated process cannot read.
    is_importable = file.startswith(str(PROJECT_ROOT / "methods")) or "site-packages" in file
    return (
        TunerSpec(kind.name, kind.__module__, "", {}, find_preloadable_packages(file))
        if is_importable
        else None
    )
