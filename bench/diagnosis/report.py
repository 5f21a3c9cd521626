"""Write the tables, figures and HTML report of a comparison of diagnosers and print a summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import pandas as pd

from bench.diagnosis import figures
from bench.diagnosis.confusion import families
from bench.diagnosis.failures import failures
from bench.diagnosis.kept import Answered
from bench.diagnosis.lessons import read_lessons
from bench.diagnosis.page.conclusion import cannot
from bench.diagnosis.page.page import diagnosis_page
from bench.diagnosis.page.shown import Shown
from bench.diagnosis.rows import SKIPPED, rows_of
from bench.diagnosis.sheet import Question
from bench.diagnosis.tables import NAMED, all_tables, by_diagnoser, complete, singles
from bench.figures.style import Pictures, keep, mark, taken
from bench.problem.experiment import Experiment
from bench.report import REPORT
from bench.store.folder import Configuration
from sims.files import write

ITEMS = "items.csv"
"""File with one row per answer."""


class Asked(Protocol):
    """Protocol of the studies that can be reported; see `bench.diagnosis.study.DiagnosisStudy`."""

    folder: Path
    configuration: Configuration

    @property
    def answered(self) -> Answered:
        """All stored answers."""

    @property
    def questions(self) -> list[Question]:
        """All cases of the experiment."""

    @property
    def usable(self) -> list[str]:
        """Names of the diagnosers that can be used here."""

    @property
    def skipped(self) -> dict[str, str]:
        """Diagnosers that cannot be used here, with the reason."""


def finish(study: Asked, say: Callable[[str], None]) -> int:
    """Write tables, figures and HTML report from the answers that exist.

    Only cases that every diagnoser has answered are reported.

    Args:
        study: the study to report.
        say: prints one line.

    Returns:
        Number of failed answers.
    """
    for name, reason in study.skipped.items():
        say(f"skipped: {name}: {reason}")
    order = study.usable
    whole = rows_of(study.answered, order)
    if whole.empty:
        say("no answers yet")
        return 0
    rows = complete(whole, order)
    if rows.empty:
        say("no question has been put to every diagnoser yet")
        return 0
    training = read_lessons(study.folder)
    write(study.folder / ITEMS, csv(rows))
    left_out = rows[rows["status"] == SKIPPED]
    rows = rows[rows["status"] != SKIPPED]
    tables = all_tables(rows, order, training)
    for name, frame in {**tables, "failures": failures(rows, order)}.items():
        write(study.folder / f"{name}.csv", csv(frame))
    pictures = draw(study.configuration.experiment, rows, tables, order)
    for name, picture in pictures.items():
        keep(study.folder / "figures" / name, picture.png, picture.pdf)
    shown = Shown(
        study.configuration.experiment,
        str(study.folder),
        order,
        rows,
        tables,
        training,
        pictures,
        study.skipped,
        len(study.questions),
        left_out,
    )
    write(study.folder / REPORT, diagnosis_page(shown))
    for line in text(tables, order):
        say(line)
    for name, reason, count in cannot(left_out):
        say(f"{name} cannot be asked {count} of these: {reason}")
    asked, planned = rows["question"].nunique(), len(study.questions)
    hopeless = sum(not one["item"] for one in study.answered.values())
    say(f"{asked} questions of {planned}; of {hopeless} the sensors cannot show what is hidden")
    say(f"written: {study.folder}/ with {ITEMS}, {', '.join(f'{n}.csv' for n in tables)}")
    say(f"figures: {', '.join(f'{name}.png' for name in sorted(pictures))}")
    say(f"report: {study.folder / REPORT}")
    failed = rows[rows["status"] != "done"]
    for _, row in failed.head(_FEW).iterrows():
        say(f"{row['status']}: {row['diagnoser']} on {row['question']}: {row['reason']}")
    if len(failed) > _FEW:
        say(f"({len(failed)} answers failed; see {ITEMS})")
    return len(failed)


_FEW = 5
"""Maximum number of failed answers that are printed."""


def csv(frame: pd.DataFrame) -> str:
    """Format a table as CSV text."""
    text: str = frame.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return text


def draw(
    experiment: Experiment,
    rows: pd.DataFrame,
    tables: Mapping[str, pd.DataFrame],
    order: Sequence[str],
) -> dict[str, Pictures]:
    """Draw every figure for which there is data.

    Args:
        experiment: the experiment, for the title.
        rows: one row per answer.
        tables: tables by name.
        order: names of the diagnosers, in the order of their colours.

    Returns:
        Figures by name.
    """
    title = experiment.title or experiment.name
    made = {}
    counted = (by_diagnoser(tables["table"], what) for what in ("false alarms", "named, alone"))
    if all(any(line["of"] for line in lines.values()) for lines in counted):
        made["board"] = figures.board(tables["table"], order, title)
        made["outcomes"] = figures.outcomes(singles(rows), order, title)
        made["confusion"] = families(rows, order, title)
        made["cost"] = figures.cost(tables["costs"], tables["table"], order, title)
    if not tables["power"].empty:
        made["power"] = figures.power(tables["power"], order, title)
    if not tables["calibration"].empty:
        made["calibration"] = figures.calibration(tables["calibration"], order, title)
    return {name: taken(mark(figure, experiment.trusted)) for name, figure in made.items()}


def text(tables: Mapping[str, pd.DataFrame], order: Sequence[str]) -> list[str]:
    """Format the leaderboard as aligned text lines.

    Args:
        tables: tables by name.
        order: names of the diagnosers.

    Returns:
        A header line and one line per diagnoser with its false alarms, diagnosed single causes,
        pairs, unmodelled causes and median cost.
    """
    columns = (
        ("false alarms", "false alarms"),
        ("named, alone", "named alone"),
        (NAMED, "in a set of 2"),
        ("pairs: both named", "both of two"),
        ("foreign causes: unknown or partial", "foreign"),
    )
    held = {metric: by_diagnoser(tables["table"], metric) for metric, _ in columns}
    costs = by_diagnoser(tables["costs"])
    head = ["diagnoser", *(says for _, says in columns), "simulations", "seconds"]
    lines = [head]
    for name in order:
        cells = [name]
        for metric, _ in columns:
            line = held[metric][name]
            ends = f"{100 * line['low']:.0f}-{100 * line['high']:.0f}"
            cells.append(f"{100 * line['share']:.0f} % ({ends})" if line["of"] else "-")
        cost = costs[name]
        cells += [f"{cost['simulations_median']:.0f}", f"{cost['processor_seconds_median']:.2f}"]
        lines.append(cells)
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    padded = [[c.ljust(w) for c, w in zip(line, widths, strict=True)] for line in lines]
    return ["  ".join(cells).rstrip() for cells in padded]
