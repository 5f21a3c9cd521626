"""The command `simgap info`: information about the machine for bug reports."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bench.cli.output import CommandResult, JsonDocument, PrintLine


def add_info_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap info`."""
    parser.set_defaults(command=_run_info)


def _run_info(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:  # noqa: ARG001
    """Execute `simgap info`: print what a bug report should say about this machine.

    Args:
        options: parsed command line; unused.
        print_line: prints one line of text.
    """
    information = collect_info()
    for line in _format_info(information):
        print_line(line)
    return CommandResult(information)


def collect_info() -> JsonDocument:
    """Collect versions, engines, platform and paths.

    Returns:
        The document that users attach to a bug report.
    """
    import os
    import platform

    from bench import __version__
    from bench.benchmark.runner.trained_weights import get_weights_folder
    from bench.core.resource_estimates import count_available_cores
    from bench.datasets.public_datasets import get_user_folder

    return {
        "simgap": __version__,
        "revision": _read_git_revision(),
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processors": count_available_cores(),
        "memory": _read_memory_size(),
        "paths": {
            "simgap": str(_PACKAGES_FOLDER),
            "cache": str(get_weights_folder()),
            "data sets": str(get_user_folder()),
            "SIMGAP_DATA": os.environ.get("SIMGAP_DATA"),
            "SIMGAP_ROBOTS": os.environ.get("SIMGAP_ROBOTS"),
        },
        "engines": list(_describe_engines()),
        "packages": list(_describe_packages()),
    }


_PACKAGES_FOLDER = Path(__file__).resolve().parents[3]
"""Folder that contains simgap's packages."""


def _read_git_revision() -> str | None:
    """Return the commit of a checkout, with + if files were changed; None for a wheel."""
    import subprocess

    if not (_PACKAGES_FOLDER / ".git").exists():
        return None
    command = (
        "git",
        "-C",
        str(_PACKAGES_FOLDER),
        "describe",
        "--always",
        "--dirty=+",
        "--abbrev=12",
    )
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return process.stdout.strip() or None


def _read_memory_size() -> int | None:
    """Return the memory of the machine in bytes; None if unknown."""
    import os

    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def _describe_engines() -> Iterator[JsonDocument]:
    """List every engine; each package is imported, since an installed one may not work."""
    from bench import __version__
    from sims.core.mujoco_import import import_mujoco
    from sims.engines.external.bullet_world import import_pybullet

    loads = {"pybullet": import_pybullet, "mujoco": import_mujoco}
    yield {"name": "batch", "version": __version__, "missing": None}
    for name, load in loads.items():
        yield {
            "name": name,
            "version": _read_package_version(name),
            "missing": _find_import_problem(name, load),
        }


def _describe_packages() -> Iterator[JsonDocument]:
    """List the packages that simgap and its extras require, by the installed metadata."""
    from importlib.metadata import PackageNotFoundError, requires

    from packaging.requirements import Requirement

    try:
        requirements = [Requirement(text) for text in requires("simgap") or ()]
    except PackageNotFoundError:  # Run from the source, without an installation.
        requirements = []
    for requirement in requirements:
        extra = _parse_extra(str(requirement.marker or ""))
        # A marker may also exclude this platform or version of Python.
        applies = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
        if extra == "dev" or not applies:
            continue
        version = _read_package_version(requirement.name)
        # simgap is in no package index, so its extras cannot be installed by name.
        remedy = f'pip install "{requirement.name}{requirement.specifier}"'
        missing = None if version else f"not installed ({remedy})"
        if version and not requirement.specifier.contains(version, prereleases=True):
            missing = f"expected {requirement.specifier}"
        yield {"name": requirement.name, "of": extra, "version": version, "missing": missing}


def _parse_extra(marker: str) -> str:
    """Return the extra that a requirement belongs to; empty if it belongs to none."""
    _, _, extra_text = marker.partition("extra == ")
    return extra_text.split()[0].strip("\"')") if extra_text else ""


def _read_package_version(package: str) -> str | None:
    """Return the version of an installed package; None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _find_import_problem(package: str, load: Callable[[], Any]) -> str | None:
    """Return why a package cannot be used; None if it can."""
    try:
        load()
    except ModuleNotFoundError:
        return f"not installed (pip install {package})"
    except Exception as error:  # Built for another machine, or incompletely installed.
        return f"{type(error).__name__}: {error}"
    return None


def _format_info(information: JsonDocument) -> Iterator[str]:
    """Format the information on versions and settings as lines of text."""
    revision = f" ({information['revision']})" if information["revision"] else ""
    python = f"{information['implementation']} {information['python']}"
    yield f"simgap {information['simgap']}{revision}, {python}"
    memory = f", {information['memory'] / 2**30:.3g} GiB" if information["memory"] else ""
    yield f"{information['platform']}, {information['processors']} processors{memory}"
    yield ""
    for name, path in information["paths"].items():
        yield f"{name:14} {path or 'not set'}"
    yield ""
    yield from (_format_part(engine, "engine ") for engine in information["engines"])
    yield ""
    for package in information["packages"]:
        yield _format_part(package, f"[{package['of']}] " if package["of"] else "")


def _format_part(document: JsonDocument, prefix: str) -> str:
    version = document["version"] or ""
    missing = f"MISSING: {document['missing']}" if document["missing"] else ""
    return f"{prefix + document['name']:26} {'  '.join(filter(None, [version, missing]))}"
