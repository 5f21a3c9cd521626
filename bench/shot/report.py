"""Write the tables, figures and HTML report of a bounce-shot study and print a summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

import pandas as pd

from bench.analysis.marks import marked
from bench.figures import style
from bench.problem.experiment import Experiment
from bench.report import REPORT
from bench.shot.animation import animate
from bench.shot.deal import Deal
from bench.shot.kept import read
from bench.shot.page import shot_page
from bench.shot.pictures import draw, examples
from bench.shot.settings import Settings
from bench.shot.table import NO_SHOT, table, text
from bench.store.segments import FOLDER
from bench.store.status import STATUS_COLUMNS
from sims.files import write

SIMULATOR = "bounce-shot"
"""Name of the simulator in status.csv."""
_NUMBERS = (
    "off",
    "margin",
    "planned_margin",
    "prediction_error",
    "drop_height",
    "restitution",
    "seconds",
)
"""Numeric columns of the shots that may be empty."""
_FAILED = ("crashed", "timeout")
"""Failures of the method and not of its plan, which make the command fail."""


class Shots(Protocol):
    """Protocol of the studies that can be reported.

    Attributes:
        folder: result folder.
    """

    folder: Path

    @property
    def experiment(self) -> Experiment:
        """The experiment, with the tuners that can be used here."""

    @property
    def settings(self) -> Settings:
        """The [shot] table."""

    @property
    def deals(self) -> list[Deal]:
        """All planned shots."""

    @property
    def skipped(self) -> Mapping[str, str]:
        """Reasons why tuners cannot be used here, by label."""


def finish(study: Shots, say: Callable[[str], None]) -> int:
    """Write tables, figures and HTML report from the shots that exist.

    Args:
        study: the study to report.
        say: prints a line.

    Returns:
        Number of methods and shots that crashed or exceeded their time.
    """
    folder = study.folder
    kept = {}
    for one in study.deals:
        if (shot := read(folder, one)) is not None:
            kept[one.name] = shot
    if not kept:
        say("no shot was made")
        return 0
    rows = pd.DataFrame([row for shot in kept.values() for row in shot["rows"]])
    for name in _NUMBERS:
        # A column that is empty has no numeric type.
        rows[name] = pd.to_numeric(rows[name])
    lines = marked(table(rows), study.experiment)
    rows = marked(rows, study.experiment)
    statuses = marked(_statuses(rows, study.skipped), study.experiment)
    for name, frame in (("table", lines), ("shots", rows), ("status", statuses)):
        write(folder / f"{name}.csv", frame.to_csv(index=False, float_format="%.6g"))
    pictures = draw(study.experiment, study.settings, study.deals, kept, rows, lines)
    figures = [
        style.keep(folder / "figures" / name, picture.png, picture.pdf)[0]
        for name, picture in pictures.items()
    ]
    write(folder / REPORT, shot_page(study.experiment, str(folder), lines, rows, pictures))
    for example in examples(study.deals, kept, rows)[:1]:
        figures.append(animate(folder, study.settings, example, kept, study.experiment.trusted))
    # Every new folder has an empty journal folder, which a bounce-shot study does not use.
    journal = folder / FOLDER
    if journal.is_dir() and not any(journal.iterdir()):
        journal.rmdir()
    say("\n" + text(lines))
    failed = rows[rows["status"].isin(NO_SHOT)]
    _say_faults(failed, study.skipped, say)
    say(f"\ntable   {folder / 'table.csv'}\nshots   {folder / 'shots.csv'}")
    for figure in figures:
        say(f"figure  {figure}")
    say(f"report  {folder / REPORT}")
    return int(failed["status"].isin(_FAILED).sum())


def _say_faults(
    failed: pd.DataFrame, skipped: Mapping[str, str], say: Callable[[str], None]
) -> None:
    for label, reason in skipped.items():
        say(f"skipped {label}: {reason}")
    for (method, status), part in failed.groupby(["method", "status"]):
        say(f"{status}: {method} in {len(part)} shots; {part['reason'].iloc[0]}")


def _statuses(rows: pd.DataFrame, skipped: Mapping[str, str]) -> pd.DataFrame:
    """Build the rows of status.csv: one per method and shot, and one per tuner that was skipped."""
    made = pd.DataFrame(
        {
            "run": rows["method"] + "/" + rows["shot"],
            "tuner": rows["method"],
            "simulator": SIMULATOR,
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
        return made
    left = [
        (label, label, SIMULATOR, "", 0, "skipped", reason, 0, 0.0, False)
        for label, reason in skipped.items()
    ]
    return pd.concat([made, pd.DataFrame(left, columns=STATUS_COLUMNS)])
