"""The command `simgap status`."""

from __future__ import annotations

import argparse
from collections import Counter
from typing import TYPE_CHECKING

from bench.cli.output import EXIT_OK, EXIT_PROBLEMS_FOUND, CommandResult, JsonDocument, PrintLine
from bench.cli.shared_options import parse_path

if TYPE_CHECKING:
    from bench.benchmark.runner.study_base import Study
    from bench.benchmark.storage.run_status import RunEnd, StudyProgress

_MAX_LISTED_RUNS = 20
"""Maximum number of runs that are listed without ``--runs``."""


def add_status_arguments(status: argparse.ArgumentParser) -> None:
    """Add the options of `simgap status`."""
    status.add_argument(
        "run",
        metavar="DIR",
        type=parse_path,
        nargs="?",
        help="the folder of a comparison or bounce shot; without it: which isolation "
        "layers of tuners are active on this machine",
    )
    status.add_argument("--runs", action="store_true", help="list every run or shot")
    status.set_defaults(command=_run_status)


def _run_status(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap status`: print how far a study is, or without one the isolation layers.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code; EXIT_PROBLEMS_FOUND if a study is not
        complete.
    """
    from bench.studies.study_kinds import list_study_folders, open_study

    if options.run is None:
        return CommandResult({"seals": _print_isolation_layers(print_line)})
    studies = [
        _print_progress(open_study(part), options.runs, print_line)
        for part in list_study_folders(options.run)
    ]
    complete = all(study["complete"] for study in studies)
    return CommandResult({"studies": studies}, EXIT_OK if complete else EXIT_PROBLEMS_FOUND)


def _print_isolation_layers(print_line: PrintLine) -> list[JsonDocument]:
    """Print which isolation layers are available on this machine."""
    from bench.benchmark.isolation.isolation_layers import ISOLATION_LAYERS
    from bench.benchmark.runner.tuner_process_start import list_active_isolation_layers

    active_layers = list_active_isolation_layers()
    print_line("isolation layers of a tuner's process on this machine (docs/isolation.md)")
    for name, description in ISOLATION_LAYERS.items():
        print_line(
            f"  {name:10} {'active' if name in active_layers else 'NOT AVAILABLE':14} {description}"
        )
    return [
        {"name": name, "holds": name in active_layers, "says": description}
        for name, description in ISOLATION_LAYERS.items()
    ]


def _describe_isolation(study: Study) -> JsonDocument:
    """Describe how the tuners of a study are isolated from the true parameters.

    The salt is the secret number from which targets are drawn; while it is secret, tuners cannot
    draw them.

    Args:
        study: Study whose configuration records the active isolation layers.
    """
    from bench.benchmark.isolation.isolation_layers import ISOLATION_LAYERS

    configuration = study.configuration
    experiment = configuration.experiment
    missing = [name for name in ISOLATION_LAYERS if name not in configuration.isolation_layers]
    return {
        "trusted": experiment.trusted,
        "isolation": experiment.isolation,
        "missing": [] if experiment.trusted else missing,
        "salt": "secret" if experiment.salt_sha256 else "public",
        "salt_sha256": experiment.salt_sha256 or None,
        "revealed": bool(experiment.salt_sha256 and experiment.salt),
    }


def _format_isolation(isolation: JsonDocument) -> str:
    """Format the isolation of a study as text.

    Args:
        isolation: Document of `_describe_isolation`.
    """
    if isolation["trusted"]:
        return "trusted: its tuners run without isolation"
    missing, salt = isolation["missing"], isolation["salt_sha256"]
    scope = "run" if isolation["isolation"] == "run" else "tuner and seed"
    processes = f"isolated: a process for each {scope}"
    layers = f", WITHOUT the layers {', '.join(missing)}" if missing else ", all layers active"
    salt_note = f"; salt with SHA-256 {salt[:12]}" if salt else "; its salt is public"
    return processes + layers + salt_note + (", revealed" if isolation["revealed"] else "")


def _print_progress(study: Study, is_all: bool, print_line: PrintLine) -> JsonDocument:
    """Print the progress of a study, and return it as a document.

    Args:
        study: study in its result folder.
        is_all: whether every run is listed, and not only notable ones.
        print_line: prints one line of text.
    """
    progress = study.status()
    planned, unit = len(progress.ends), progress.what
    isolation, groups = _describe_isolation(study), _count_endings(progress)
    resume = None if progress.is_complete else f"simgap compare --resume {study.folder}"
    listed_runs = progress.ends if is_all else _select_notable_runs(progress)

    complete = ", complete" if progress.is_complete else ""
    print_line(f"{progress.name}: {progress.finished} of {planned} {unit}{complete}")
    print_line("  " + ", ".join(f"{name} {value}" for name, value in progress.hashes.items()))
    print_line(f"  {_format_isolation(isolation)}")
    for line in _format_counts(groups):
        print_line(f"  {line}")
    for run_end in listed_runs:
        print_line(f"{run_end.status:10} {run_end.name}  {_get_last_line(run_end)}".rstrip())
    if len(progress.ends) > len(listed_runs):
        print_line(f"({len(listed_runs)} of {len(progress.ends)} listed; --runs lists all)")
    if resume:
        print_line(f"to finish it: {resume}")
    return {
        "name": progress.name,
        "folder": study.folder,
        "what": unit,
        "finished": progress.finished,
        "planned": planned,
        "complete": progress.is_complete,
        "hashes": dict(progress.hashes),
        "seal": isolation,
        "groups": groups,
        "runs": [run_end._asdict() for run_end in listed_runs],
        "resume": resume,
    }


def _count_endings(progress: StudyProgress) -> dict[str, dict[str, int]]:
    """Count the runs of each tuner or kind of ball by status."""
    groups: dict[str, Counter[str]] = {}
    for end in progress.ends:
        groups.setdefault(end.group, Counter())[end.status] += 1
    return {group: dict(sorted(counts.items())) for group, counts in groups.items()}


def _format_counts(groups: dict[str, dict[str, int]]) -> list[str]:
    """Format the number of runs of each status as text, one line per group of runs.

    Args:
        groups: number of runs by status, such as ``ok`` or ``failed``, for each group, such as a
            tuner. Missing runs come last in a line.
    """
    from bench.benchmark.storage.run_status import MISSING_STATUS

    width = max(map(len, groups), default=0)
    lines = []
    for group, counts in groups.items():
        ordered = sorted(counts, key=lambda status: (status == MISSING_STATUS, status))
        counts_text = ", ".join(f"{counts[status]} {status}" for status in ordered)
        lines.append(f"{group:{width}}  {counts_text}")
    return lines


def _select_notable_runs(progress: StudyProgress) -> tuple[RunEnd, ...]:
    """Select the runs to list: those without success, or all; at most `_MAX_LISTED_RUNS`."""
    from bench.benchmark.storage.run_status import SUCCESS_STATUSES

    unsuccessful = tuple(
        run_end for run_end in progress.ends if run_end.status not in SUCCESS_STATUSES
    )
    return (unsuccessful or progress.ends)[:_MAX_LISTED_RUNS]


def _get_last_line(end: RunEnd) -> str:
    # The last line of a traceback names the error.
    return (end.reason.strip().splitlines() or [""])[-1]
