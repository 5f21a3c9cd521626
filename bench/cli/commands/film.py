"""Commands `simgap film` and `simgap track`: film a recorded ball, and track the ball in a film."""

from __future__ import annotations

import argparse
import sys

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import add_force_option, add_out_option, add_pdf, parse_path


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
    from bench.logs.film_rendering import write_film

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


def add_track_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap track`."""
    parser.add_argument(
        "video",
        metavar="VIDEO",
        type=parse_path,
        help="a film of one dropped ball by a fixed camera",
    )
    add_out_option(parser, "new file for the recording", "NAME.csv", required=True)
    parser.add_argument(
        "--ball-diameter", metavar="M", type=float, help="the ball's diameter in metres"
    )
    parser.add_argument(
        "--fps", metavar="F", type=float, help="frames per second (default: the file's time stamps)"
    )
    parser.add_argument(
        "--scale",
        choices=("camera", "diameter", "fall"),
        help="source of the scale in metres (default: VIDEO.camera.toml if it exists, else the "
        "diameter if given, else the fall)",
    )
    add_pdf(parser)
    parser.set_defaults(command=run_track)


def run_track(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Track a ball; write the recording and its figure.

    Args:
        options: Options of `simgap track`.
        print_line: Prints a line of text.
    """
    from bench.figures.ball_track_figure import render_track_figure
    from bench.logs.ball_heights_from_film import track_film

    diameter, fps, scale = options.ball_diameter, options.fps, options.scale
    track = track_film(
        options.video, options.out, render_track_figure, diameter, fps, scale, options.pdf
    )
    for note in track.notes:
        print(f"simgap: {options.video}: {note}", file=sys.stderr)
    for line in track.lines:
        print_line(line)
    endings = (".csv", ".toml", ".png", ".pdf") if options.pdf else (".csv", ".toml", ".png")
    files = [options.out.with_suffix(ending) for ending in endings]
    return CommandResult({**track.to_document(), "recording": options.out, "files": files})
