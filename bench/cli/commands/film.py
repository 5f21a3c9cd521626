"""Command `simgap film`: film a run of a recording of a ball."""

from __future__ import annotations

import argparse

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import add_force_option, add_out_option, parse_path


def add_film_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap film`."""
    parser.add_argument(
        "recording",
        metavar="RECORDING.csv",
        type=parse_path,
        help="a recording of a ball, with channel z",
    )
    add_out_option(parser, "new file for the video", "FILM.mp4", required=True)
    parser.add_argument("--run", metavar="NAME", help="name of the run (default: the first)")
    parser.add_argument(
        "--size", metavar="PX", type=int, default=100, help="width and height (default: 100)"
    )
    parser.add_argument(
        "--camera-seed",
        metavar="K",
        type=int,
        default=0,
        help="camera, light, colours (default: 0)",
    )
    add_force_option(parser)
    parser.set_defaults(command=run_film)


def run_film(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Film a recorded ball.

    Args:
        options: Options of `simgap film`.
        print_line: Prints a line of text.
    """
    from bench.logs.film_tracking import write_film

    frames, seconds = write_film(
        options.recording,
        options.out,
        options.run,
        options.size,
        options.camera_seed,
        options.force,
    )
    camera = options.out.with_suffix(".camera.toml")
    print_line(
        f"{options.out}: {frames} frames, {seconds:.4g} s, {options.size} x {options.size} px"
    )
    print_line(f"{camera}: the camera")
    return CommandResult(
        {
            "film": options.out,
            "camera": camera,
            "frames": frames,
            "seconds": seconds,
            "pixels": options.size,
        }
    )
