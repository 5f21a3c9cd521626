"""The commands `simgap explain` and `simgap score`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path

from bench.commands.options import add_plugin


def add_explain(parser: argparse.ArgumentParser) -> None:
    """The options of `simgap explain`."""
    parser.add_argument(
        "recording",
        metavar="RECORDING.csv",
        type=Path,
        help="the table; its .toml stands beside it",
    )
    parser.add_argument(
        "--system", metavar="NAME", help="take it for this system, whatever the .toml says"
    )
    parser.add_argument(
        "--engine",
        metavar="NAME",
        default="batch",
        help="pybullet, mujoco or batch (default: batch)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder to write (default: a new one below results/)",
    )
    parser.add_argument(
        "--seed", type=int, metavar="K", default=0, help="of all that is drawn (default: 0)"
    )
    parser.add_argument(
        "--free", metavar="A,B,...", default="", help="constants to estimate with the parameters"
    )
    parser.add_argument(
        "--tuner",
        metavar="NAME",
        help="a tuner that finds where the base fit begins (default: a grid)",
    )
    add_plugin(parser, "systems")
    parser.set_defaults(command=explain)


def add_score(parser: argparse.ArgumentParser) -> None:
    """The options of `simgap score`."""
    parser.add_argument(
        "model", metavar="extended.toml", type=Path, help="as `simgap explain` writes it"
    )
    parser.add_argument(
        "recording",
        metavar="OTHER.csv",
        type=Path,
        help="the recording; its .toml stands beside it",
    )
    parser.add_argument(
        "--held-out", action="store_true", help="only the runs that are marked held_out"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_plugin(parser, "systems")
    parser.set_defaults(command=score)


def explain(options: argparse.Namespace) -> int:
    """Explain a recording, write what was found, print the account."""
    from bench.gap import explain as explaining
    from bench.gap.report.account import account
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    if options.out is not None:
        refuse_full(options.out)
    free = [name.strip() for name in options.free.split(",") if name.strip()]
    found = explaining.explain(
        options.recording, options.system, options.engine, options.seed, free, options.tuner, _say()
    )
    folder = options.out or _new(options.recording)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        from sims.base import InputError

        raise InputError(f"--out {folder}: cannot be made ({error.strerror})") from None
    paths = found.write(folder)
    for line in account(found.story):
        print(line)
    print(f"\nreport  {paths[-1]}")
    for path in paths[:2]:
        print(f"{path.stem:7} {path}")
    return 0


def score(options: argparse.Namespace) -> int:
    """Print a model's error on a recording."""
    from bench.gap.score_model import scored
    from bench.registry import load_plugins

    load_plugins(options.plugin)
    result = scored(options.model, options.recording, options.held_out)
    units = result.pop("units")
    if options.json:
        print(json.dumps(result, allow_nan=False))
        return 0
    for channel, error in result["rmse"].items():
        print(f"{channel}: RMSE {error:.4g} {units[channel]}")
    print(
        f"{result['normalised_rmse']:.4g} times the noise; {result['runs']} runs, {result['samples']} samples"
    )
    return 0


def refuse_full(folder: Path) -> None:
    """Raise InputError if a folder has something in it."""
    from sims.base import InputError

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"--out {folder}: exists and is not empty; results are never overwritten, name another folder"
        )


def _new(recording: Path) -> Path:
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    folder, number = Path("results", f"explain-{recording.stem}-{stamp}"), 1
    while folder.exists():
        number += 1
        folder = Path("results", f"explain-{recording.stem}-{stamp}-{number}")
    return folder


def _say() -> Callable[[str], None]:
    """Tell on stderr what is being done, on one line where that is a terminal."""
    last = "\r\x1b[K" if sys.stderr.isatty() else ""

    def say(text: str) -> None:
        end = "" if last else "\n"
        print(f"{last}simgap: {text} ..." if text else last, end=end, file=sys.stderr, flush=True)

    return say
