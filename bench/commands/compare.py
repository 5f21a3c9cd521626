"""The command `simgap compare`."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from bench.commands.answer import DONE, INTERRUPTED, WRONG, Answer, Document, Say
from bench.commands.options import (
    add_force,
    add_model,
    add_pdf,
    add_plugin,
    add_trust,
    cluster_pool,
    names,
    natural,
    place,
    positive,
    said_as,
    seconds,
)

if TYPE_CHECKING:
    from bench.problem.experiment import Experiment
    from bench.runs.pools import Pool
    from bench.store.standing import Made
    from bench.study import Study

_CHANGES = ("targets", "budget", "training_budget", "timeout", "memory")
"""Options that change the key of the same name in an experiment."""


def add_compare(compare: argparse.ArgumentParser) -> None:
    """Add the options of `simgap compare`."""
    compare.add_argument(
        "experiment",
        metavar="EXPERIMENT",
        nargs="?",
        help="name (see `simgap list experiments`) or TOML file",
    )
    add_model(compare, "tune this robot in place of an experiment: an MJCF or URDF")
    compare.add_argument(
        "--recording",
        metavar="FILE.csv",
        type=place,
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
        type=positive,
        metavar="N",
        help="targets in each range; of diagnosers: so many questions, drawn at random",
    )
    compare.add_argument(
        "--seeds", type=positive, metavar="N", help="seeds of each tuner that uses chance"
    )
    compare.add_argument("--budget", type=positive, metavar="N", help="simulations on one target")
    compare.add_argument(
        "--training-budget",
        type=positive,
        metavar="N",
        help="simulations that a tuner may learn from",
    )
    compare.add_argument(
        "--jobs",
        type=natural,
        metavar="N",
        default=2,
        help="worker processes; 0 runs everything in this one, for prints and breakpoints "
        "(default: 2)",
    )
    compare.add_argument(
        "--out",
        metavar="DIR",
        type=place,
        help="folder to write (default: a new one below results/)",
    )
    add_plugin(compare, "tuners or diagnosers")
    compare.add_argument(
        "--resume", metavar="DIR", type=place, help="finish what is missing in this folder instead"
    )
    compare.add_argument(
        "--cluster", metavar="ADDRESS", help="run on the Dask cluster with this scheduler"
    )
    compare.add_argument(
        "--timeout",
        type=seconds,
        metavar="S",
        help="seconds that a run may take, then it is killed",
    )
    compare.add_argument(
        "--memory", type=positive, metavar="MIB", help="memory that a run may take"
    )
    add_trust(compare)
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
    add_force(compare)
    compare.set_defaults(command=_compare)


def _chosen(options: argparse.Namespace) -> Experiment:
    """Build the experiment that the options of `compare` describe."""
    from bench.api.compare import choose, given, wanted

    trust = options.trust or not options.jobs
    asked = wanted(options.experiment, options.model, options.recording, names(options.free or ""))
    experiment = given(asked, options.plugin, trust, options.isolation)
    labels = names(options.tuners) if options.tuners else None
    changes = {name: getattr(options, name) for name in _CHANGES}
    return choose(experiment, labels, options.seeds, **changes)


def _refuse_beside_resume(options: argparse.Namespace) -> None:
    """Reject options that would change the study to be resumed.

    Raises:
        InputError: There are such options.
    """
    from sims.base import InputError

    robot = ("model", "recording", "free")
    described = ("experiment", *robot, "tuners", "seeds", "out", "salt", "isolation", *_CHANGES)
    given = [name for name in described if getattr(options, name) is not None]
    given += ["trust"] if options.trust else []
    if given:
        raise InputError(
            f"--resume takes the configuration of its folder as it is; leave out {', '.join(given)}"
        )


def _begun(options: argparse.Namespace) -> list[Study]:
    """Begin or resume the study, or the studies of a sweep."""
    from bench.runs.size import check_comparison
    from bench.study import begin_all, parts_of, resume

    if options.resume:
        _refuse_beside_resume(options)
        return [resume(part, options.plugin) for part in parts_of(options.resume)]
    chosen, cluster = _chosen(options), options.cluster is not None
    check_comparison(chosen, options.out, options.jobs, cluster, options.force)
    with said_as("--out", options.out):
        return begin_all(chosen, options.plugin, options.out, options.jobs, options.salt)


def _compare(options: argparse.Namespace, say: Say) -> Answer:
    from bench.study import conclude

    # Connect to the cluster first, so that an unreachable scheduler leaves no folder.
    pool = cluster_pool(options.cluster)
    studies = _begun(options)
    answers = []
    for study in studies:
        if len(studies) > 1:
            say(f"\n{study.configuration.experiment.name}")
        answers.append(_made(study, pool, options, say))
        if answers[-1].code == INTERRUPTED:
            break
    if len(studies) > 1:
        conclude(studies[0].folder.parent, say)
    return Answer(
        {"comparisons": [answer.document for answer in answers]},
        max(answer.code for answer in answers),
    )


def _made(study: Study, pool: Pool | None, options: argparse.Namespace, say: Say) -> Answer:
    """Run and report one study."""
    from bench.commands.outcome import outcome
    from bench.commands.progress import Bars

    with Bars() as bars:
        made = study.make(options.jobs, bars.start, pool)
    standing: Document = {**made._asdict(), "complete": made.complete}
    if made.skipped:
        say(f"skipped: {made.skipped}")
        return Answer({**outcome(study), **standing, "failed": 0, "resume": None})
    failed = study.finish(say)
    resume = None if made.complete else f"simgap compare --resume {study.folder}"
    document = {**outcome(study), **standing, "failed": failed, "resume": resume}
    if resume:
        return Answer(document, _left(study, made, resume))
    return Answer(document, WRONG if failed and not options.allow_failures else DONE)


def _left(study: Study, made: Made, resume: str) -> int:
    """Print what is missing and how to continue; return the exit code."""
    why = "interrupted" if made.interrupted else made.stopped or "stopped"
    things, ended = study.status().what.rsplit(" ", 1)  # For example: runs finished.
    for line in (
        f"{why}; {made.finished} of {made.planned} {things} are {ended} and kept",
        f"to finish: {resume}",
    ):
        print(f"simgap: {line}", file=sys.stderr)
    return INTERRUPTED if made.interrupted else WRONG
