"""Check suites by kind of subject, and their pytest parametrisation for authors of plugins."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING

from bench.conformance.check_base import Check
from bench.conformance.diagnoser_checks import DIAGNOSER_CHECKS, DIAGNOSER_NEEDS
from bench.conformance.effect_checks import EFFECT_CHECKS, EFFECT_NEEDS
from bench.conformance.simulator_checks import SIMULATOR_CHECKS, SIMULATOR_NEEDS
from bench.conformance.tuner_checks import TUNER_CHECKS, TUNER_NEEDS
from bench.core.diagnoser import Diagnoser
from methods.tuner import Tuner
from sims.core.effect import Effect
from sims.core.simulator import InputError, Simulator

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
"""For each check, the checks that must pass for it to be meaningful.

One cause then gives one failure.
"""

_BASES: dict[str, type] = {
    "tuner": Tuner,
    "simulator": Simulator,
    "effect": Effect,
    "diagnoser": Diagnoser,
}


def title_of(check: Check) -> str:
    """Return the title of a check."""
    return check.__name__.removeprefix("check_").replace("_", " ")


def failed_need(check: Check, failed: Collection[Check]) -> Check | None:
    """Find the failed check that makes another check meaningless, directly or through others.

    Args:
        check: a check that has not been run.
        failed: failed checks of the same subject.

    Returns:
        The failed check, or None.
    """
    for needed_check in NEEDS.get(check, ()):
        if needed_check in failed:
            return needed_check
        if (root := failed_need(needed_check, failed)) is not None:
            return root
    return None


def get_suite(subject: type) -> tuple[Check, ...]:
    """Return the checks for a class.

    Raises:
        InputError: the class is not a tuner, simulator, effect or diagnoser.
    """
    for kind, base in _BASES.items():
        if inspect.isclass(subject) and issubclass(subject, base):
            return SUITES[kind]
    raise InputError(
        f"expected a subclass of Tuner, Simulator, Effect or Diagnoser, found {subject!r:.80}"
    )


def parametrize(*subjects: type) -> pytest.MarkDecorator:
    """Make a pytest mark that runs each conformance check of some classes as one test.

    Use it in a test module::

        @simgap.parametrize(MyTuner, MyEffect)
        def test_conformance(check):
            check()

    A check that does not apply is skipped with its reason. A check is also skipped if another check
    that it needs has failed. A check in the subject's `known_failures` is expected to fail, and
    counts as failed if it passes.

    Raises:
        InputError: a subject is not a tuner, simulator, effect or diagnoser.
    """
    import pytest

    cases = []
    for subject in subjects:
        known_failures = getattr(subject, "known_failures", {})
        failed: set[Check] = set()
        for check in get_suite(subject):
            name = check.__name__
            marks = (
                [pytest.mark.xfail(reason=known_failures[name], strict=True)]
                if name in known_failures
                else []
            )
            title = f"{subject.__name__}-{name.removeprefix('check_')}"
            cases.append(pytest.param(_bind_check(check, subject, failed), id=title, marks=marks))
    return pytest.mark.parametrize("check", cases)


def _bind_check(check: Check, subject: type, failed: set[Check]) -> Callable[[], None]:
    """Bind a check to its subject, as a test without arguments.

    Args:
        check: the check.
        subject: a class.
        failed: failed checks of this subject; this check is added if it fails.
    """

    def run_check() -> None:
        """Run the check as a pytest test; skip it if an earlier check that it needs has failed."""
        import pytest

        if (failed_check := failed_need(check, failed)) is not None:
            pytest.skip(f"not tested: needs '{title_of(failed_check)}'")
        try:
            outcome = check(subject)
        except Exception:
            if check.__name__ not in getattr(subject, "known_failures", {}):
                failed.add(check)
            raise
        if outcome is not None:
            pytest.skip(f"not applicable: {outcome.reason}")

    return run_check
