"""Command `simgap inspect`: print what a recording contains, and what looks wrong in it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.output import EXIT_OK, EXIT_PROBLEMS_FOUND, CommandResult, JsonDocument, PrintLine
from bench.cli.shared_options import (
    add_options,
    add_out_option,
    add_pdf,
    add_plugin_option,
    parse_name_list,
    parse_path,
)

if TYPE_CHECKING:
    from bench.diagnosis.conventions.convention_comparison import ConventionDifference
    from bench.logs.quality.quality_finding import Anomaly, QualityFinding
    from sims.core.simulator import Simulator
    from sims.recording.recording import Recording


def add_inspect_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap inspect`."""
    from sims.recording.recording_frame import FrameDescription

    parser.add_argument(
        "recording",
        metavar="FILE.csv",
        type=parse_path,
        help="table of the recording; its .toml is in the same folder",
    )
    add_options(parser, FrameDescription)
    parser.add_argument(
        "--fix-base",
        action="store_true",
        help="for a robot with a floating base: fix the base in the pose of the model file",
    )
    add_out_option(parser, "folder of the figure (default: results/inspect)")
    parser.add_argument(
        "--check",
        action="store_true",
        help="show what the recording can identify, before any fit; exit code 1 if a free number "
        "is not identifiable",
    )
    parser.add_argument(
        "--free",
        metavar="A,B,...",
        help="with --check: constants, or numbers of a model file, to be estimated",
    )
    parser.add_argument(
        "--fix",
        metavar="NAME.toml",
        type=parse_path,
        help="for a robot: write the description with the conventions of the model file, a new "
        "file",
    )
    add_pdf(parser)
    add_plugin_option(parser, "systems")
    parser.set_defaults(command=_run_inspect)


def _run_inspect(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap inspect`: print what a recording contains, and what looks wrong in it.

    It checks times, data quality, drives that do nothing and sign or unit conventions. With
    ``--fix`` it writes a corrected description, with ``--check`` it says which parameters the data
    determine.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code; EXIT_PROBLEMS_FOUND if the data do not
        determine a parameter that should be fitted.
    """
    from bench.core.plugin_registries import load_plugins
    from bench.figures.recording_figure import write_recording_figure
    from bench.logs import recording_summary
    from bench.logs.quality.log_quality import check_log_quality
    from bench.logs.quality.pose_checks import find_missing_base_poses
    from bench.logs.recording_loading import load_recording
    from bench.logs.recording_summary import format_summary
    from sims.core.simulator import InputError

    load_plugins(options.plugin)
    if options.free and not options.check:
        raise InputError("--free is used by --check; add --check, or leave out --free")
    recording, kind = load_recording(
        options.recording, options.system, options.model, fix_base=options.fix_base
    )
    robot_lines = list(recording_summary.format_robot_summary(kind))
    missing_poses = list(find_missing_base_poses(recording, kind))
    warnings_to_print = _list_warnings(recording, kind, missing_poses)
    findings = list(check_log_quality(recording, kind))
    active_recording, inactive = _remove_inactive_drives(recording, kind)
    findings += inactive
    differences: list[ConventionDifference] = []
    settings_to_fix: list[str] = []
    if missing_poses:
        if options.fix:
            raise InputError(f"{options.recording}: {missing_poses[0].text}")
        warnings_to_print.append(
            "the conventions of the log are not compared with those of the model file, because an "
            "initial pose is missing"
        )
    else:
        differences, settings_to_fix = _find_differing_conventions(options, active_recording, kind)
    for line in (
        *robot_lines,
        *format_summary(recording, kind),
        *(f"warning: {text}" for text in warnings_to_print),
        *(f"finding: {finding.text_line}" for finding in findings),
        *(f"convention: {difference.description}" for difference in differences),
        *(f"    set {line}" for line in settings_to_fix),
    ):
        print_line(line)
    folder = options.out or Path("results/inspect", options.recording.resolve().parent.name)
    corrected: list[Path] = []
    if options.fix:
        from bench.diagnosis.conventions.corrected_description import write_corrected

        corrected = write_corrected(options.recording, kind, differences, options.fix)
    files = [*write_recording_figure(recording, kind, folder), *corrected]
    for path in files:
        print_line(str(path))
    numbers = _print_identifiability(options, print_line) if options.check else None
    document = {
        **recording_summary.to_document(recording, kind),
        "robot": robot_lines,
        "odd": warnings_to_print,
        "findings": [finding._asdict() for finding in findings],
        "conventions": [_make_convention_document(difference) for difference in differences],
        "fixes": settings_to_fix,
        "check": numbers,
        "files": files,
    }
    has_unidentifiable = any(
        number["free"] and number["word"] == "not identifiable" for number in numbers or ()
    )
    return CommandResult(document, EXIT_PROBLEMS_FOUND if has_unidentifiable else EXIT_OK)


def _list_warnings(
    recording: Recording, kind: type[Simulator], missing_poses: Sequence[Anomaly]
) -> list[str]:
    """List what looks wrong in a recording.

    These are omissions of its logs, time stamps, missing initial poses, servos that are unstable at
    the time step, and signals that are missing or beyond limits.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        kind: simulator class.
        missing_poses: initial poses that the log does not state.
    """
    from bench.logs.quality.clock_checks import find_anomalies
    from bench.logs.quality.log_quality import find_log_anomalies, format_log_warnings
    from bench.logs.quality.servo_checks import check_servo_stability

    oddities = [
        *find_log_anomalies(recording),
        *find_anomalies(recording, kind),
        *missing_poses,
        *check_servo_stability(recording, kind),
    ]
    return [
        *(oddity.text for oddity in oddities),
        *format_log_warnings(recording, kind),
    ]


def _make_convention_document(difference: ConventionDifference) -> JsonDocument:
    """Convert a convention that differs from the model file to a JSON document.

    Its alternatives are other conventions that explain the recording equally well.
    """
    return {
        "text": difference.hypothesis.description,
        "alternatives": [alternative.description for alternative in difference.alternatives],
    }


def _remove_inactive_drives(
    recording: Recording, kind: type[Simulator]
) -> tuple[Recording, list[QualityFinding]]:
    """Return a robot's recording without samples in which drives do nothing, and where that is.

    Args:
        recording: recorded runs, with their channels, inputs and constants.
        kind: simulator class.
    """
    from bench.logs.quality.quality_finding import QualityFinding

    if not kind.has_model:
        return recording, []
    from bench.diagnosis.prediction_error.inactive_drives import remove_inactive_drives

    active = remove_inactive_drives(recording, kind)
    findings = []
    # Each drive adds a note to those of the recording: what was removed; and what to do.
    for note in active.notes[len(recording.notes) :]:
        text, _, remedy = note.rpartition("; ")
        findings.append(QualityFinding("drive", text, remedy))
    return active, findings


def _find_differing_conventions(
    options: argparse.Namespace, recording: Recording, kind: type[Simulator]
) -> tuple[list[ConventionDifference], list[str]]:
    """Return a robot log's conventions that differ from its model file, and their corrections.

    The corrections are lines of keys of the description.

    Args:
        options: parsed arguments of the command.
        recording: recorded runs, with their channels, inputs and constants.
        kind: simulator class.

    Raises:
        InputError: A corrected description is requested, but nothing differs.
    """
    from sims.core.simulator import InputError
    from sims.system_simulator import SystemSimulator

    differences: list[ConventionDifference] = []
    if issubclass(kind, SystemSimulator) and kind.has_model:
        from bench.diagnosis.conventions.convention_comparison import ConventionComparison
        from bench.diagnosis.conventions.unit_check import Subject

        differences = ConventionComparison(Subject(kind, recording, None)).differences()
    if options.fix and not differences:
        raise InputError(
            f"{options.recording}: the conventions agree with those of the model file, so that "
            "nothing has to be corrected; leave --fix out"
        )
    if not differences:
        return [], []
    from bench.diagnosis.conventions.corrected_description import list_changed_tables
    from sims.recording.recording_description import read_meta

    _, meta = read_meta(options.recording)
    return differences, list(list_changed_tables(meta, kind, differences))


def _print_identifiability(
    options: argparse.Namespace, print_line: PrintLine
) -> list[JsonDocument]:
    """Print which numbers the recording can determine, before any fit.

    The numbers are those that the user named with ``--free``, then the coefficients of the possible
    causes. The same is returned as JSON documents.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.
    """
    from bench.diagnosis.identifiability import check_identifiability
    from bench.diagnosis.report.identifiability_section import format_identifiability

    free = parse_name_list(options.free or "")
    numbers = check_identifiability(options.recording, options.system, options.model, free)
    print_line("\n".join(("", *format_identifiability(numbers))))
    return [
        {
            **asdict(number),
            "mixed": [
                {"with": name, "correlation": correlation} for name, correlation in number.mixed
            ],
        }
        for number in numbers
    ]
