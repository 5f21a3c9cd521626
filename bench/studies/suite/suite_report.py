"""Report of a benchmark suite: merge its runs with the stored ones; write tables and the page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.benchmark.results_report import REPORT_FILE
from bench.benchmark.storage.reference_results import REFERENCE_FOLDERS
from bench.studies.suite.suite_guide import build_guide, build_headline, describe_losses
from bench.studies.suite.suite_page import render_suite_page
from bench.studies.suite.suite_runs import (
    CURVES_FILE,
    SuiteRuns,
    collect_suite_runs,
    list_comparison_folders,
    merge_runs,
    read_suite_runs,
    write_suite_runs,
)
from bench.studies.suite.suite_tables import FREE, SuiteTables
from sims.core.files import write_atomically

PrintLine = Callable[[str], None]
_REFERENCE_NAME = "suite"
"""Folder of the stored runs among the reference results."""
_MAX_PRINTED_TUNERS = 30
"""Maximum number of tuners in the printed table."""


def report_suite(folder: Path, print_line: PrintLine) -> SuiteTables:
    """Write and print the results of a suite, together with the stored runs of other methods.

    Args:
        folder: folder of the suite, with one subfolder per problem or with stored runs.
        print_line: callback that prints one line.

    Raises:
        InputError: there are no results.
    """
    has_comparisons = any(list_comparison_folders(folder))
    new_runs = collect_suite_runs(folder) if has_comparisons else read_suite_runs(folder)
    suite = new_runs
    stored = find_stored_runs(new_runs.version) if has_comparisons else None
    if stored is not None:
        suite = merge_runs(new_runs, stored)
    if has_comparisons:
        write_suite_runs(new_runs, folder)
    tables = SuiteTables(suite)
    for name, frame in {**tables.build_tables(), "guide": build_guide(tables)}.items():
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False))
    write_atomically(folder / REPORT_FILE, render_suite_page(tables))
    _print_results(tables, new_runs, print_line)
    print_line(f"report  {folder / REPORT_FILE}")
    return tables


def find_stored_runs(version: str) -> SuiteRuns | None:
    """Return the stored runs of a version of a suite; None if there are none."""
    for place in REFERENCE_FOLDERS:
        folder = place / _REFERENCE_NAME
        if (folder / CURVES_FILE).is_file():
            stored = read_suite_runs(folder)
            if stored.version == version:
                return stored
    return None


def _print_results(tables: SuiteTables, new_runs: SuiteRuns, print_line: PrintLine) -> None:
    """Print the headline, the mean ranks and the losses of the reference methods."""
    targets = new_runs.runs.groupby("cell")["target"].nunique()
    stored_tuners = [name for name in tables.suite.tuners if name not in new_runs.tuners]
    count = (
        f"{targets.min()} to {targets.max()}" if targets.min() != targets.max() else targets.max()
    )
    print_line(f"\n{new_runs.version}: {len(tables.curves)} cells, {count} targets in each")
    if stored_tuners:
        print_line(
            f"stored results of {len(stored_tuners)} other methods on the same targets are included"
        )
    for row in tables.suite.skipped.itertuples():
        print_line(f"skipped: {row.tuner}: {row.reason}")
    missing = [name for name in tables.suite.tuners if name not in tables.complete_tuners]
    if missing:
        print_line(f"not ranked, because results are missing in some cells: {', '.join(missing)}")
    if not tables.complete_tuners:
        print_line("no method has results in all cells; there are no mean ranks")
        return
    print_line(f"\n{build_headline(tables)}")
    ranks = tables.ranks[tables.ranks["training"] == FREE]
    table = ranks.pivot(index="tuner", columns="simulations", values="mean_rank")
    table = table.sort_values(by=table.columns[-1]).head(_MAX_PRINTED_TUNERS).round(1)
    print_line("\nmean rank after N simulations (1 is best)")
    print_line(table.rename_axis(index=None, columns=None).to_string())
    print_line("")
    for line in describe_losses(tables):
        print_line(line)
