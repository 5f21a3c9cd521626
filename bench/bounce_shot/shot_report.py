"""Tables, figures and HTML report of a bounce-shot study, and its summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bench.benchmark.comparison_report import REPORT_FILE
from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.statistics.comparison_statistics import add_trust_column
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES
from bench.bounce_shot.hit_rate_table import ALL_BALLS, NO_SHOT_STATUSES, build_result_table
from bench.bounce_shot.shot_animation import write_animation
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_figures import draw_figures, make_success_panel, select_example_shots
from bench.bounce_shot.shot_sampling import ShotSetup
from bench.bounce_shot.shot_storage import read_shot
from bench.figures import figure_output
from bench.figures.figure_output import FigureFiles
from bench.pages.html_page import HtmlPage
from bench.pages.template import render_text
from sims.core.files import write_atomically

_TEMPLATE = Path(__file__).with_name("shots.html")
_SUMMARY_TEMPLATE = Path(__file__).with_name("shots.txt")


def render_page(
    experiment: Experiment,
    folder: str,
    lines: pd.DataFrame,
    rows: pd.DataFrame,
    pictures: Mapping[str, FigureFiles],
) -> str:
    """Render the HTML report of a bounce-shot study.

    It names the method with the highest hit rate over all balls, and the methods whose intervals
    reach the lower end of its interval.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        folder: result folder.
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.
        rows: one row per method and shot.
        pictures: printed figures by name.
    """
    success_panel, success = make_success_panel(lines)
    page = HtmlPage(pictures)
    page.add_table("table", lines)
    page.add_table("shots", rows, 6)
    page.add_table(success_panel.table, success)
    lines_of_all_balls = lines[lines["ball"] == ALL_BALLS]
    ranking = lines_of_all_balls.sort_values("rate", ascending=False, kind="stable")
    best, *others = ranking.to_dict("records")
    return page.render(
        _TEMPLATE,
        experiment=experiment,
        folder=folder,
        ALL_BALLS=ALL_BALLS,
        best=best,
        has_others=bool(others),
        similar=[line["method"] for line in others if line["high"] >= best["low"]],
        success_panel=success_panel,
    )


SIMULATOR_NAME = "bounce-shot"
"""Name of the simulator in status.csv."""
_NULLABLE_NUMBERS = (
    "off",
    "margin",
    "planned_margin",
    "prediction_error",
    "drop_height",
    "restitution",
    "seconds",
)
"""Numeric columns of the shots that may be empty."""
_FAILED_STATUSES = ("crashed", "timeout")
"""Failures of the method and not of its plan, which make the command fail."""


def write_report(
    folder: Path,
    experiment: Experiment,
    settings: ShotConfig,
    setups: Sequence[ShotSetup],
    skipped_tuners: Mapping[str, str],
    print_line: Callable[[str], None],
) -> int:
    """Write tables, figures and HTML report from the shots that exist, and print a summary.

    Written are the tables table.csv, shots.csv and status.csv, the figures, the HTML page and an
    animation of one example. Without any shot nothing is written.

    Args:
        folder: result folder.
        experiment: the experiment, with the tuners that can be used here.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        setups: all planned shots.
        skipped_tuners: reasons why tuners cannot be used here, by label.
        print_line: prints a line.

    Returns:
        Number of methods and shots that crashed or exceeded their time.
    """
    shots = {setup.name: read_shot(folder, setup) for setup in setups}
    stored = {name: shot for name, shot in shots.items() if shot is not None}
    if not stored:
        print_line("no shot was made")
        return 0
    shot_rows = pd.DataFrame([row for shot in stored.values() for row in shot["rows"]])
    for name in _NULLABLE_NUMBERS:
        # A column whose cells are all empty has no numeric type.
        shot_rows[name] = pd.to_numeric(shot_rows[name])
    result_lines = add_trust_column(build_result_table(shot_rows), experiment)
    shot_rows = add_trust_column(shot_rows, experiment)
    statuses = add_trust_column(_build_status_rows(shot_rows, skipped_tuners), experiment)
    for name, frame in (("table", result_lines), ("shots", shot_rows), ("status", statuses)):
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False, float_format="%.6g"))
    pictures = draw_figures(experiment, settings, setups, stored, shot_rows, result_lines)
    files = figure_output.write_figures(folder, pictures)
    figures = [path for path in files if path.suffix == ".png"]
    write_atomically(
        folder / REPORT_FILE,
        render_page(experiment, str(folder), result_lines, shot_rows, pictures),
    )
    for example in select_example_shots(setups, stored, shot_rows)[:1]:
        figures.append(write_animation(folder, settings, example, stored, experiment.trusted))
    # Every new folder has an empty journal folder, which a bounce-shot study does not use.
    journal = folder / SEGMENTS_FOLDER
    if journal.is_dir() and not any(journal.iterdir()):
        journal.rmdir()
    failed = shot_rows[shot_rows["status"].isin(NO_SHOT_STATUSES)]
    for text_line in _render_summary(result_lines, failed, skipped_tuners, folder, figures):
        print_line(text_line)
    return int(failed["status"].isin(_FAILED_STATUSES).sum())


def _render_summary(
    result_lines: pd.DataFrame,
    failed: pd.DataFrame,
    skipped_tuners: Mapping[str, str],
    folder: Path,
    figures: Sequence[Path],
) -> list[str]:
    """Render the lines of the summary that the command prints: hits by method and ball.

    Args:
        result_lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.
        failed: rows of shots.csv of methods without a shot.
        skipped_tuners: reasons why tuners cannot be used here, by label.
        folder: result folder.
        figures: paths of the figures.
    """
    # Lines of the result table by method and ball.
    lines_by_method: dict[str, dict[str, Any]] = {}
    for line in result_lines.to_dict("records"):
        lines_by_method.setdefault(line["method"], {})[line["ball"]] = line
    return render_text(
        _SUMMARY_TEMPLATE,
        methods=lines_by_method,
        balls=[ball for ball in result_lines["ball"].unique() if ball != ALL_BALLS],
        ALL_BALLS=ALL_BALLS,
        width=max(map(len, lines_by_method)),
        skipped=skipped_tuners,
        failed=[(*key, part["reason"]) for key, part in failed.groupby(["method", "status"])],
        folder=folder,
        figures=figures,
        report_file=REPORT_FILE,
    )


def _build_status_rows(rows: pd.DataFrame, skipped: Mapping[str, str]) -> pd.DataFrame:
    """Build the rows of status.csv: one per method and shot, and one per tuner that was skipped.

    The columns are those of the status.csv of other studies, too. The seed is always 0, because a
    shot is planned once.

    Args:
        rows: rows of shots.csv.
        skipped: reasons why tuners cannot be used here, by label.
    """
    statuses = pd.DataFrame(
        {
            "run": rows["method"] + "/" + rows["shot"],
            "tuner": rows["method"],
            "simulator": SIMULATOR_NAME,
            "target": rows["shot"],
            "seed": 0,
            "status": rows["status"],
            "reason": rows["reason"],
            "simulations": rows["simulations"],
            "seconds": rows["seconds"],
        }
    )
    # Concatenating an empty frame would change the types of the columns.
    if not skipped:
        return statuses
    skipped_rows = [
        # In the order of `STATUS_COLUMN_NAMES`.
        (label, label, SIMULATOR_NAME, "", 0, "skipped", reason, 0, 0.0, False)
        for label, reason in skipped.items()
    ]
    return pd.concat([statuses, pd.DataFrame(skipped_rows, columns=STATUS_COLUMN_NAMES)])
