"""What `simgap check NAME` does: the conformance suite on a tuner, a simulator or an effect, each
check isolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from bench.checks import EFFECT_CHECKS, SIMULATOR_CHECKS, TUNER_CHECKS, CheckError
from bench.checks.processes import LIMIT
from bench.checks.tuners import check_same_run_in_other_processes
from bench.registry import simulators, tuners
from bench.runs.pools import LocalPool
from sims import effects
from sims.base import InputError, unknown

_SUITES: dict[str, tuple[Callable[[Any], None], ...]] = {
    "tuner": TUNER_CHECKS,
    "simulator": SIMULATOR_CHECKS,
    "effect": EFFECT_CHECKS,
}
_HERE = (check_same_run_in_other_processes,)
"""Checks that start worker processes themselves."""
_KNOWN = "known: "


def kind_of(name: str) -> str:
    """Whether `name` is a tuner, a simulator or an effect.

    Raises:
        InputError: it is none.
    """
    kinds = {"tuner": tuners.names(), "simulator": simulators.names(), "effect": effects.names()}
    for kind, names in kinds.items():
        if name in names:
            return kind
    raise unknown(
        "tuner, simulator or effect", name, [n for names in kinds.values() for n in names]
    )


def _subject(kind: str, name: str) -> Any:
    if kind == "effect":
        return effects.get(name)
    return tuners.get(name) if kind == "tuner" else simulators.get(name)


def attempt(kind: str, name: str, place: int) -> str:
    """Make one check in this process; returns what is wrong, or nothing."""
    check, subject = _SUITES[kind][place], _subject(kind, name)
    known = getattr(subject, "known_failures", {}).get(check.__name__)
    try:
        check(subject)
    except CheckError as error:
        return f"{_KNOWN}{known}" if known else str(error)
    return (
        f"expected to fail ({known}); found that it passes; see {name}.known_failures"
        if known
        else ""
    )


def run(name: str, plugins: Sequence[str], say: Callable[[str], None]) -> bool:
    """Make every check and say how each ends; returns whether all is well.

    Args:
        name: registered name of a tuner, simulator or effect.
        plugins: plugin files; loaded in this process already.
        say: prints a line.

    Raises:
        InputError: no such name, or it cannot be used here.
    """
    kind = kind_of(name)
    subject = _subject(kind, name)
    checks = _SUITES[kind]
    ends = _isolated(kind, name, plugins)
    for place, check in enumerate(checks):
        if check in _HERE and not any(isinstance(end, Exception) for end in ends.values()):
            ends[place] = attempt(
                kind, name, place
            )  # it runs the subject here too, which is known to be safe now
    failed = 0
    for place, check in enumerate(checks):
        line = _line(ends.get(place, "not made: the subject does not survive the others"))
        bad = bool(line) and not line.startswith(_KNOWN)
        failed += bad
        title = check.__name__.removeprefix("check_").replace("_", " ")
        mark = "FAILED" if bad else "known " if line else "ok    "
        say(f"{mark}  {title}" + (f"\n        {line.removeprefix(_KNOWN)}" if line else ""))
    summary = (
        f"{failed} of {len(checks)} checks failed" if failed else f"all {len(checks)} checks passed"
    )
    say(f"{kind} {name} ({subject.__module__}.{subject.__qualname__}): {summary}")
    return not failed


def _isolated(kind: str, name: str, plugins: Sequence[str]) -> dict[int, Any]:
    """How each check ends in a worker process; after two that had to be killed, or died, no more
    are made.
    """
    places = [place for place, check in enumerate(_SUITES[kind]) if check not in _HERE]
    ends: dict[int, Any] = {}
    with LocalPool(1) as pool:
        pool.load(plugins)
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
