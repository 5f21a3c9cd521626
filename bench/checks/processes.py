"""Calls in other processes, for checks: the same worker processes serve one check after another."""

from __future__ import annotations

import atexit
import inspect
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from bench.runs.pools import LocalPool
from bench.runs.survey import Plugin

LIMIT = 120.0
"""Seconds that one call may take before it is killed."""


@cache
def _pool(workers: int, plugins: tuple[str, ...]) -> LocalPool:
    pool = LocalPool(workers)
    pool.load([Plugin(path) for path in plugins])
    atexit.register(pool.__exit__)
    return pool


def elsewhere(
    function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], workers: int, subject: type
) -> list[Any]:
    """The result (or exception) of `function` for each of `arguments`, each in one of so many
    worker processes.

    Args:
        function: importable.
        arguments: of each call; `subject` is among them.
        workers: processes.
        subject: the class under test; where it comes from a plugin file, workers load that file.
    """
    plugins = (inspect.getfile(subject),) if subject.__module__.startswith("simgap_plugin_") else ()
    results = dict(
        _pool(workers, plugins).results([(function, given) for given in arguments], LIMIT)
    )
    return [results[place] for place in range(len(arguments))]
