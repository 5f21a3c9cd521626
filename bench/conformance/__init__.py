"""Conformance suites for tuners, simulators, effects and diagnosers.

Each check is a function that raises `CheckError` if its subject does not conform; the message says
what was expected, what was found and where to look. A check returns `NotApplicable` if there was
nothing to check. The tests of this project run the suites on everything that is registered. Authors
of plugins use `parametrize(MyTuner)` in their own tests, or ``simgap check NAME``.
"""

from bench.conformance.check_base import CheckError, NotApplicable
from bench.conformance.check_suites import parametrize
from bench.conformance.diagnoser_checks import DIAGNOSER_CHECKS
from bench.conformance.effect_checks import EFFECT_CHECKS
from bench.conformance.simulator_checks import SIMULATOR_CHECKS
from bench.conformance.tuner_checks import TUNER_CHECKS

__all__ = [
    "DIAGNOSER_CHECKS",
    "EFFECT_CHECKS",
    "SIMULATOR_CHECKS",
    "TUNER_CHECKS",
    "CheckError",
    "NotApplicable",
    "parametrize",
]
