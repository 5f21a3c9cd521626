"""Conformance suites for tuners, simulators and effects: to register is to be tested.

Each check is a function that raises `CheckError` when its subject does not conform, saying what was
expected, what was found and where to look. The suites run over everything registered in this
project's tests, and are shipped for authors of plugins: ``for check in bench.checks.TUNER_CHECKS:
check(MyTuner)``.
"""

from bench.checks.base import CheckError
from bench.checks.effects import EFFECT_CHECKS
from bench.checks.simulators import SIMULATOR_CHECKS
from bench.checks.tuners import TUNER_CHECKS

__all__ = ["EFFECT_CHECKS", "SIMULATOR_CHECKS", "TUNER_CHECKS", "CheckError"]
