"""Conformance check of a tuner in its isolated process."""

from __future__ import annotations

import inspect
import sys

import numpy as np

from bench.checks.base import NotApplicable, require
from bench.checks.toy import evaluation_of, ready, run, task_of
from bench.runs.drive import drive
from bench.runs.housing import ahead_of, housed
from bench.sealing.ended import EndedError, KilledError
from bench.sealing.outside import Sealed, Tuned
from bench.sealing.seals import ROOT
from methods.base import Tuner

_BUDGET = 5
"""Number of simulations of a run, enough for a tuner to use all of its features."""
_SEED = 0


def check_same_run_when_sealed(kind: type[Tuner]) -> NotApplicable | None:
    """Check that the tuner runs in an isolated process, with the same result as in this process.

    An isolated process cannot start other processes and cannot access files or the network.
    """
    tuned = _housed_as(kind)
    if tuned is None:
        return NotApplicable("its class is in no plugin file and no installed package")
    here = run(ready(kind, 2), 2, _BUDGET, _SEED)
    state = ready(kind, 2).state() if kind.learned else None
    task, _ = task_of(2, _BUDGET)
    look = f"{kind.__name__}: what needs files, the network or processes; docs/sealing.md"
    try:
        with housed(tuned, _SEED, "run", state=state) as tuner:
            words = np.array([_SEED], dtype=np.uint32)
            sealed = Sealed(tuner, words, float("inf"))
            there = drive(sealed, task, evaluation_of(task), np.random.default_rng(_SEED))
    except (EndedError, KilledError) as error:
        found = str(error).strip().splitlines()[-1:]
        require(False, "a run in a process of its own", found, look)
        raise
    ended = there.reason.strip().splitlines()[-1:] if there.status != here.status else ""
    require(there.status == here.status, f"the end {here.status} when sealed", ended, look)
    same = np.array_equal(there.proposals, here.proposals)
    require(same, "the same run when sealed", "another one", look)
    return None


def _housed_as(kind: type[Tuner]) -> Tuned | None:
    """Return the tuner specification for an isolated process; None if the class cannot load."""
    module = sys.modules.get(kind.__module__)
    if getattr(module, kind.__name__, None) is not kind:
        return None
    file = inspect.getsourcefile(kind) or ""
    if kind.__module__.startswith("simgap_plugin_"):
        return Tuned(kind.name, "", file, {}, ahead_of(file))
    # A class of a script or a test is in a file that an isolated process cannot read.
    own = file.startswith(str(ROOT / "methods")) or "site-packages" in file
    return Tuned(kind.name, kind.__module__, "", {}, ahead_of(file)) if own else None
