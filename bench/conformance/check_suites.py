"""Check suites by kind of subject: their pytest parametrisation, and `simgap check NAME`.

The subject is a tuner, a simulator, an effect or a diagnoser. A check is not run if another check
that it needs has failed, so that one cause gives one failure.
"""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.benchmark.runner.plugin_inspection import Plugin
from bench.benchmark.runner.worker_pools import LocalPool
from bench.conformance.check_base import CALL_TIMEOUT_SECONDS, Check, CheckError
from bench.conformance.diagnoser_checks import DIAGNOSER_CHECKS
from bench.conformance.effect_checks import EFFECT_CHECKS
from bench.conformance.simulator_checks import SIMULATOR_CHECKS
from bench.conformance.tuner_checks import (
    TUNER_CHECKS,
    check_same_run_in_other_processes,
)
from bench.core.diagnoser import Diagnoser
from bench.core.plugin_registries import REGISTRIES, find_part_kind
from methods.tuner import Tuner
from sims.core.effect import Effect
from sims.core.simulator import InputError, Simulator

if TYPE_CHECKING:
    import pytest


SUITES: dict[str, Mapping[Check, tuple[Check, ...]]] = {
    "tuner": TUNER_CHECKS,
    "simulator": SIMULATOR_CHECKS,
    "effect": EFFECT_CHECKS,
    "diagnoser": DIAGNOSER_CHECKS,
}
"""Checks of each kind of subject, each with those that must pass for it to be meaningful.

One cause then gives one failure.
"""
_NEEDS = {check: needed for suite in SUITES.values() for check, needed in suite.items()}

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
    for needed_check in _NEEDS[check]:
        if needed_check in failed:
            return needed_check
        if (root := failed_need(needed_check, failed)) is not None:
            return root
    return None


def get_suite(subject: type) -> Mapping[Check, tuple[Check, ...]]:
    """Return the checks for a class, each with those that it needs.

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

    Args:
        subjects: classes to be checked: tuners, simulators, effects or diagnosers.

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
            marks = []
            if name in known_failures:  # strict: a check that passes nevertheless fails
                marks = [pytest.mark.xfail(reason=known_failures[name], strict=True)]
            title = f"{subject.__name__}-{name.removeprefix('check_')}"
            cases.append(pytest.param(_bind_check(check, subject, failed), id=title, marks=marks))
    return pytest.mark.parametrize("check", cases)


def _bind_check(check: Check, subject: type, failed: set[Check]) -> Callable[[], None]:
    """Bind a check to its subject, as a test without arguments.

    Args:
        check: check function.
        subject: a class.
        failed: failed checks of this subject; this check is added if it fails.
    """

    def run_check() -> None:
        """Run the check as a pytest test; skip it if an earlier check that it needs has failed.

        `check`, `subject` and the set `failed` of checks that have failed are bound by the
        enclosing function. A failure that the subject announces in `known_failures` does not skip
        the checks that need it.
        """
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


_MULTIPROCESS_CHECKS = (check_same_run_in_other_processes,)
"""Checks that start worker processes themselves."""
_OUTCOME_LABELS = {
    "passed": "ok    ",
    "failed": "FAILED",
    "known": "known ",
    "not applicable": "-     ",
    "not tested": "-     ",
}
"""Label for people by outcome."""


class CheckResult(NamedTuple):
    """Result of a check.

    Attributes:
        outcome: ``passed``, ``failed``, ``known`` for a failure that the subject announces, ``not
            applicable`` or ``not tested``.
        reason: what failed, or why the check was not run; empty if it passed.
    """

    outcome: str
    reason: str = ""

    @property
    def says(self) -> str:
        """Outcome, if it is neither passed nor failed, and reason."""
        is_run = self.outcome in ("passed", "failed")
        return self.reason if is_run else f"{self.outcome}: {self.reason}"


class SuiteResult(NamedTuple):
    """Result of a conformance suite.

    Attributes:
        name: name of the subject.
        kind: tuner, simulator, effect or diagnoser.
        qualified: qualified name of its class.
        results: result of each check by its title.
    """

    name: str
    kind: str
    qualified: str
    results: dict[str, CheckResult]

    @property
    def has_passed(self) -> bool:
        """True if no check failed."""
        return all(result.outcome != "failed" for result in self.results.values())

    def to_document(self) -> dict[str, Any]:
        """Convert the results of the conformance checks to a JSON document.

        Each check has its title, its outcome (passed, failed, known, not tested, not applicable)
        and the line that was printed.
        """
        checks = [
            {"check": title, "outcome": result.outcome, "says": result.says}
            for title, result in self.results.items()
        ]
        return {
            "name": self.name,
            "kind": self.kind,
            "class": self.qualified,
            "passed": self.has_passed,
            "checks": checks,
        }


def _get_subject(kind: str, name: str) -> Any:
    return {registry.kind: registry for registry in REGISTRIES}[kind].get(name)


def run_check(kind: str, name: str, check: Check) -> CheckResult:
    """Run one check in this process.

    Args:
        kind: tuner, simulator, effect or diagnoser.
        name: registered name of the subject.
        check: the check.

    Returns:
        The result. A failed `CheckError` that the subject announces in `known_failures` is known;
        an announced failure that does not happen counts as failed.
    """
    subject = _get_subject(kind, name)
    known_failure = getattr(subject, "known_failures", {}).get(check.__name__)
    try:
        outcome = check(subject)
    except CheckError as error:
        return CheckResult("known", known_failure) if known_failure else _make_failure(error)
    except InputError as error:
        return _make_failure(error)
    except Exception as error:
        location = _describe_raise_location(error)
        return _make_failure(
            f"expected no exception; found {type(error).__name__}: {error}; {location}"
        )
    if known_failure:
        return _make_failure(
            f"expected to fail ({known_failure}); found that it passes; see {name}.known_failures"
        )
    return CheckResult("not applicable", outcome.reason) if outcome else CheckResult("passed")


def _make_failure(reason: object) -> CheckResult:
    """Make the result of a failed check, with the further lines of its reason indented."""
    return CheckResult("failed", str(reason).strip().replace("\n", "\n        "))


def _describe_raise_location(error: Exception) -> str:
    """Describe where the subject's own code raised an exception, or else where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    root = Path(__file__).parents[2]
    own_folders = tuple(str(root / name) for name in ("bench", "methods", "sims"))
    subject_frames = [frame for frame in frames if not frame.filename.startswith(own_folders)]
    # The innermost frame; all frames are the project's if it tests its own classes.
    frame = (subject_frames or list(frames))[-1]
    return f"see {Path(frame.filename).name}, line {frame.lineno}, in {frame.name}"


def run_suite(name: str, plugins: Sequence[str], print_line: Callable[[str], None]) -> SuiteResult:
    """Run all checks and print the result of each.

    Args:
        name: registered name of a tuner, simulator, effect or diagnoser.
        plugins: plugin files, which are already loaded in this process.
        print_line: prints a line.

    Raises:
        InputError: the name does not exist, or the subject cannot be used here.
    """
    kind = find_part_kind(name)
    subject = _get_subject(kind, name)
    results = {}
    for check, result in _run_all_checks(kind, name, plugins):
        results[title_of(check)] = result
        # The label of the outcome says already that a failure is known.
        line = result.reason if result.outcome == "known" else result.says
        error_text = f"\n        {line}" if line else ""
        print_line(f"{_OUTCOME_LABELS[result.outcome]}  {title_of(check)}{error_text}")
    checked = SuiteResult(name, kind, f"{subject.__module__}.{subject.__qualname__}", results)
    print_line(f"{kind} {name} ({checked.qualified}): {_summarise_checks(checked)}")
    return checked


def _summarise_checks(checked: SuiteResult) -> str:
    """Summarise how many checks failed and how many were not run.

    Args:
        checked: Result of all checks of one subject.

    Returns:
        One line, such as "2 of 14 checks failed, 3 not applicable".
    """
    outcomes = [result.outcome for result in checked.results.values()]
    unrun_counts = {
        outcome: outcomes.count(outcome) for outcome in ("not tested", "not applicable")
    }
    checked_count, failed = len(outcomes) - sum(unrun_counts.values()), outcomes.count("failed")
    other_counts = "".join(
        f", {count} {outcome}" for outcome, count in unrun_counts.items() if count
    )
    if failed:
        return f"{failed} of {checked_count} checks failed{other_counts}"
    return f"all {checked_count} checks passed{other_counts}"


def _run_all_checks(
    kind: str, name: str, plugins: Sequence[str]
) -> Iterator[tuple[Check, CheckResult]]:
    """Run the checks one after another, and yield each with its result.

    Each check runs in a worker process, which a bad subject may block or end. After two checks that
    were killed or whose process died, no more checks are run.

    Args:
        kind: kind of the subject: tuner, simulator, effect or diagnoser.
        name: registered name of the subject.
        plugins: paths of the plugin files.
    """
    failed: list[Check] = []
    lost_workers = 0
    with LocalPool(1) as pool:
        pool.load_plugins([Plugin(path) for path in plugins])
        for check in SUITES[kind]:
            failed_check = failed_need(check, failed)
            if failed_check is not None:
                result = CheckResult("not tested", f"needs '{title_of(failed_check)}'")
            elif lost_workers == 2 or (lost_workers and check in _MULTIPROCESS_CHECKS):
                result = CheckResult(
                    "not tested", "the process of other checks ended or was killed"
                )
            elif check in _MULTIPROCESS_CHECKS:
                # A check that starts workers itself cannot run in one. It runs the subject in this
                # process too; earlier checks have shown that this is safe.
                result = run_check(kind, name, check)
            else:
                # One call gives exactly one pair of index and result.
                ((_, result_or_error),) = pool.iterate_results(
                    [(run_check, (kind, name, check))], CALL_TIMEOUT_SECONDS
                )
                if isinstance(result_or_error, CheckResult):
                    result = result_or_error
                else:
                    # An InputError was raised by the worker; any other error is its end.
                    lost_workers += not isinstance(result_or_error, InputError)
                    result = _describe_lost_check(result_or_error)
            if result.outcome == "failed":
                failed.append(check)
            yield check, result


def _describe_lost_check(error: Exception) -> CheckResult:
    """Return the result of a check that has not ended in its worker process.

    Args:
        error: Timeout, wrong input, or the death of the process.
    """
    if isinstance(error, TimeoutError):
        return _make_failure(
            f"expected an end within {CALL_TIMEOUT_SECONDS:g} s; found none; see what it waits for"
        )
    if isinstance(error, InputError):
        return _make_failure(error)
    return _make_failure(
        f"expected the process to survive; found {type(error).__name__}: {error}; see its output"
    )
