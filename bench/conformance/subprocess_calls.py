"""Calls of functions in worker processes, for checks; all checks share the worker pools."""

from __future__ import annotations

import atexit
import inspect
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from bench.benchmark.runner.plugin_discovery import Plugin
from bench.benchmark.runner.worker_pools import LocalPool

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
    return [results[place] for place in range(len(arguments))]
