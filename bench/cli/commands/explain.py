"""Command `simgap explain`: explain recordings, together or each separately."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.output import (
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_PROBLEMS_FOUND,
    CommandResult,
    PrintLine,
)
from bench.cli.shared_options import (
    add_options,
    add_out_option,
    add_pdf,
    add_plugin_option,
    add_recordings_argument,
    collect_options,
    make_cluster_pool,
    parse_name_list,
)

if TYPE_CHECKING:
    from bench.diagnosis.many_logs import BatchLog, LogResult

_FIGURE_SUFFIXES = (".html", ".png", ".pdf")
"""File extensions of figures and reports, which are not listed one by one."""
_FILE_LABELS = {
    "report.html": "report",
    "extended.toml": "simulator",
    "extended.xml": "MJCF",
    "extended.urdf": "URDF",
    "apart.csv": "consistency",
}
"""Labels of result files on the terminal, where the stem of the name does not say the content."""

_RESULT_RELEVANT_OPTIONS = (
    "system", "model", "engine", "free", "tuner", "seed", "budget", "whole", "pieces", "thorough",
    "force", "fix_base", "plugin",
)  # fmt: skip
"""Options that affect the result."""


def add_explain_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap explain`."""
    from bench.diagnosis.explain_options import ExplainOptions

    add_recordings_argument(
        parser,
        "table of the recording; its .toml is in the same folder. Several recordings of one "
        "system, in the order of time, are explained together, and each separately",
    )
    add_options(parser, ExplainOptions, free={"default": ""})
    add_out_option(parser, "folder for the results (default: a new one below results/)")
    parser.add_argument(
        "--each",
        action="store_true",
        help="explain every recording separately, --jobs of them at once: a folder for each and "
        "one table of all; results of an earlier call in --out are reused",
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="with --each: run on the Dask cluster with this scheduler, which must have access to "
        "the same files",
    )
    parser.add_argument(
        "--ranges",
        action="store_true",
        help="for a robot: also write ranges for domain randomisation, the 95 %% intervals of the "
        "numbers of the extended model file, as ranges.toml, ranges.csv and code for Isaac Lab and "
        "MuJoCo Playground",
    )
    add_pdf(parser)
    add_plugin_option(parser, "systems")
    parser.set_defaults(command=_run_explain)


def _run_explain(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap explain`: explain recordings, write the results, print the text summary.

    The search shows its progress on stderr, and Ctrl-C ends it with the best result so far.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.
    """
    from bench.api.explain import explain
    from bench.benchmark.storage.provenance import get_utc_time, write_explanation_environment
    from bench.cli.progress_display import ProgressDisplay
    from bench.core.plugin_registries import load_plugins
    from bench.diagnosis.explain_options import ExplainOptions
    from bench.diagnosis.report.summary_text import format_summary
    from sims.core.files import check_folder_empty, make_timestamped_path
    from sims.core.simulator import InputError

    if options.cluster and not options.each:
        raise InputError(
            "--cluster: expected together with --each, since it distributes many recordings"
        )
    if options.ranges and options.each:
        raise InputError(
            "--ranges: not possible together with --each; explain the recordings together, or one "
            "by one"
        )
    load_plugins(options.plugin)
    if options.each:
        return _run_explain_batch(options, print_line)
    # Check this before the work, which may take minutes.
    if options.out is not None:
        check_folder_empty(options.out)
    started = get_utc_time()
    with ProgressDisplay(options.budget, silent=options.json) as display:
        with display.handle_interrupts() as arguments:
            explanation = explain(
                options.recordings,
                **collect_options(options, ExplainOptions),
                **arguments,
            )
        display.finish("drawing the figures and writing the report")
        folder = options.out or make_timestamped_path(
            Path("results"), f"explain-{options.recordings[0].stem}"
        )
        paths = explanation.write(folder, pdf=options.pdf, ranges=options.ranges)
    settings = {name: getattr(options, name) for name in _RESULT_RELEVANT_OPTIONS}
    environment_file = write_explanation_environment(folder, started, settings, options.recordings)
    for line in format_summary(explanation.story):
        print_line(line)
    left_out = explanation.ranges.left_out if options.ranges else ()
    # What the verdict contains but the extended simulator, or a range, cannot express.
    for line in (*explanation.unsaid, *left_out):
        print_line(line)
    # The report page is the last file that is written.
    *result_files, report = paths
    print_line(f"\n{_FILE_LABELS['report.html']:11} {report}")
    for path in result_files:
        if path.suffix not in _FIGURE_SUFFIXES:
            print_line(f"{_FILE_LABELS.get(path.name, path.stem):11} {path}")
    cutoff = explanation.answer.cut  # why the search ended early; None if it did not
    document = {
        "verdict": explanation.answer.to_document(),
        "title": explanation.story.title,
        "unsaid": explanation.unsaid,
        "folder": folder,
        "files": [*paths, environment_file],
    }
    if options.ranges:
        document["ranges"] = [joint_range.document() for joint_range in explanation.ranges.ranges]
        document["ranges_left_out"] = left_out
    interrupted = cutoff is not None and cutoff.reason == "interrupt"
    return CommandResult(document, EXIT_INTERRUPTED if interrupted else EXIT_OK)


def _run_explain_batch(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Explain every recording separately, print each result, then print the overall summary.

    Worker processes share the recordings. Results that an earlier call has left in the output
    folder are kept, so that an interrupted call can be continued.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.
    """
    from bench.benchmark.runner.plugin_inspection import Plugin
    from bench.benchmark.runner.worker_pools import make_pool
    from bench.benchmark.storage.provenance import get_utc_time
    from bench.cli.progress_display import ProgressDisplay
    from bench.core.resource_estimates import count_available_cores
    from bench.diagnosis.many_logs import explain_batch, format_cause, list_logs
    from sims.core.files import make_timestamped_path

    settings = {
        name: getattr(options, name)
        for name in (
            "system", "model", "engine", "tuner", "seed", "force", "budget", "whole", "pieces",
            "thorough", "fix_base",
        )
    } | {"free": tuple(parse_name_list(options.free))}  # fmt: skip
    output_folder = options.out or make_timestamped_path(Path("results"), "explain-each")
    logs = list_logs(options.recordings, output_folder, settings)
    started = get_utc_time()

    finished_count = 0

    def print_finished_recording(row: LogResult) -> None:
        """Print the result of one log (recording) as soon as it is explained.

        The live progress line is erased meanwhile, and shows the new share of finished recordings
        afterwards.

        Args:
            row: Result of one recording: its verdict or error, its causes and the time taken.
        """
        nonlocal finished_count
        finished_count += 1
        causes = [format_cause(cause) for cause in row.causes]
        seconds = "" if row.seconds is None else f" ({row.seconds:.0f} s)"
        with display.paused():
            print_line(
                f"{row.log}: {row.error or row.verdict} {'; '.join(causes)}".rstrip() + seconds
            )
        display.advance()
        display.completed(finished_count / len(logs))

    display = ProgressDisplay(silent=options.json, hint=False)
    with display, display.handle_interrupts() as arguments:
        display.stage("explaining each recording", len(logs))
        pool = make_cluster_pool(options.cluster) or make_pool(
            min(options.jobs or count_available_cores(), len(logs))
        )
        with pool:
            pool.load_plugins([Plugin(str(path)) for path in options.plugin])
            log_results = explain_batch(
                logs,
                output_folder,
                settings,
                pool,
                print_finished_recording,
                arguments["stop"],
            )
    return _report_batch(options, output_folder, started, logs, log_results, print_line)


def _report_batch(
    options: argparse.Namespace,
    output_folder: Path,
    started: str,
    logs: Sequence[BatchLog],
    log_results: Sequence[LogResult],
    print_line: PrintLine,
) -> CommandResult:
    """Write the page over all recordings and how it was made, and print the summary.

    Args:
        options: parsed command line.
        output_folder: folder with the results of all recordings.
        started: time of the start, UTC.
        logs: all recordings.
        log_results: results of those that are explained.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code: EXIT_INTERRUPTED if recordings remain.
    """
    from bench.benchmark.storage.provenance import (
        format_explain_command,
        write_explanation_environment,
    )
    from bench.diagnosis.many_logs import (
        LOGS_TABLE_FILE,
        BatchPageInput,
        summarise_causes,
        write_summary_page,
    )

    remaining = len(logs) - len(log_results)
    folders = {log.name: log.folder for log in logs}
    relevant = {name: getattr(options, name) for name in _RESULT_RELEVANT_OPTIONS} | {"each": True}
    command_words = format_explain_command(options.recordings, {**relevant, "out": output_folder})
    recordings = dict(zip(folders, options.recordings, strict=True))
    report = write_summary_page(
        log_results, BatchPageInput(output_folder, folders, recordings, command_words, remaining)
    )
    write_explanation_environment(output_folder, started, relevant, options.recordings)
    summary_lines = summarise_causes(log_results)
    for line in (
        "",
        *summary_lines,
        f"\nreport  {report}",
        f"table   {output_folder / LOGS_TABLE_FILE}",
    ):
        print_line(line)
    code = EXIT_PROBLEMS_FOUND if any(row.error for row in log_results) else EXIT_OK
    if remaining:  # the user has interrupted the command
        print_line(
            f"{remaining} of {len(logs)} recordings remain; run the same command again to continue"
        )
        code = EXIT_INTERRUPTED
    results = [{**asdict(row), "folder": folders[row.log]} for row in log_results]
    document = {
        "logs": results,
        "together": summary_lines,
        "left": remaining,
        "table": output_folder / LOGS_TABLE_FILE,
        "report": report,
    }
    return CommandResult(document, code)
