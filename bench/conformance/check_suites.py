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

from bench.benchmark.runner.plugin_discovery import Plugin
from bench.benchmark.runner.worker_pools import LocalPool
from bench.conformance.check_base import CALL_TIMEOUT_SECONDS, Check, CheckError
from bench.conformance.diagnoser_checks import DIAGNOSER_CHECKS, DIAGNOSER_NEEDS
from bench.conformance.effect_checks import EFFECT_CHECKS, EFFECT_NEEDS
from bench.conformance.simulator_checks import SIMULATOR_CHECKS, SIMULATOR_NEEDS
from bench.conformance.tuner_checks import (
    TUNER_CHECKS,
    TUNER_NEEDS,
    check_same_run_in_other_processes,
)
from bench.core.diagnoser import Diagnoser
from bench.core.plugin_registries import REGISTRIES
from methods.tuner import Tuner
from sims.core.effect import Effect
from sims.core.simulator import InputError, Simulator, make_unknown_name_error

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
        check: check function; its docstring is its title.
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
_EXPECTED_FAILURE_PREFIX = "known: "
"""Prefix of the line of a check that fails on purpose."""
_NOT_APPLICABLE_PREFIX = "not applicable: "
"""Prefix of the line of a check that does not apply to the subject."""
_LEFT_OUT = "not tested: "
"""Prefix of the line of a check that was not run."""
_OUTCOMES = {
    _EXPECTED_FAILURE_PREFIX: ("known", "known "),
    _NOT_APPLICABLE_PREFIX: ("not applicable", "-     "),
    _LEFT_OUT: ("not tested", "-     "),
}
"""Outcome for programs and label for people, by the prefix of a line."""


class SuiteResult(NamedTuple):
    """Result of a conformance suite.

    Attributes:
        name: name of the subject.
        kind: tuner, simulator, effect or diagnoser.
        qualified: qualified name of its class.
        lines: line of each check by its title; empty if the check passed.
    """

    name: str
    kind: str
    qualified: str
    lines: dict[str, str]

    @property
    def has_passed(self) -> bool:
        """True if no check failed."""
        return all(_classify_line(line)[0] != "failed" for line in self.lines.values())

    def to_document(self) -> dict[str, Any]:
        """Convert the results of the conformance checks to a JSON document.

        Each check has its title, its outcome (passed, failed, not tested, not applicable) and the
        line that was printed.
        """
        checks = [
            {"check": title, "outcome": _classify_line(line)[0], "says": line.strip()}
            for title, line in self.lines.items()
        ]
        return {
            "name": self.name,
            "kind": self.kind,
            "class": self.qualified,
            "passed": self.has_passed,
            "checks": checks,
        }


def find_part_kind(name: str) -> str:
    """Return whether a name is that of a tuner, simulator, effect or diagnoser.

    Raises:
        InputError: nothing is registered under this name.
    """
    for registry in REGISTRIES:
        if name in registry.names():
            return registry.kind
    names = [name for registry in REGISTRIES for name in registry.names()]
    raise make_unknown_name_error("tuner, simulator, effect or diagnoser", name, names)


def _get_subject(kind: str, name: str) -> Any:
    return {registry.kind: registry for registry in REGISTRIES}[kind].get(name)


def run_check(kind: str, name: str, place: int) -> str:
    """Run one check in this process.

    Args:
        kind: kind of the subject.
        name: name of the subject.
        place: index of the check in its suite.

    Returns:
        Description of the failure, or an empty text.
    """
    check, subject = SUITES[kind][place], _get_subject(kind, name)
    known_failure = getattr(subject, "known_failures", {}).get(check.__name__)
    try:
        outcome = check(subject)
    except CheckError as error:
        return f"{_EXPECTED_FAILURE_PREFIX}{known_failure}" if known_failure else str(error)
    except InputError as error:
        return str(error)
    except Exception as error:
        location = _describe_raise_location(error)
        return f"expected no exception; found {type(error).__name__}: {error}; {location}"
    if known_failure:
        return (
            f"expected to fail ({known_failure}); found that it passes; see {name}.known_failures"
        )
    return f"{_NOT_APPLICABLE_PREFIX}{outcome.reason}" if outcome else ""


def _describe_raise_location(error: Exception) -> str:
    """Describe where the subject's own code raised an exception, or else where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    packages = Path(__file__).parents[2]
    folders = [str(packages / name) for name in ("bench", "methods", "sims")]
    subject_frames = [frame for frame in frames if not frame.filename.startswith(tuple(folders))]
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
    lines = {}
    for check, line in _run_all_checks(kind, name, plugins):
        lines[title_of(check)] = line
        error_text = f"\n        {line.removeprefix(_EXPECTED_FAILURE_PREFIX)}" if line else ""
        print_line(f"{_classify_line(line)[1]}  {title_of(check)}{error_text}")
    checked = SuiteResult(name, kind, f"{subject.__module__}.{subject.__qualname__}", lines)
    print_line(f"{kind} {name} ({checked.qualified}): {_summarise_checks(checked)}")
    return checked


def _summarise_checks(checked: SuiteResult) -> str:
    """Summarise how many checks failed and how many were not run.

    Args:
        checked: Result of all checks of one subject, with one printed line per check.

    Returns:
        One line, such as "2 of 14 checks failed, 3 not applicable".
    """
    outcomes = [_classify_line(line)[0] for line in checked.lines.values()]
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


def _classify_line(line: str) -> tuple[str, str]:
    """Return outcome and label of the check with a line; an empty line is a passed check."""
    for prefix, outcome_and_label in _OUTCOMES.items():
        if line.startswith(prefix):
            return outcome_and_label
    return ("failed", "FAILED") if line else ("passed", "ok    ")


def _run_all_checks(kind: str, name: str, plugins: Sequence[str]) -> Iterator[tuple[Check, str]]:
    """Run the checks one after another, and yield each with its line (empty if it passed).

    After two checks that were killed or whose process died, no more checks are run.

    Args:
        kind: kind of the subject: tuner, simulator, effect or diagnoser.
        name: registered name of the subject.
        plugins: paths of the plugin files.
    """
    failed: list[Check] = []
    lost_workers = 0
    with LocalPool(1) as pool:
        pool.load_plugins([Plugin(path) for path in plugins])
        for place, check in enumerate(SUITES[kind]):
            failed_check = failed_need(check, failed)
            if failed_check is not None:
                line = f"{_LEFT_OUT}needs '{title_of(failed_check)}'"
            elif lost_workers == 2 or (lost_workers and check in _MULTIPROCESS_CHECKS):
                line = f"{_LEFT_OUT}the process of other checks ended or was killed"
            elif check in _MULTIPROCESS_CHECKS:
                # This check runs the subject in this process too; earlier checks have shown that
                # this is safe.
                line = run_check(kind, name, place)
            else:
                ((_, end),) = pool.iterate_results(
                    [(run_check, (kind, name, place))], CALL_TIMEOUT_SECONDS
                )
                lost_workers += isinstance(end, Exception) and not isinstance(end, InputError)
                line = _format_check_end(end)
            if _classify_line(line)[0] == "failed":
                failed.append(check)
            yield check, line.strip().replace("\n", "\n        ")


def _format_check_end(end: Any) -> str:
    """Return the line of a check that ran in a worker process.

    Args:
        end: Result of the process: the finished line of the check, or the exception that ended it.

    Returns:
        The line to print: an error line if the check timed out, the input was wrong, or the process
        died.
    """
    if isinstance(end, TimeoutError):
        return (
            f"expected an end within {CALL_TIMEOUT_SECONDS:g} s; found none; see what it waits for"
        )
    if isinstance(end, InputError):
        return str(end)
    if isinstance(end, Exception):
        return f"expected the process to survive; found {type(end).__name__}: {end}; see its output"
    return str(end)
