"""Which checks a subject has to pass, and how they are made in a plugin author's own tests."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING

from bench.checks.base import Check
from bench.checks.diagnosers import DIAGNOSER_CHECKS, DIAGNOSER_NEEDS
from bench.checks.effects import EFFECT_CHECKS, EFFECT_NEEDS
from bench.checks.simulators import SIMULATOR_CHECKS, SIMULATOR_NEEDS
from bench.checks.tuners import TUNER_CHECKS, TUNER_NEEDS
from bench.diagnoser import Diagnoser
from methods.base import Tuner
from sims.base import InputError, Simulator
from sims.system import Effect

if TYPE_CHECKING:
    import pytest

SUITES: dict[str, tuple[Check, ...]] = {
    "tuner": TUNER_CHECKS,
    "simulator": SIMULATOR_CHECKS,
    "effect": EFFECT_CHECKS,
    "diagnoser": DIAGNOSER_CHECKS,
}
NEEDS: Mapping[Check, tuple[Check, ...]] = {
    **TUNER_NEEDS,
    **SIMULATOR_NEEDS,
    **EFFECT_NEEDS,
    **DIAGNOSER_NEEDS,
}
"""The checks that must not have failed for a check to mean anything: one cause, one failure."""

_BASES: dict[str, type] = {
    "tuner": Tuner,
    "simulator": Simulator,
    "effect": Effect,
    "diagnoser": Diagnoser,
}


def title_of(check: Check) -> str:
    """What a check is called."""
    return check.__name__.removeprefix("check_").replace("_", " ")


def failed_need(check: Check, failed: Collection[Check]) -> Check | None:
    """The failed check without which this one means nothing, directly or through others.

    Args:
        check: not made yet.
        failed: the checks of the same subject that have failed.
    """
    for needed in NEEDS.get(check, ()):
        if needed in failed:
            return needed
        if (root := failed_need(needed, failed)) is not None:
            return root
    return None


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

    A check that does not apply is skipped with its reason, and so is one that means nothing because
    another has failed; one that stands in the subject's `known_failures` is expected to fail, and a
    failure if it passes.

    Raises:
        InputError: a subject is neither a tuner, a simulator, an effect nor a diagnoser.
    """
    import pytest

    cases = []
    for subject in subjects:
        known = getattr(subject, "known_failures", {})
        failed: set[Check] = set()
        for check in suite_of(subject):
            name = check.__name__
            marks = [pytest.mark.xfail(reason=known[name], strict=True)] if name in known else []
            title = f"{subject.__name__}-{name.removeprefix('check_')}"
            cases.append(pytest.param(_bound(check, subject, failed), id=title, marks=marks))
    return pytest.mark.parametrize("check", cases)


def _bound(check: Check, subject: type, failed: set[Check]) -> Callable[[], None]:
    """The check of this subject, as a test without arguments.

    Args:
        check: to be made.
        subject: a class.
        failed: the checks of this subject that have failed; this one is added if it fails.
    """

    def made() -> None:
        import pytest

        if (needed := failed_need(check, failed)) is not None:
            pytest.skip(f"not tested: needs '{title_of(needed)}'")
        try:
            outcome = check(subject)
        except Exception:
            if check.__name__ not in getattr(subject, "known_failures", {}):
                failed.add(check)
            raise
        if outcome is not None:
            pytest.skip(f"not applicable: {outcome.reason}")

    return made
