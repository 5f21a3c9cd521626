"""The command `simgap compare`."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from bench.cli.output import (
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_PROBLEMS_FOUND,
    CommandResult,
    JsonDocument,
    PrintLine,
)
from bench.cli.shared_options import (
    add_options,
    collect_options,
    make_cluster_pool,
    parse_path,
    prefix_errors_with_option,
)

if TYPE_CHECKING:
    from bench.benchmark.runner.study_base import Study
    from bench.benchmark.runner.worker_pools import Pool
    from bench.benchmark.storage.run_status import StudyOutcome

_UNCHANGED_BY_RESUME = ("jobs", "plugins", "cluster", "force", "pdf", "progress")
"""Options that may be given together with ``--resume``."""


def add_compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap compare`."""
    from bench.api.comparison_options import ComparisonOptions

    parser.add_argument(
        "experiment",
        metavar="EXPERIMENT",
        nargs="?",
        help="name (see `simgap list experiments`) or TOML file",
    )
    add_options(parser, ComparisonOptions)
    parser.add_argument(
        "--resume",
        metavar="DIR",
        type=parse_path,
        help="run what is missing in this folder, instead of a new comparison",
    )
    parser.add_argument(
        "--allow-failures", action="store_true", help="exit with 0 even if runs failed"
    )
    parser.set_defaults(command=_run_compare)


def _begin_or_resume(options: argparse.Namespace, print_line: PrintLine) -> list[Study]:
    """Begin or resume the study, or the studies of a sweep.

    Problems of a suite that cannot run here are printed with what they need.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Raises:
        InputError: Options are given that would change a study to be resumed.
    """
    from bench.api.compare import begin_studies, build_experiment
    from bench.api.comparison_options import ComparisonOptions
    from bench.studies.study_kinds import list_study_folders, resume_study
    from sims.core.argument_checks import check_options
    from sims.core.simulator import InputError

    values = collect_options(options, ComparisonOptions)
    if options.resume:
        changed = {"experiment": options.experiment, **values}
        refused = [
            name for name, value in changed.items() if value and name not in _UNCHANGED_BY_RESUME
        ]
        if refused:
            raise InputError(
                "--resume uses the configuration of its folder unchanged; leave out "
                f"{', '.join(refused)}"
            )
        return [resume_study(part, options.plugin) for part in list_study_folders(options.resume)]
    comparison = check_options(ComparisonOptions, values)
    experiment = build_experiment(options.experiment, comparison)
    with prefix_errors_with_option("--out", options.out):
        return begin_studies(
            experiment, comparison, lambda name, reason: print_line(f"skipped: {name}: {reason}")
        )


def _run_compare(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap compare`: run one or several comparisons, one after the other.

    The comparisons of a sweep also get a joint report. After an interrupt the remaining ones are
    not begun.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and the largest exit code of its comparisons.
    """
    from bench.studies.study_kinds import report_jointly

    # Connect to the cluster first, so that an unreachable scheduler leaves no folder.
    pool = make_cluster_pool(options.cluster)
    studies = _begin_or_resume(options, print_line)
    answers = []
    for study in studies:
        if len(studies) > 1:
            print_line(f"\n{study.configuration.experiment.name}")
        answers.append(_run_study(study, pool, options, print_line))
        if answers[-1].code == EXIT_INTERRUPTED:
            break
    if len(studies) > 1:
        report_jointly(studies[0].folder.parent, print_line)
    return CommandResult(
        {"comparisons": [answer.document for answer in answers]},
        max(answer.code for answer in answers),
    )


def _run_study(
    study: Study, pool: Pool | None, options: argparse.Namespace, print_line: PrintLine
) -> CommandResult:
    """Run one study until it is complete or stopped, then write its report.

    Args:
        study: study in its result folder.
        pool: executes the runs on a cluster; None for worker processes on this machine.
        options: parsed command line.
        print_line: prints one line of text.
    """
    from bench.cli.output import summarise_study
    from bench.cli.progress_display import ProgressBars

    with ProgressBars() as bars:
        outcome = study.run(options.jobs, bars.start_bar, pool)
    progress: JsonDocument = {**outcome._asdict(), "complete": outcome.is_complete}
    if outcome.skipped:
        print_line(f"skipped: {outcome.skipped}")
        return CommandResult({**summarise_study(study), **progress, "failed": 0, "resume": None})
    failed = study.report(print_line)
    resume = None if outcome.is_complete else f"simgap compare --resume {study.folder}"
    document = {**summarise_study(study), **progress, "failed": failed, "resume": resume}
    if resume:
        return CommandResult(document, _report_missing(study, outcome, resume))
    return CommandResult(
        document, EXIT_PROBLEMS_FOUND if failed and not options.allow_failures else EXIT_OK
    )


def _report_missing(study: Study, outcome: StudyOutcome, resume: str) -> int:
    """Print what is missing and how to continue; return the exit code.

    Args:
        study: the unfinished study.
        outcome: why it ended, and number of finished parts.
        resume: command that continues it.
    """
    reason = "interrupted" if outcome.interrupted else outcome.stopped or "stopped"
    unit, ended = study.status().what.rsplit(" ", 1)  # For example: runs finished.
    for line in (
        f"{reason}; {outcome.finished} of {outcome.planned} {unit} are {ended} and stored",
        f"to finish: {resume}",
    ):
        print(f"simgap: {line}", file=sys.stderr)
    return EXIT_INTERRUPTED if outcome.interrupted else EXIT_PROBLEMS_FOUND
