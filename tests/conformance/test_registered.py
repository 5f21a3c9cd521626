"""Conformance suites applied to everything registered: registration includes the tests."""

import pytest

from bench.conformance import (
    DIAGNOSER_CHECKS,
    EFFECT_CHECKS,
    SIMULATOR_CHECKS,
    TUNER_CHECKS,
    CheckError,
)
from bench.core.plugin_registries import PartUnavailableError, diagnosers, simulators, tuners
from sims import effects


def subject(registry, name):
    try:
        return registry.get(name)
    except PartUnavailableError as reason:
        pytest.skip(f"{name}: {reason}")


LONG = ("hybrid", "in_context", "tunenet-published", "tunenet-vision")
"""Tuners that train longest: their checks take minutes of processor time."""


@pytest.mark.slow
@pytest.mark.parametrize("check", TUNER_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.long] if name in LONG else [])
        for name in tuners.names()
    ],
)
def test_tuner(name, check):
    kind = subject(tuners, name)
    if reason := kind.known_failures.get(check.__name__):
        with pytest.raises(CheckError):  # a check that passes is no longer a known failure
            check(kind)
        pytest.skip(f"known failure: {reason}")
    run_check(check, kind)


def run_check(check, kind):
    """Run a check, and skip the test if the check is not applicable."""
    if outcome := check(kind):
        pytest.skip(f"not applicable: {outcome.reason}")


@pytest.mark.parametrize("check", SIMULATOR_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", simulators.names())
def test_simulator(name, check):
    run_check(check, subject(simulators, name))


@pytest.mark.parametrize("check", EFFECT_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", effects.list_names())
def test_effect(name, check):
    run_check(check, effects.get_effect(name))


@pytest.mark.parametrize("name", diagnosers.names())
def test_diagnoser(name):
    """All checks of a diagnoser run in one process, since they share cached data."""
    kind = subject(diagnosers, name)
    for check in DIAGNOSER_CHECKS:
        check(kind)
