"""Conformance suites for tuners, simulators, effects and diagnosers.

Each check is a function that raises `CheckError` if its subject does not conform; the message says
what was expected, what was found and where to look. A check returns `NotApplicable` if there was
nothing to check. The tests of this project run the suites on everything that is registered. Authors
of plugins use `parametrize(MyTuner)` in their own tests, or ``simgap check NAME``.
"""

from bench.checks.base import CheckError, NotApplicable
from bench.checks.diagnosers import DIAGNOSER_CHECKS
from bench.checks.effects import EFFECT_CHECKS
from bench.checks.simulators import SIMULATOR_CHECKS
from bench.checks.suites import parametrize
from bench.checks.tuners import TUNER_CHECKS

__all__ = [
    "DIAGNOSER_CHECKS",
    "EFFECT_CHECKS",
    "SIMULATOR_CHECKS",
    "TUNER_CHECKS",
    "CheckError",
    "NotApplicable",
    "parametrize",
]
