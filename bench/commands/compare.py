"""The commands `simgap compare`, `simgap status` and `simgap plot`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.options import add_plugin, positive, seconds

if TYPE_CHECKING:
    from bench.problem.experiment import Experiment

INTERRUPTED = 130


def add_compare(compare: argparse.ArgumentParser) -> None:
    """The options of `simgap compare`."""
    compare.add_argument(
        "experiment",
        metavar="EXPERIMENT",
        nargs="?",
        help="name (see `simgap list experiments`) or TOML file",
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
        "--jobs", type=positive, metavar="N", default=2, help="worker processes (default: 2)"
    )
    compare.add_argument(
        "--out", metavar="DIR", help="folder to write (default: a new one below results/)"
    )
    add_plugin(compare, "tuners")
    compare.add_argument(
        "--resume", metavar="DIR", type=Path, help="finish what is missing in this folder instead"
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
    compare.add_argument(
        "--allow-failures", action="store_true", help="exit with 0 although runs failed"
    )
    compare.set_defaults(command=_compare)


def add_status(status: argparse.ArgumentParser) -> None:
    """The options of `simgap status`."""
    status.add_argument("run", metavar="DIR", type=Path, help="the comparison's folder")
    status.add_argument("--runs", action="store_true", help="list every run by its id")
    status.set_defaults(command=_status)


def add_plot(plot: argparse.ArgumentParser) -> None:
    """The options of `simgap plot`."""
    plot.add_argument(
        "runs", metavar="RUN", type=Path, nargs="+", help="a comparison's folder; several: ranks"
    )
    plot.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for what several comparisons give together"
    )
    add_plugin(plot, "simulators")
    plot.set_defaults(command=_plot)


def _chosen(options: argparse.Namespace) -> Experiment:
    """The experiment that the options of `compare` describe."""
    from bench.problem.experiment import load
    from bench.registry import load_plugins, tuners
    from sims.base import InputError, unknown

    if options.experiment is None:
        raise InputError("expected an experiment (see `simgap list experiments`), or --resume DIR")
    load_plugins(options.plugin)
    changes = {
        name: getattr(options, name)
        for name in ("targets", "budget", "training_budget", "timeout", "memory")
    }
    experiment = load(options.experiment).chosen(**changes)
    if options.seeds:
        experiment = experiment.with_seeds(options.seeds)
    if options.tuners:
        labels = [label.strip() for label in options.tuners.split(",") if label.strip()]
        known = {*tuners.names(), *(entry.label for entry in experiment.tuners)}
        for label in labels:
            if label not in known:
                raise unknown("tuner", label, sorted(known))
        experiment = experiment.with_tuners(labels)
    return experiment


def _compare(options: argparse.Namespace) -> int:
    from bench.commands.progress import Bars
    from bench.compare import begin, make, only_resume, resume
    from bench.report import finish
    from bench.shot.study import begin as begin_shot
    from bench.shot.study import is_shot

    pool = None
    if options.cluster:
        from bench.runs.cluster import ClusterPool

        pool = ClusterPool(options.cluster)
    if options.resume:
        only_resume(options)
        folder = options.resume
        if is_shot(folder):
            return _shoot(folder, options)
        plugins, results = resume(folder, options.plugin)
    else:
        plugins = options.plugin
        experiment = _chosen(options)
        if experiment.shot:
            return _shoot(begin_shot(experiment, plugins, options.out, options.jobs), options)
        folder, results = begin(experiment, plugins, options.out, options.jobs)
    with Bars() as bars:
        complete = make(folder, results, plugins, options.jobs, bars.start, pool)
    failed = finish(folder, results.problem, print)
    if not complete:
        done, planned = len(results.kept.statuses), len(results.plan)
        what = "interrupted" if results.interrupted else results.stopped or "stopped"
        print(f"simgap: {what}; {done} of {planned} runs are finished and kept", file=sys.stderr)
        print(f"simgap: to finish: simgap compare --resume {folder}", file=sys.stderr)
        return INTERRUPTED if results.interrupted else 1
    return 1 if failed and not options.allow_failures else 0


def _shoot(folder: Path, options: argparse.Namespace) -> int:
    """A bounce shot: begun or resumed in its folder."""
    from bench.commands.progress import Bars
    from bench.shot.study import make

    with Bars() as bars:
        return make(folder, options.plugin, options.jobs, bars.start, print)


def _status(options: argparse.Namespace) -> int:
    from bench.compare import status
    from bench.shot.study import is_shot
    from bench.shot.study import status as status_of_shots

    if is_shot(options.run):
        return 0 if status_of_shots(options.run, print) else 1
    return 0 if status(options.run, options.runs, print) else 1


def _plot(options: argparse.Namespace) -> int:
    from bench.problem.problem import Problem
    from bench.registry import load_plugins
    from bench.report import finish
    from bench.store.folder import configuration
    from sims.base import InputError

    load_plugins(options.plugin)
    if len(options.runs) > 1 or options.out:
        from bench.across import across

        if not options.out:
            raise InputError(
                "several comparisons give one result: name a folder for it with --out DIR"
            )
        across(options.runs, options.out, print)
        return 0
    finish(options.runs[0], Problem(configuration(options.runs[0]).experiment), print)
    return 0
