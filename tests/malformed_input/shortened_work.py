"""Stop commands after they have read valid inputs, because the tests check only the reading."""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import bench
from bench.cli.output import CommandResult
from bench.core.plugin_registries import REGISTRIES
from sims.core.simulator import InputError

HERE = "here"
"""Working folder of a command, within the folder of a case."""


class CutError(BaseException):
    """The inputs are valid and the actual work would begin."""


def _cut(*_: Any, **__: Any) -> Any:
    raise CutError


def _nothing(*_: Any, **__: Any) -> list[Any]:
    return []


def _closed(study: Any, *_: Any) -> CommandResult:
    study.close()
    return CommandResult({})


def _nobody(address: str) -> Any:
    raise InputError(f"{address}: no Dask scheduler answers there")


def _no_network(url: str, *_: Any) -> Any:
    raise InputError(f"{url}: cannot be downloaded")


SHORT = {
    "bench.cli.commands.compare._run_study": _closed,
    "bench.benchmark.runner.dask_cluster.ClusterPool": _nobody,
    "bench.datasets.public_datasets._download_content": _no_network,
    "bench.benchmark.comparison_report.build_tables": _cut,
    "bench.studies.result_verification.build_tables": _cut,
    "bench.suite.multi_problem_report.ComparisonCollection.build_tables": _cut,
    "bench.benchmark.storage.provenance.distributions": _nothing,
    "bench.diagnosis.explain._diagnose_runs": _cut,
    "bench.conformance.check_suites._run_all_checks": _cut,
    "bench.logs.film_rendering.write_video": _cut,
    "bench.figures.recording_figure.write_recording_figure": _nothing,
    "bench.figures.ball_track_figure.render_track_figure": lambda *_: (b"", b""),
    "bench.api.train.LossRecorder.write": _nothing,
}
"""Replacements of functions that would do the actual work."""


@contextmanager
def environment(place: Path) -> Iterator[None]:
    """Use a cache of weights within `place` and only installed plugins, within the block."""
    known = [registry.snapshot() for registry in REGISTRIES]
    try:
        for registry, parts in zip(REGISTRIES, known, strict=True):
            registry.restore({name: part for name, part in parts.items() if part.path is None})
        own = {"SIMGAP_CACHE": str(place / HERE / "run"), "XDG_DATA_HOME": str(place / HERE)}
        with patch.dict(os.environ, own):
            yield
    finally:
        for registry, parts in zip(REGISTRIES, known, strict=True):
            registry.restore(parts)


@contextmanager
def shortened() -> Iterator[None]:
    """Stop commands where the actual work would begin, within the block."""
    _whole()
    with ExitStack() as stack:
        for name, act in SHORT.items():
            stack.enter_context(patch(name, act))
        yield


@cache
def _whole() -> None:
    """Import all modules of `bench`.

    A module first imported within the block would keep references to the replacements.
    """
    for module in pkgutil.walk_packages(bench.__path__, "bench."):
        importlib.import_module(module.name)
