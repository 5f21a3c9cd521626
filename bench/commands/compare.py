"""The commands `simgap compare`, `simgap status` and `simgap plot`."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.interrupts import INTERRUPTED
from bench.commands.options import (
    add_force,
    add_model,
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
    from bench.store.standing import Made, Standing
    from bench.study import Study

_FEW = 20
"""Runs that `simgap status` lists unless all are asked for."""
_CHANGES = ("targets", "budget", "training_budget", "timeout", "memory")
"""Options that change an experiment's key of the same name."""


def add_compare(compare: argparse.ArgumentParser) -> None:
    """The options of `simgap compare`."""
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
        "--tuners", metavar="A,B,...", help="only these tuners, by label or registered name"
    )
    compare.add_argument("--targets", type=positive, metavar="N", help="targets in each range")
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
    add_plugin(compare, "tuners")
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
        metavar="TEXT",
        help="draw the targets from this, which is kept secret until the end; `public` gives the "
        "published ones (default: a fresh one)",
    )
    compare.add_argument(
        "--allow-failures", action="store_true", help="exit with 0 although runs failed"
    )
    add_force(compare)
    compare.set_defaults(command=_compare)


def add_status(status: argparse.ArgumentParser) -> None:
    """The options of `simgap status`."""
    status.add_argument(
        "run",
        metavar="DIR",
        type=place,
        nargs="?",
        help="the folder of a comparison or bounce shot; without it: which seals hold around "
        "tuners on this machine",
    )
    status.add_argument("--runs", action="store_true", help="list every run or shot")
    status.set_defaults(command=_status)


def add_verify(verify: argparse.ArgumentParser) -> None:
    """The options of `simgap verify`."""
    verify.add_argument(
        "run", metavar="RUN", type=place, help="the folder of a finished comparison"
    )
    verify.add_argument(
        "--all", action="store_true", help="make every simulation again, and not a share of them"
    )
    add_plugin(verify, "simulators")
    verify.set_defaults(command=_verify)


def add_plot(plot: argparse.ArgumentParser) -> None:
    """The options of `simgap plot`."""
    plot.add_argument(
        "runs",
        metavar="RUN",
        type=place,
        nargs="+",
        help="the folder of a comparison or bounce shot; several comparisons: ranks",
    )
    plot.add_argument(
        "--out", metavar="DIR", type=place, help="folder for what several comparisons give together"
    )
    add_plugin(plot, "simulators")
    plot.set_defaults(command=_plot)


def _chosen(options: argparse.Namespace) -> Experiment:
    """The experiment that the options of `compare` describe."""
    from bench.api.compare import choose, given, wanted

    trust = options.trust or not options.jobs
    asked = wanted(options.experiment, options.model, options.recording, names(options.free or ""))
    experiment = given(asked, options.plugin, trust, options.isolation)
    labels = names(options.tuners) if options.tuners else None
    changes = {name: getattr(options, name) for name in _CHANGES}
    return choose(experiment, labels, options.seeds, **changes)


def _refuse_beside_resume(options: argparse.Namespace) -> None:
    """Refuse options that would change what is resumed.

    Raises:
        InputError: there are some.
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
    """The study that is begun or resumed; several of a sweep."""
    from bench.runs.size import check_comparison
    from bench.study import begin_all, parts_of, resume

    if options.resume:
        _refuse_beside_resume(options)
        return [resume(part, options.plugin) for part in parts_of(options.resume)]
    chosen, cluster = _chosen(options), options.cluster is not None
    check_comparison(chosen, options.out, options.jobs, cluster, options.force)
    with said_as("--out", options.out):
        return begin_all(chosen, options.plugin, options.out, options.jobs, options.salt)


def _compare(options: argparse.Namespace) -> int:
    # First of all: a scheduler that does not answer leaves no folder behind.
    pool = cluster_pool(options.cluster)
    studies = _begun(options)
    codes = []
    for study in studies:
        if len(studies) > 1:
            print(f"\n{study.configuration.experiment.name}")
        codes.append(_made(study, pool, options))
        if codes[-1] == INTERRUPTED:
            break
    return max(codes)


def _made(study: Study, pool: Pool | None, options: argparse.Namespace) -> int:
    """Make and report one study; returns the exit code."""
    from bench.commands.progress import Bars

    with Bars() as bars:
        made = study.make(options.jobs, bars.start, pool)
    if made.skipped:
        print(f"skipped: {made.skipped}")
        return 0
    failed = study.finish(print)
    if not made.complete:
        return _left(study, made)
    return 1 if failed and not options.allow_failures else 0


def _left(study: Study, made: Made) -> int:
    """Say what is missing and how to go on; returns the exit code."""
    why = "interrupted" if made.interrupted else made.stopped or "stopped"
    things, ended = study.status().what.rsplit(" ", 1)  # e.g. runs finished
    for line in (
        f"{why}; {made.finished} of {made.planned} {things} are {ended} and kept",
        f"to finish: simgap compare --resume {study.folder}",
    ):
        print(f"simgap: {line}", file=sys.stderr)
    return INTERRUPTED if made.interrupted else 1


def _status(options: argparse.Namespace) -> int:
    from bench.study import opened, parts_of

    if options.run is None:
        return _seals()
    complete = [_stands(opened(part), options.runs) for part in parts_of(options.run)]
    return 0 if all(complete) else 1


def _seals() -> int:
    """Say which seals hold on this machine."""
    from bench.runs.housing import seals
    from bench.sealing.seals import SEALS

    there = seals()
    print("seals around a tuner's process on this machine (docs/sealing.md)")
    for name, says in SEALS.items():
        print(f"  {name:10} {'holds' if name in there else 'DOES NOT HOLD':14} {says}")
    return 0


def _sealed(study: Study) -> str:
    """How the tuners of a study are kept from its truths."""
    from bench.sealing.seals import SEALS

    held = study.configuration
    experiment = held.experiment
    if experiment.trusted:
        return "trusted: its tuners run inside the harness"
    missing = [name for name in SEALS if name not in held.seals]
    kept = "sealed: a process for each "
    kept += "run" if experiment.isolation == "run" else "tuner and seed"
    without = f", WITHOUT the seals {', '.join(missing)}" if missing else ", every seal holds"
    salt = experiment.salt_sha256
    told = f"; salt with SHA-256 {salt[:12]}" if salt else "; its salt is public"
    return kept + without + told + (", revealed" if salt and experiment.salt else "")


def _stands(study: Study, every: bool) -> bool:
    """Say how far a study is; returns whether it is complete."""
    standing = study.status()
    planned, what = len(standing.ends), standing.what
    complete = ", complete" if standing.complete else ""
    print(f"{standing.name}: {standing.finished} of {planned} {what}{complete}")
    print("  " + ", ".join(f"{name} {value}" for name, value in standing.hashes.items()))
    print(f"  {_sealed(study)}")
    for line in _counts(standing):
        print(f"  {line}")
    for line in _listed(standing, every):
        print(line)
    if not standing.complete:
        print(f"to finish it: simgap compare --resume {study.folder}")
    return standing.complete


def _counts(standing: Standing) -> list[str]:
    """A line for each tuner or kind of ball: how many ended how."""
    from bench.store.standing import MISSING

    groups = dict.fromkeys(end.group for end in standing.ends)
    width = max(map(len, groups), default=0)
    lines = []
    for group in groups:
        ends = Counter(end.status for end in standing.ends if end.group == group)
        missing = ends.pop(MISSING, 0)
        parts = [f"{n} {status}" for status, n in sorted(ends.items())]
        if missing:
            parts.append(f"{missing} missing")
        lines.append(f"{group:{width}}  {', '.join(parts)}")
    return lines


def _listed(standing: Standing, every: bool) -> list[str]:
    """A line a run: all of them, or a few of those of which there is something to say."""
    from bench.store.standing import FINE

    shown = standing.ends
    if not every:
        telling = tuple(end for end in shown if end.status not in FINE)
        shown = (telling or shown)[:_FEW]
    lines = []
    for end in shown:
        # A traceback ends with what went wrong.
        reason = (end.reason.strip().splitlines() or [""])[-1]
        lines.append(f"{end.status:10} {end.name}  {reason}".rstrip())
    if not every and len(standing.ends) > len(shown):
        lines.append(f"({len(shown)} of {len(standing.ends)} listed; --runs lists all)")
    return lines


def _verify(options: argparse.Namespace) -> int:
    from bench.study import parts_of
    from bench.verify import verify

    doubts = [verify(part, print, options.plugin, options.all) for part in parts_of(options.run)]
    return 1 if any(doubts) else 0


def _plot(options: argparse.Namespace) -> int:
    from bench.runs.survey import admit
    from bench.study import opened, parts_of
    from sims.base import InputError

    files = [str(path.resolve()) for path in map(Path, options.plugin)]
    for folder in options.runs:
        for part in parts_of(folder):
            admit(files, opened(part).configuration.experiment)
    if len(options.runs) == 1 and not options.out:
        for part in parts_of(options.runs[0]):
            opened(part).finish(print)
        return 0
    if not options.out:
        raise InputError("several comparisons give one result: name a folder for it with --out DIR")
    from bench.across import across
    from bench.compare import Comparison

    for folder in options.runs:
        if not isinstance(opened(folder), Comparison):
            raise InputError(f"{folder}: expected the folder of a comparison, found a bounce shot")
    across(options.runs, options.out, print)
    return 0
