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
    add_force_option,
    add_model_option,
    add_pdf,
    add_plugin_option,
    add_trust_option,
    make_cluster_pool,
    parse_name_list,
    parse_non_negative_int,
    parse_path,
    parse_positive_int,
    parse_seconds,
    prefix_errors_with_option,
)

if TYPE_CHECKING:
    from bench.benchmark.problem.experiment import Experiment
    from bench.benchmark.runner.worker_pools import Pool
    from bench.benchmark.storage.study_progress import StudyOutcome
    from bench.studies.study import Study

_EXPERIMENT_OPTIONS = ("targets", "budget", "training_budget", "timeout", "memory")
"""Options that change the key of the same name in an experiment."""


def add_compare_arguments(compare: argparse.ArgumentParser) -> None:
    """Add the options of `simgap compare`."""
    compare.add_argument(
        "experiment",
        metavar="EXPERIMENT",
        nargs="?",
        help="name (see `simgap list experiments`) or TOML file",
    )
    add_model_option(compare, "tune this robot in place of an experiment: an MJCF or URDF")
    compare.add_argument(
        "--recording",
        metavar="FILE.csv",
        type=parse_path,
        help="tune it to this recording (default: to simulations of its own)",
    )
    compare.add_argument(
        "--free",
        metavar="A,B,...",
        help="numbers of its model file to tune, as damping@* or mass@forearm",
    )
    compare.add_argument(
        "--tuners",
        "--diagnosers",
        dest="tuners",
        metavar="A,B,...",
        help="only these tuners, by label or registered name; or only these diagnosers",
    )
    compare.add_argument(
        "--targets",
        type=parse_positive_int,
        metavar="N",
        help="targets in each range; of diagnosers: so many questions, drawn at random",
    )
    compare.add_argument(
        "--seeds", type=parse_positive_int, metavar="N", help="seeds of each tuner that uses chance"
    )
    compare.add_argument(
        "--budget", type=parse_positive_int, metavar="N", help="simulations on one target"
    )
    compare.add_argument(
        "--training-budget",
        type=parse_positive_int,
        metavar="N",
        help="simulations that a tuner may learn from",
    )
    compare.add_argument(
        "--jobs",
        type=parse_non_negative_int,
        metavar="N",
        default=2,
        help="worker processes; 0 runs everything in this one, for prints and breakpoints "
        "(default: 2)",
    )
    compare.add_argument(
        "--out",
        metavar="DIR",
        type=parse_path,
        help="folder to write (default: a new one below results/)",
    )
    add_plugin_option(compare, "tuners or diagnosers")
    compare.add_argument(
        "--resume",
        metavar="DIR",
        type=parse_path,
        help="finish what is missing in this folder instead",
    )
    compare.add_argument(
        "--cluster", metavar="ADDRESS", help="run on the Dask cluster with this scheduler"
    )
    compare.add_argument(
        "--timeout",
        type=parse_seconds,
        metavar="S",
        help="seconds that a run may take, then it is killed",
    )
    compare.add_argument(
        "--memory", type=parse_positive_int, metavar="MIB", help="memory that a run may take"
    )
    add_trust_option(compare)
    compare.add_argument(
        "--isolation",
        choices=("run", "tuner"),
        help="a fresh process for every run of a tuner, or one for all with the same seed "
        "(default: run)",
    )
    compare.add_argument(
        "--salt",
        "--secret",
        dest="salt",
        metavar="TEXT",
        help="draw the targets from this, which is kept secret until the end; `public` gives the "
        "published ones (default: a fresh one)",
    )
    compare.add_argument(
        "--allow-failures", action="store_true", help="exit with 0 although runs failed"
    )
    add_pdf(compare)
    add_force_option(compare)
    compare.set_defaults(command=_run_compare)


def _build_experiment(options: argparse.Namespace) -> Experiment:
    """Build the experiment that the options of `compare` describe."""
    from bench.api.compare import apply_changes, load_experiment_plugins, resolve_experiment

    trust = options.trust or not options.jobs
    asked = resolve_experiment(
        options.experiment, options.model, options.recording, parse_name_list(options.free or "")
    )
    experiment = load_experiment_plugins(asked, options.plugin, trust, options.isolation)
    labels = parse_name_list(options.tuners) if options.tuners else None
    changes = {name: getattr(options, name) for name in _EXPERIMENT_OPTIONS}
    return apply_changes(experiment, labels, options.seeds, **changes)


def _refuse_beside_resume(options: argparse.Namespace) -> None:
    """Reject options that would change the study to be resumed.

    Raises:
        InputError: There are such options.
    """
    from sims.core.simulator import InputError

    robot = ("model", "recording", "free")
    described = (
        "experiment",
        *robot,
        "tuners",
        "seeds",
        "out",
        "salt",
        "isolation",
        *_EXPERIMENT_OPTIONS,
    )
    given = [name for name in described if getattr(options, name) is not None]
    given += ["trust"] if options.trust else []
    if given:
        raise InputError(
            f"--resume takes the configuration of its folder as it is; leave out {', '.join(given)}"
        )


def _begin_or_resume(options: argparse.Namespace) -> list[Study]:
    """Begin or resume the study, or the studies of a sweep."""
    from bench.benchmark.runner.resource_checks import check_comparison_size
    from bench.studies.study import begin_studies, list_study_folders, resume_study

    if options.resume:
        _refuse_beside_resume(options)
        return [resume_study(part, options.plugin) for part in list_study_folders(options.resume)]
    chosen, cluster = _build_experiment(options), options.cluster is not None
    check_comparison_size(chosen, options.out, options.jobs, cluster, options.force)
    with prefix_errors_with_option("--out", options.out):
        return begin_studies(chosen, options.plugin, options.out, options.jobs, options.salt)


def _run_compare(options: argparse.Namespace, say: PrintLine) -> CommandResult:
    from bench.studies.study import report_jointly

    # Connect to the cluster first, so that an unreachable scheduler leaves no folder.
    pool = make_cluster_pool(options.cluster)
    studies = _begin_or_resume(options)
    answers = []
    for study in studies:
        if len(studies) > 1:
            say(f"\n{study.configuration.experiment.name}")
        answers.append(_run_study(study, pool, options, say))
        if answers[-1].code == EXIT_INTERRUPTED:
            break
    if len(studies) > 1:
        report_jointly(studies[0].folder.parent, say)
    return CommandResult(
        {"comparisons": [answer.document for answer in answers]},
        max(answer.code for answer in answers),
    )


def _run_study(
    study: Study, pool: Pool | None, options: argparse.Namespace, say: PrintLine
) -> CommandResult:
    """Run and report one study."""
    from bench.cli.progress_display import ProgressBars
    from bench.cli.study_summary import summarise_study

    with ProgressBars() as bars:
        made = study.run(options.jobs, bars.start_bar, pool)
    standing: JsonDocument = {**made._asdict(), "complete": made.is_complete}
    if made.skipped:
        say(f"skipped: {made.skipped}")
        return CommandResult({**summarise_study(study), **standing, "failed": 0, "resume": None})
    failed = study.report(say)
    resume = None if made.is_complete else f"simgap compare --resume {study.folder}"
    document = {**summarise_study(study), **standing, "failed": failed, "resume": resume}
    if resume:
        return CommandResult(document, _report_missing(study, made, resume))
    return CommandResult(
        document, EXIT_PROBLEMS_FOUND if failed and not options.allow_failures else EXIT_OK
    )


def _report_missing(study: Study, made: StudyOutcome, resume: str) -> int:
    """Print what is missing and how to continue; return the exit code."""
    why = "interrupted" if made.interrupted else made.stopped or "stopped"
    things, ended = study.status().what.rsplit(" ", 1)  # For example: runs finished.
    for line in (
        f"{why}; {made.finished} of {made.planned} {things} are {ended} and kept",
        f"to finish: {resume}",
    ):
        print(f"simgap: {line}", file=sys.stderr)
    return EXIT_INTERRUPTED if made.interrupted else EXIT_PROBLEMS_FOUND
