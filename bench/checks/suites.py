"""Which checks a subject has to pass, and how they are made in a plugin author's own tests."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from bench.checks.base import NotApplicable
from bench.checks.diagnosers import DIAGNOSER_CHECKS
from bench.checks.effects import EFFECT_CHECKS
from bench.checks.simulators import SIMULATOR_CHECKS
from bench.checks.tuners import TUNER_CHECKS
from bench.diagnoser import Diagnoser
from methods.base import Tuner
from sims.base import InputError, Simulator
from sims.system import Effect

if TYPE_CHECKING:
    import pytest

Check = Callable[[Any], NotApplicable | None]
"""Raises `CheckError` where its subject does not conform."""

SUITES: dict[str, tuple[Check, ...]] = {
    "tuner": TUNER_CHECKS,
    "simulator": SIMULATOR_CHECKS,
    "effect": EFFECT_CHECKS,
    "diagnoser": DIAGNOSER_CHECKS,
}
_BASES: dict[str, type] = {
    "tuner": Tuner,
    "simulator": Simulator,
    "effect": Effect,
    "diagnoser": Diagnoser,
}


def suite_of(subject: type) -> tuple[Check, ...]:
    """The checks for a class.

    Raises:
        InputError: it is neither a tuner, a simulator, an effect nor a diagnoser.
    """
    for kind, base in _BASES.items():
        if inspect.isclass(subject) and issubclass(subject, base):
            return SUITES[kind]
    raise InputError(
        f"expected a subclass of Tuner, Simulator, Effect or Diagnoser, found {subject!r:.80}"
    )


def parametrize(*subjects: type) -> pytest.MarkDecorator:
    """A pytest mark that makes one test of each conformance check of these classes::

        @simgap.parametrize(MyTuner, MyEffect)
        def test_conformance(check):
            check()

    A check that does not apply is skipped with its reason; one that stands in the subject's
    `known_failures` is expected to fail, and a failure if it passes.

    Raises:
        InputError: a subject is neither a tuner, a simulator, an effect nor a diagnoser.
    """
    import pytest

    cases = []
    for subject in subjects:
        known = getattr(subject, "known_failures", {})
        for check in suite_of(subject):
            name = check.__name__
            marks = [pytest.mark.xfail(reason=known[name], strict=True)] if name in known else []
            title = f"{subject.__name__}-{name.removeprefix('check_')}"
            cases.append(pytest.param(_bound(check, subject), id=title, marks=marks))
    return pytest.mark.parametrize("check", cases)


def _bound(check: Check, subject: type) -> Callable[[], None]:
    """The check of this subject, as a test without arguments."""

    def made() -> None:
        import pytest

        if (outcome := check(subject)) is not None:
            pytest.skip(f"not applicable: {outcome.reason}")

    return made
