"""What `simgap check NAME` does: the conformance suite on a tuner, a simulator, an effect or a
diagnoser, each
check isolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from bench.checks.base import CheckError
from bench.checks.processes import LIMIT
from bench.checks.suites import SUITES
from bench.checks.tuners import check_same_run_in_other_processes
from bench.registry import REGISTRIES
from bench.runs.pools import LocalPool
from bench.runs.survey import Plugin
from sims.base import InputError, unknown

_HERE = (check_same_run_in_other_processes,)
"""Checks that start worker processes themselves."""
_KNOWN = "known: "
"""Begins the line of a check that fails on purpose."""
_IDLE = "not applicable: "
"""Begins the line of a check that found nothing to check."""
_MARKS = {_KNOWN: "known ", _IDLE: "-     "}
_OUTCOMES = {"ok    ": "passed", "known ": "known", "-     ": "not applicable", "FAILED": "failed"}
"""What a mark is called where there is no room to be saved."""


class Checked(NamedTuple):
    """What the conformance suite has found.

    Attributes:
        name: of the subject.
        kind: tuner, simulator or effect.
        qualified: its class.
        lines: of each check by its title: what was found, nothing where all is well.
    """

    name: str
    kind: str
    qualified: str
    lines: dict[str, str]

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return all(_mark(line) != "FAILED" for line in self.lines.values())

    def document(self) -> dict[str, Any]:
        """For programs."""
        checks = [
            {"check": title, "outcome": _OUTCOMES[_mark(line)], "says": line.strip()}
            for title, line in self.lines.items()
        ]
        return {
            "name": self.name,
            "kind": self.kind,
            "class": self.qualified,
            "passed": self.passed,
            "checks": checks,
        }


def kind_of(name: str) -> str:
    """Whether `name` is a tuner, a simulator, an effect or a diagnoser.

    Raises:
        InputError: it is none.
    """
    for registry in REGISTRIES:
        if name in registry.names():
            return registry.kind
    names = [name for registry in REGISTRIES for name in registry.names()]
    raise unknown("tuner, simulator, effect or diagnoser", name, names)


def _subject(kind: str, name: str) -> Any:
    return {registry.kind: registry for registry in REGISTRIES}[kind].get(name)


def attempt(kind: str, name: str, place: int) -> str:
    """Make one check in this process; returns what is wrong, or nothing."""
    check, subject = SUITES[kind][place], _subject(kind, name)
    known = getattr(subject, "known_failures", {}).get(check.__name__)
    try:
        outcome = check(subject)
    except CheckError as error:
        return f"{_KNOWN}{known}" if known else str(error)
    if known:
        return f"expected to fail ({known}); found that it passes; see {name}.known_failures"
    return f"{_IDLE}{outcome.reason}" if outcome else ""


def run(name: str, plugins: Sequence[str], say: Callable[[str], None]) -> Checked:
    """Make every check and say how each ends.

    Args:
        name: registered name of a tuner, simulator, effect or diagnoser.
        plugins: plugin files; loaded in this process already.
        say: prints a line.

    Raises:
        InputError: no such name, or it cannot be used here.
    """
    kind = kind_of(name)
    subject = _subject(kind, name)
    checks = SUITES[kind]
    ends = _isolated(kind, name, plugins)
    for place, check in enumerate(checks):
        if check in _HERE and not any(isinstance(end, Exception) for end in ends.values()):
            # It runs the subject here too, which is known to be safe now.
            ends[place] = attempt(kind, name, place)
    lines = {
        check.__name__.removeprefix("check_").replace("_", " "): _line(
            ends.get(place, "not made: the subject does not survive the others")
        )
        for place, check in enumerate(checks)
    }
    for title, line in lines.items():
        below = f"\n        {line.removeprefix(_KNOWN)}" if line else ""
        say(f"{_mark(line)}  {title}{below}")
    checked = Checked(name, kind, f"{subject.__module__}.{subject.__qualname__}", lines)
    say(f"{kind} {name} ({checked.qualified}): {_summary(checked)}")
    return checked


def _summary(checked: Checked) -> str:
    """How many checks failed."""
    failed = sum(_mark(line) == "FAILED" for line in checked.lines.values())
    idle = sum(line.startswith(_IDLE) for line in checked.lines.values())
    made = len(checked.lines) - idle
    rest = f", {idle} not applicable" if idle else ""
    if failed:
        return f"{failed} of {made} checks failed{rest}"
    return f"all {made} checks passed{rest}"


def _mark(line: str) -> str:
    """The word before a check's title."""
    for begin, mark in _MARKS.items():
        if line.startswith(begin):
            return mark
    return "FAILED" if line else "ok    "


def _isolated(kind: str, name: str, plugins: Sequence[str]) -> dict[int, Any]:
    """How each check ends in a worker process; after two that had to be killed, or died, no more
    are made.
    """
    places = [place for place, check in enumerate(SUITES[kind]) if check not in _HERE]
    ends: dict[int, Any] = {}
    with LocalPool(1) as pool:
        pool.load([Plugin(path) for path in plugins])
        for i, end in pool.results([(attempt, (kind, name, place)) for place in places], LIMIT):
            ends[places[i]] = end
            if sum(isinstance(e, Exception) for e in ends.values()) == 2:
                break
    return ends


def _line(end: Any) -> str:
    """What a check found, in lines that stand below its title."""
    if isinstance(end, TimeoutError):
        return f"expected an end within {LIMIT:g} s; found none; see what it waits for"
    if isinstance(end, InputError):
        return str(end)
    if isinstance(end, Exception):
        return f"expected to survive; found {type(end).__name__}: {end}; see where it says"
    return str(end).strip().replace("\n", "\n        ")
