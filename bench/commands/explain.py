"""The commands `simgap explain` and `simgap score`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from bench.commands.answer import DONE, INTERRUPTED, WRONG, Answer, Say
from bench.commands.interrupts import Interrupts
from bench.commands.options import (
    add_force,
    add_model,
    add_pdf,
    add_plugin,
    cluster_pool,
    names,
    place,
    positive,
    seconds,
)

_PICTURED = (".html", ".png", ".pdf")
"""File extensions of figures and reports, which are not listed one by one."""

_SETTINGS = (
    "system", "model", "engine", "free", "tuner", "seed", "budget", "whole", "pieces", "thorough",
    "force", "plugin",
)  # fmt: skip
"""Options that affect the result."""


def add_explain(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap explain`."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING.csv",
        type=place,
        nargs="+",
        help="the table; its .toml stands beside it. Several of one system, in the order of time, "
        "are explained together, and what each says by itself is compared",
    )
    parser.add_argument(
        "--system", metavar="NAME", help="take it for this system, whatever the .toml says"
    )
    add_model(parser)
    parser.add_argument(
        "--engine",
        metavar="NAME",
        default="batch",
        help="pybullet, mujoco or batch (default: batch)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=place,
        help="folder to write (default: a new one below results/)",
    )
    parser.add_argument(
        "--seed", type=int, metavar="K", default=0, help="of all that is drawn (default: 0)"
    )
    parser.add_argument(
        "--free",
        metavar="A,B,...",
        default="",
        help="constants to estimate with the parameters; "
        "of a robot numbers of its model file, as damping@* or mass@forearm",
    )
    parser.add_argument(
        "--tuner",
        metavar="NAME",
        help="a tuner that finds where the base fit begins (default: a grid)",
    )
    parser.add_argument(
        "--budget",
        type=seconds,
        metavar="S",
        help="seconds after which the search ends with what it has (default: it comes to its end); "
        "Ctrl-C ends it likewise",
    )
    parser.add_argument(
        "--jobs",
        type=positive,
        metavar="N",
        help="processes that work at once, where that pays; the answer is the same with any number "
        "(default: one for each core)",
    )
    parser.add_argument(
        "--whole",
        action="store_true",
        help="look at all of a long recording of a robot (default: at pieces from all over it)",
    )
    parser.add_argument(
        "--pieces",
        type=seconds,
        metavar="S",
        help="cut runs into pieces of S seconds, each with an initial state of its own: for motion "
        "that drifts or is unstable",
    )
    parser.add_argument(
        "--thorough",
        action="store_true",
        help="search on where causes are found and something is left over: further causes are "
        "taken that held-out runs bear out (about twice as long there)",
    )
    parser.add_argument(
        "--each",
        action="store_true",
        help="explain every recording by itself, --jobs of them at once: a folder for each and one "
        "table of all; what --out holds of an earlier call is not made again",
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="with --each: on the Dask cluster with this scheduler, which must see the same files",
    )
    parser.add_argument(
        "--ranges",
        action="store_true",
        help="for a robot: also write ranges for domain randomisation, the 95 %% intervals of what "
        "its model file then has, as ranges.toml, ranges.csv and code for Isaac Lab and MuJoCo "
        "Playground",
    )
    add_pdf(parser)
    add_plugin(parser, "systems")
    add_force(parser)
    parser.set_defaults(command=_explain)


def add_score(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap score`."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=place,
        help="extended.toml as `simgap explain` writes it, or a robot's extended.xml",
    )
    parser.add_argument(
        "recording",
        metavar="OTHER.csv",
        type=place,
        help="the recording; its .toml stands beside it",
    )
    parser.add_argument(
        "--held-out", action="store_true", help="only the runs that are marked held_out"
    )
    add_plugin(parser, "systems")
    add_force(parser)
    parser.set_defaults(command=_score)


def _explain(options: argparse.Namespace, say: Say) -> Answer:
    """Explain a recording, write the results, print the text summary."""
    from bench.api.explain import explain
    from bench.commands.search_progress import ProgressDisplay
    from bench.gap.report.account import account
    from bench.registry import load_plugins
    from bench.store.made import now, write_explained
    from sims.base import InputError
    from sims.files import refuse_full, stamped

    if options.cluster and not options.each:
        raise InputError("--cluster: expected --each beside it, as it is for many recordings")
    if options.ranges and options.each:
        raise InputError(
            "--ranges: not possible together with --each; explain the recordings together, or one "
            "by one"
        )
    load_plugins(options.plugin)
    if options.each:
        return _explain_each(options, say)
    # Check this before the work, which may take minutes.
    if options.out is not None:
        refuse_full(options.out)
    started = now()
    with ProgressDisplay(options.budget, silent=options.json) as display:
        with Interrupts(display.note) as interrupts:
            explanation = explain(
                options.recordings,
                system=options.system,
                model=options.model,
                engine=options.engine,
                free=names(options.free),
                tuner=options.tuner,
                seed=options.seed,
                force=options.force,
                budget=options.budget,
                jobs=options.jobs,
                whole=options.whole,
                pieces=options.pieces,
                thorough=options.thorough,
                say=display.note,
                stop=interrupts.asked,
                listener=display,
            )
        display.finish("drawing the figures and writing the report")
        folder = options.out or stamped(Path("results"), f"explain-{options.recordings[0].stem}")
        paths = explanation.write(folder, pdf=options.pdf, ranges=options.ranges)
    settings = {name: getattr(options, name) for name in _SETTINGS}
    made = write_explained(folder, started, settings, options.recordings)
    for line in account(explanation.story):
        say(line)
    left_out = explanation.ranges.left_out if options.ranges else ()
    for line in (*explanation.unsaid, *left_out):
        say(line)
    say(f"\nreport  {paths[-1]}")
    for path in paths:
        if path.suffix not in _PICTURED:
            say(f"{path.stem:7} {path}")
    cut = explanation.answer.cut
    document = {
        "verdict": explanation.answer.document(),
        "title": explanation.story.title,
        "unsaid": explanation.unsaid,
        "folder": folder,
        "files": [*paths, made],
    }
    if options.ranges:
        document["ranges"] = [one.document() for one in explanation.ranges.ranges]
        document["ranges_left_out"] = left_out
    interrupted = cut is not None and cut.by == "interrupt"
    return Answer(document, INTERRUPTED if interrupted else DONE)


def _explain_each(options: argparse.Namespace, say: Say) -> Answer:
    """Explain every recording separately, print each result, then print the overall summary."""
    from bench.commands.search_progress import ProgressDisplay
    from bench.gap.each.page import Asked, write_page
    from bench.gap.each.rows import TABLE, Row, named, told
    from bench.gap.each.run import explain_each, logs_of
    from bench.gap.model.crew import cores
    from bench.runs.pools import pool_of
    from bench.runs.survey import Plugin
    from bench.store.made import explaining, now, write_explained
    from sims.files import stamped

    settings = {
        name: getattr(options, name)
        for name in (
            "system", "model", "engine", "tuner", "seed", "force", "budget", "whole", "pieces",
            "thorough",
        )
    } | {"free": tuple(names(options.free))}  # fmt: skip
    out = options.out or stamped(Path("results"), "explain-each")
    logs = logs_of(options.recordings, out, settings)
    started = now()

    finished = 0

    def done(row: Row) -> None:
        nonlocal finished
        finished += 1
        causes = [named(cause) for cause in row.causes]
        seconds = "" if row.seconds is None else f" ({row.seconds:.0f} s)"
        with display.paused():
            say(f"{row.log}: {row.error or row.verdict} {'; '.join(causes)}".rstrip() + seconds)
        display.advance()
        display.completed(finished / len(logs))

    display = ProgressDisplay(silent=options.json, hint=False)
    with display, Interrupts(display.note) as interrupts:
        display.stage("explaining each recording", len(logs))
        pool = cluster_pool(options.cluster) or pool_of(min(options.jobs or cores(), len(logs)))
        with pool:
            pool.load([Plugin(str(path)) for path in options.plugin])
            rows = explain_each(logs, out, settings, pool, done, interrupts.asked)
    left = len(logs) - len(rows)
    folders = {log.name: log.folder for log in logs}
    given = {name: getattr(options, name) for name in _SETTINGS} | {"each": True}
    words = explaining(options.recordings, {**given, "out": out})
    recordings = dict(zip(folders, options.recordings, strict=True))
    report = write_page(rows, Asked(out, folders, recordings, words, left))
    write_explained(out, started, given, options.recordings)
    together = told(rows)
    for line in ("", *together, f"\nreport  {report}", f"table   {out / TABLE}"):
        say(line)
    code = WRONG if any(row.error for row in rows) else DONE
    if left:
        say(f"{left} of {len(logs)} left: the same command goes on with them")
        code = INTERRUPTED
    found = [{**asdict(row), "folder": folders[row.log]} for row in rows]
    document = {
        "logs": found,
        "together": together,
        "left": left,
        "table": out / TABLE,
        "report": report,
    }
    return Answer(document, code)


def _score(options: argparse.Namespace, say: Say) -> Answer:
    """Print a model's error on a recording."""
    from bench.api.explain import score
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    result = score(options.model, options.recording, held_out=options.held_out, force=options.force)
    units = result.pop("units")
    for channel, error in result["rmse"].items():
        say(f"{channel}: RMSE {error:.4g} {units[channel]}")
    counts = f"{result['runs']} runs, {result['samples']} samples"
    say(f"{result['normalised_rmse']:.4g} times the noise; {counts}")
    return Answer(result)
