"""Shared parts of all conformance checks, and calls in worker processes."""

from __future__ import annotations

import atexit
import inspect
import random
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from bench.benchmark.runner.plugin_inspection import Plugin
from bench.benchmark.runner.worker_pools import LocalPool
from sims.core.simulator import Array


class CheckError(AssertionError):
    """Error of a subject that does not conform.

    The message says what was expected, what was found, and where to look.
    """


class NotApplicable(NamedTuple):
    """Result of a check that found nothing to check; it has neither passed nor failed.

    Attributes:
        reason: why the check does not apply to the subject.
    """

    reason: str


Check = Callable[[Any], NotApplicable | None]
"""Function that raises `CheckError` if its subject does not conform."""


def check(condition: bool, expected: str, found: object, location: str) -> None:
    """Raise `CheckError` unless a condition holds.

    Args:
        condition: the condition.
        expected: what was expected.
        found: what was found.
        location: where the author of the subject should look.
    """
    if not condition:
        raise CheckError(f"expected {expected}; found {found}; see {location}")


def is_bitwise_equal(a: Array, b: Array) -> bool:
    """Return whether two arrays have the same shape and the same bits, NaN included.

    Args:
        a: an array.
        b: another one.
    """
    return a.shape == b.shape and a.tobytes() == b.tobytes()


@contextmanager
def check_global_random_state(location: str) -> Iterator[None]:
    """Check that a block does not use the global random generators.

    The generators are those of `random`, NumPy and, if it is loaded, torch. Before the block, the
    first two are set to unusual seeds, so that seeding with a common number is detected; afterwards
    they are restored.

    Args:
        location: where the author of the subject should look.

    Raises:
        CheckError: the block draws from a global generator or seeds it.
    """
    python_state = random.getstate()
    numpy_state = np.random.get_state()  # noqa: NPY002 - it is what must not change
    # Large primes as seeds: a method that seeds with 0 or 42 certainly changes the state.
    random.seed(82_589_933)
    np.random.seed(30_402_457)  # noqa: NPY002
    states_before = _get_random_states()
    try:
        yield
        states_after = _get_random_states()
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002
    changed_generators = [
        name for name in states_before if states_before[name] != states_after[name]
    ]
    check(
        not changed_generators,
        "global random state unchanged",
        f"changed: {', '.join(changed_generators)}",
        location,
    )


def _get_random_states() -> dict[str, object]:
    """Return the states of the global random generators of Python, numpy and torch (if loaded).

    They are compared before and after a call, to see whether the call has used one of them.
    """
    numpy_state: Any = np.random.get_state(legacy=True)  # noqa: NPY002
    _, keys, *positions = numpy_state
    states: dict[str, object] = {
        "random": random.getstate(),
        # Bytes, because arrays cannot be compared as a whole.
        "numpy": (keys.tobytes(), *positions),
    }
    if "torch" in sys.modules:
        states["torch"] = sys.modules["torch"].random.get_rng_state().numpy().tobytes()
    return states


CALL_TIMEOUT_SECONDS = 120.0
"""Timeout of one call, seconds."""


@cache
def _get_pool(workers: int, plugins: tuple[str, ...]) -> LocalPool:
    """Return the pool with this number of workers and these plugins, which all checks share.

    It is closed when Python exits; starting workers for every check would take too long.
    """
    pool = LocalPool(workers)
    pool.load_plugins([Plugin(path) for path in plugins])
    atexit.register(pool.__exit__)
    return pool


def call_in_processes(
    function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], workers: int, subject: type
) -> list[Any]:
    """Call a function in worker processes, once for each tuple of arguments.

    Args:
        function: an importable function.
        arguments: arguments of each call; `subject` is among them.
        workers: number of worker processes.
        subject: class under test; if it comes from a plugin file, the workers load that file.

    Returns:
        The result or exception of each call.
    """
    plugins = (inspect.getfile(subject),) if subject.__module__.startswith("simgap_plugin_") else ()
    results = dict(
        _get_pool(workers, plugins).iterate_results(
            [(function, argument) for argument in arguments], CALL_TIMEOUT_SECONDS
        )
    )
    # Results arrive in any order, each with the index of its call.
    return [results[index] for index in range(len(arguments))]
