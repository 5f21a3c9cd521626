"""The command line of simgap; `simgap --help` lists its commands.

Heavy packages are imported by the commands that need them, so that `simgap --help` is quick. A fault of the user's is
one line on stderr and exit code 2; an internal error keeps its traceback.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.ahead import add_train
from bench.gap.commands import add_explain, add_score
from bench.vision.commands import add_film, add_track

if TYPE_CHECKING:
    from bench.experiment import Experiment

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = _parser().parse_args(arguments)
    from sims.base import InputError

    try:
        code: int = options.command(options)
    except InputError as error:
        print(f"simgap: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `simgap list ... | head`
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        print("simgap: interrupted before there was a result", file=sys.stderr)
        return INTERRUPTED
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="simgap",
        description="Compare methods that tune simulator parameters; find what tuning cannot fix.",
    )
    parser.add_argument("--version", action="version", version=f"simgap {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")

    compare = commands.add_parser("compare", help="run an experiment: tuners x targets x seeds; write table and figure")
    compare.add_argument(
        "experiment", metavar="EXPERIMENT", nargs="?", help="name (see `simgap list experiments`) or TOML file"
    )
    compare.add_argument("--tuners", metavar="A,B,...", help="only these tuners, by label or registered name")
    compare.add_argument("--targets", type=_positive, metavar="N", help="targets in each range")
    compare.add_argument("--seeds", type=_positive, metavar="N", help="seeds of each tuner that uses chance")
    compare.add_argument("--budget", type=_positive, metavar="N", help="simulations on one target")
    compare.add_argument(
        "--training-budget", type=_positive, metavar="N", help="simulations that a tuner may learn from"
    )
    compare.add_argument("--jobs", type=_positive, metavar="N", default=2, help="worker processes (default: 2)")
    compare.add_argument("--out", metavar="DIR", help="folder to write (default: a new one below results/)")
    compare.add_argument("--plugin", action="append", default=[], metavar="FILE", help="Python file with more tuners")
    compare.add_argument("--resume", metavar="DIR", type=Path, help="finish what is missing in this folder instead")
    compare.add_argument("--cluster", metavar="ADDRESS", help="run on the Dask cluster with this scheduler")
    compare.add_argument("--timeout", type=_seconds, metavar="S", help="seconds that a run may take, then it is killed")
    compare.add_argument("--memory", type=_positive, metavar="MIB", help="memory that a run may take")
    compare.add_argument("--allow-failures", action="store_true", help="exit with 0 although runs failed")
    compare.set_defaults(command=_compare)

    add_train(commands.add_parser("train", help="train a learned tuner ahead of the comparisons that use it"))

    status = commands.add_parser("status", help="what a comparison's folder holds, and what is missing")
    status.add_argument("run", metavar="DIR", type=Path, help="the comparison's folder")
    status.add_argument("--runs", action="store_true", help="list every run by its id")
    status.set_defaults(command=_status)

    check = commands.add_parser("check", help="run the conformance suite on a tuner, a simulator or an effect")
    check.add_argument("name", metavar="NAME", help="registered name, e.g. cma_es, pendulum or drag.linear")
    check.add_argument("--plugin", action="append", default=[], metavar="FILE", help="Python file that defines it")
    check.set_defaults(command=_check)

    plot = commands.add_parser("plot", help="write table and figures of a comparison again, or of several together")
    plot.add_argument("runs", metavar="RUN", type=Path, nargs="+", help="a comparison's folder; several: ranks")
    plot.add_argument("--out", metavar="DIR", type=Path, help="folder for what several comparisons give together")
    plot.add_argument("--plugin", action="append", default=[], metavar="FILE", help="Python file with more simulators")
    plot.set_defaults(command=_plot)

    _add_simulate(commands.add_parser("simulate", help="write a recording of a simulated system, its truth apart"))

    inspect = commands.add_parser("inspect", help="summarise and draw a recording")
    inspect.add_argument("recording", metavar="FILE.csv", type=Path, help="the table; its .toml stands beside it")
    inspect.add_argument("--system", metavar="NAME", help="take it for this system, whatever the .toml says")
    inspect.add_argument("--out", metavar="DIR", type=Path, help="folder for the figure (default: results/inspect)")
    inspect.add_argument("--plugin", action="append", default=[], metavar="FILE", help="Python file with more systems")
    inspect.set_defaults(command=_inspect)

    add_explain(commands.add_parser("explain", help="show what a simulation gets wrong on a recording, and why"))
    add_score(commands.add_parser("score", help="error of an extended simulator on another recording"))

    add_film(commands.add_parser("film", help="render a recorded ball as a video"))
    add_track(commands.add_parser("track", help="track a ball in a video; write a recording"))

    listing = commands.add_parser("list", help="list tuners, simulators, systems, effects or experiments")
    listing.add_argument("what", choices=("tuners", "simulators", "systems", "effects", "experiments"))
    listing.add_argument("--plugin", action="append", default=[], metavar="FILE", help="Python file with more of them")
    listing.set_defaults(command=_list)
    return parser


def _add_simulate(simulate: argparse.ArgumentParser) -> None:
    simulate.add_argument("system", metavar="SYSTEM", help="see `simgap list systems`")
    for name, metavar, text in (
        ("theta", "NAME=VALUE", "parameters, or all values in order with commas between (default: nominal)"),
        ("effect", "NAME=VALUE[,VALUE]", "effects that act, with their coefficients"),
        ("constant", "NAME=VALUE", "constants other than the system's defaults"),
        ("noise", "S", "sensor noise, 1 sigma: of every channel, or NAME=S (default: none)"),
        ("input", "NAME=SIGNAL", "a number, sine:AMPLITUDE:HERTZ, square:A:HZ, steps:A:SECONDS, chirp:A:HZ:HZ"),
        ("initial", "NAME=VALUE", "initial states, or NAME=LOW:HIGH to draw each run's"),
    ):
        simulate.add_argument(f"--{name}", action="extend", nargs="+", default=[], metavar=metavar, help=text)
    simulate.add_argument("--observe", metavar="A,B,...", help="channels to record (default: the system's usual ones)")
    simulate.add_argument("--runs", type=_positive, metavar="N", default=4, help="number of runs (default: 4)")
    simulate.add_argument("--seconds", type=float, metavar="T", default=4.0, help="length of a run (default: 4)")
    simulate.add_argument("--rate", type=float, metavar="HZ", default=100.0, help="samples a second (default: 100)")
    simulate.add_argument("--engine", metavar="NAME", help="pybullet, mujoco or batch (default: batch)")
    simulate.add_argument("--seed", type=int, metavar="K", default=0, help="of all that is drawn (default: 0)")
    simulate.add_argument("--held-out", type=int, metavar="M", help="mark the last M runs (default: a third)")
    simulate.add_argument("--out", type=Path, metavar="FILE.csv", required=True, help="file to write, a new one")
    simulate.add_argument("--plugin", action="append", default=[], metavar="FILE", help="Python file with more systems")
    simulate.set_defaults(command=_simulate)


def _positive(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, found '{text}'")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise argparse.ArgumentTypeError(f"expected a number of seconds above 0, found '{text}'")
    return value


def _chosen(options: argparse.Namespace) -> Experiment:
    """The experiment that the options of `compare` describe."""
    from bench.experiment import load
    from bench.registry import load_plugins, tuners
    from sims.base import InputError, unknown

    if options.experiment is None:
        raise InputError("expected an experiment (see `simgap list experiments`), or --resume DIR")
    load_plugins(options.plugin)
    changes = {name: getattr(options, name) for name in ("targets", "budget", "training_budget", "timeout", "memory")}
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
    from bench.bars import Bars
    from bench.compare import begin, make, only_resume, resume
    from bench.report import finish
    from bench.shot.study import begin as begin_shot
    from bench.shot.study import is_shot

    pool = None
    if options.cluster:
        from bench.cluster import ClusterPool

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
    from bench.bars import Bars
    from bench.shot.study import make

    with Bars() as bars:
        return make(folder, options.plugin, options.jobs, bars.start, print)


def _status(options: argparse.Namespace) -> int:
    from bench.compare import status

    return 0 if status(options.run, options.runs, print) else 1


def _check(options: argparse.Namespace) -> int:
    from bench.checks.command import run
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    return 0 if run(options.name, options.plugin, print) else 1


def _plot(options: argparse.Namespace) -> int:
    from bench.problem import Problem
    from bench.registry import load_plugins
    from bench.report import finish
    from bench.store import configuration
    from sims.base import InputError

    load_plugins(options.plugin)
    if len(options.runs) > 1 or options.out:
        from bench.summary import across

        if not options.out:
            raise InputError("several comparisons give one result: name a folder for it with --out DIR")
        across(options.runs, options.out, print)
        return 0
    finish(options.runs[0], Problem(configuration(options.runs[0]).experiment), print)
    return 0


def _simulate(options: argparse.Namespace) -> int:
    from bench.registry import load_plugins
    from bench.simulate import Wish, write

    load_plugins(options.plugin)
    wish = Wish(
        options.system, options.theta, options.effect, options.constant, options.noise, options.input, options.initial,
        [name.strip() for name in options.observe.split(",")] if options.observe else [], options.runs,
        options.seconds, options.rate, options.engine, options.seed, options.held_out,
    )  # fmt: skip
    made = write(wish, options.out)
    channels = ", ".join(made.recording.runs[0].channels)
    runs = f"{options.runs} run{'s' * (options.runs > 1)}"
    print(f"{options.out}: {runs} of {options.seconds:g} s at {options.rate:g} Hz, channels {channels}")
    print(f"{options.out.with_suffix('.truth.toml')}: what made it")
    return 0


def _inspect(options: argparse.Namespace) -> int:
    from bench.inspection import load, summary
    from bench.inspection_figure import draw
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    recording, kind = load(options.recording, options.system)
    for line in summary(recording, kind):
        print(line)
    for path in draw(recording, kind, options.out or Path("results/inspect", options.recording.resolve().parent.name)):
        print(path)
    return 0


def _list(options: argparse.Namespace) -> int:
    from bench.catalogue import lines
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    for line in lines(options.what):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
