"""The command `simgap plot`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.output import CommandResult, JsonDocument, PrintLine
from bench.cli.shared_options import add_pdf, add_plugin_option, parse_path

if TYPE_CHECKING:
    from bench.benchmark.storage.reference_results import ReferenceResult


def add_plot_arguments(plot: argparse.ArgumentParser) -> None:
    """Add the options of `simgap plot`."""
    plot.add_argument(
        "runs",
        metavar="RUN",
        type=parse_path,
        nargs="+",
        help="the folder of a comparison or bounce shot; several comparisons: ranks",
    )
    plot.add_argument(
        "--out",
        metavar="DIR",
        type=parse_path,
        help="folder for the joint results of several comparisons",
    )
    plot.add_argument(
        "--behind",
        metavar="NAME",
        action="append",
        default=[],
        help="draw errors against simulations again, with this reference result in grey behind "
        "them: see `simgap list references`, or the folder of a comparison",
    )
    add_pdf(plot)
    add_plugin_option(plot, "simulators")
    plot.set_defaults(command=_run_plot)


def _run_plot(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap plot`: write tables, figures and report of finished results again.

    Several comparisons together give one joint result, which needs the folder `options.out`.
    Results named with ``--behind`` are drawn in grey behind them.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
    from bench.benchmark.storage.reference_results import find_reference
    from bench.studies.study_kinds import list_study_folders, open_study
    from bench.suite.suite_report import report_suite
    from bench.suite.suite_runs import is_stored_suite
    from sims.core.simulator import InputError

    if len(options.runs) == 1 and is_stored_suite(options.runs[0]):
        report_suite(options.runs[0], print_line)
        return CommandResult({"comparisons": []})
    files = [str(path.resolve()) for path in map(Path, options.plugin)]
    for folder in options.runs:
        for part in list_study_folders(folder):
            load_plugins_for_experiment(files, open_study(part).configuration.experiment)
    references = [find_reference(name) for name in options.behind]
    if len(options.runs) == 1 and not options.out:
        # Check the references before anything is drawn.
        for part in list_study_folders(options.runs[0]):
            for reference in references:
                reference.find_mismatches(open_study(part).configuration.experiment)
        return _report_again(options.runs[0], references, print_line)
    if not options.out:
        raise InputError("several comparisons have a joint result: give its folder with --out DIR")
    from bench.benchmark.comparison_study import Comparison
    from bench.suite.multi_problem_report import compare_across_problems

    for folder in options.runs:
        if not isinstance(study := open_study(folder), Comparison):
            experiment = study.configuration.experiment
            if experiment.diagnosis:
                found_text = "a comparison of diagnosers"
            elif experiment.shot:
                found_text = "a bounce shot"
            else:
                found_text = "a study of two comparisons"
            raise InputError(f"{folder}: expected the folder of a comparison, found {found_text}")
    document = compare_across_problems(options.runs, options.out, print_line).to_document()
    return CommandResult(
        {
            **document,
            "behind": _draw_each_with_references(options.runs, references, options.out, print_line),
        }
    )


def _report_again(
    folder: Path, references: Sequence[ReferenceResult], print_line: PrintLine
) -> CommandResult:
    """Report again a study, or the studies of a sweep or of a file with several studies.

    Args:
        folder: folder of the study, sweep or file of studies.
        references: reference results that are drawn behind the figures.
        print_line: prints one line of text.
    """
    from bench.cli.output import summarise_study
    from bench.studies.study_kinds import list_study_folders, open_study, report_jointly

    comparisons = []
    for part in list_study_folders(folder):
        study = open_study(part)
        failed = study.report(print_line)
        reference_documents = _draw_with_references(part, references, part, print_line)
        comparisons.append(
            {**summarise_study(study), "failed": failed, "behind": reference_documents}
        )
    report_jointly(folder, print_line)
    return CommandResult({"comparisons": comparisons})


def _draw_each_with_references(
    folders: Sequence[Path],
    references: Sequence[ReferenceResult],
    output_folder: Path,
    print_line: PrintLine,
) -> list[JsonDocument]:
    """Draw each of several comparisons over the references that belong to its problem.

    References of other problems cannot be drawn behind it; a line says so.

    Args:
        folders: folders of the comparisons.
        references: reference results.
        output_folder: folder for the figures.
        print_line: prints one line of text.
    """
    from sims.core.simulator import InputError

    documents = []
    for number, folder in enumerate(folders, 1):
        for reference in references:
            name = f"{number}-{folder.resolve().name}-{reference.name.replace('/', '-')}-"
            try:
                documents += _draw_with_references(
                    folder, [reference], output_folder, print_line, name
                )
            except InputError as error:
                print_line(f"not drawn: {error}")
    return documents


def _draw_with_references(
    folder: Path,
    references: Sequence[ReferenceResult],
    output_folder: Path,
    print_line: PrintLine,
    name: str = "",
) -> list[JsonDocument]:
    """Draw a comparison over references in grey; draw nothing without references.

    Args:
        folder: folder of the comparison.
        references: reference results.
        output_folder: folder for the figures.
        print_line: prints one line of text.
        name: beginning of the names of the figures' files.
    """
    if not references:
        return []
    from bench.benchmark.comparison_printed_figures import draw_with_references

    return draw_with_references(folder, references, output_folder, print_line, name)
