"""Interface of an exam (questions, cases, targets), and the rows of its answers.

All exams have the same columns.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from tests.exams.marking import Mark


class UndrawableError(Exception):
    """A question has no case: no drawing shows the cause, or a model file is missing."""


class Question(ABC):
    """Specification of a case.

    Attributes:
        name: unique name; everything that is drawn follows from it and the seed.
        kind: kind of the case, for example clean, single or double.
        system: system or robot.
        effect: the hidden effect as far as the question states it.
    """

    name: str
    kind: str
    system: str
    effect: str

    @abstractmethod
    def draw(self, seed):
        """Return the `Case`.

        Raises:
            UndrawableError: there is none.
        """

    def restore(self, saved):
        """Return the `Case` of an earlier drawing, from the result of `Case.save`."""
        raise NotImplementedError


class Case(ABC):
    """A recording with a known cause."""

    def save(self):
        """Return a dictionary for `Question.restore`; empty if drawing is fast.

        Other versions then need not draw the case again.
        """
        return {}

    @abstractmethod
    def write(self, folder):
        """Write the files of a user into a folder, and return the path of the recording.

        No file reveals the cause.
        """

    @abstractmethod
    def describe(self):
        """Return the cells hidden, size, noise and conditions of the table of answers."""

    @abstractmethod
    def mark(self, outcome) -> Mark:
        """Grade the outcome of a call of `simgap explain`."""

    def answer(self, recording, out, call):
        """Explain the recording and return the `Outcome`."""
        return call(recording, out)


@dataclass(frozen=True)
class Target:
    """Share of good answers that `explain` must reach.

    Attributes:
        description: what counts, in words.
        kind: kind of the cases; None for all that hide a cause.
        level: strict, few, equivalent, fair or any.
        min_share: smallest share; None if only reported.
    """

    description: str
    kind: str | None
    level: str
    min_share: float | None = None


@dataclass(frozen=True)
class Exam:
    """Source of cases.

    Attributes:
        title, about: heading and introduction of the page.
        questions: function from the seed to all questions.
        targets: what `explain` must reach.
        quick: function that returns a few questions, or None.
        spread: function that returns each effect once, or None.
        groups: columns and conditions by which the page counts answers.
        cpu_limit: default limit of a call, processor seconds.
        needs_command: whether it calls the command, not the function.
        quick_share: smallest share of right answers in a quick exam.
    """

    title: str
    about: str
    questions: Callable
    targets: tuple[Target, ...] = ()
    quick: Callable | None = None
    spread: Callable | None = None
    groups: tuple[str, ...] = ("system", "effect", "noise")
    cpu_limit: float = 120.0
    needs_command: bool = False
    quick_share: float = 0.8


LEVELS = ("strict", "few", "equivalent", "fair", "any")
COLUMNS = (
    "item", "version", "kind", "system", "effect", "hidden", "size", "noise", "conditions",
    "verdict", "causes", "outcome", "members", *LEVELS, "intervals_held", "intervals", "ratios",
    "gap_closed", "heldout_base", "heldout_extended", "noise_floor", "cpu_s", "wall_s",
    "memory_mb", "message",
)  # fmt: skip
TEXT = (
    "item", "version", "kind", "system", "effect", "hidden", "noise", "conditions", "verdict",
    "causes", "outcome", "ratios", "message",
)  # fmt: skip
NOT_DRAWN = "not drawn"


def read_rows(path):
    """Return the rows of items.jsonl without an incomplete last line."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def cells(row):
    """Return the line of items.csv of a row."""
    start = {name: row[name] for name in ("item", "version", "kind", "system", "effect")}
    if row["case"] is None:
        return start | {"outcome": NOT_DRAWN, "message": row["message"]}
    mark, verdict = row["mark"], row["verdict"] or {}
    held_out = verdict.get("heldout") or {}
    held = [is_held for is_held in mark["covered"].values() if is_held is not None]
    ratios = mark["ratios"].items()
    lines = row["message"].strip().splitlines()
    return start | row["case"] | {
        "verdict": verdict.get("verdict", ""),
        **{name: mark[name] for name in ("causes", "outcome", "members", *LEVELS)},
        "intervals_held": sum(held), "intervals": len(held),
        "ratios": " ".join(f"{n}={'-' if r is None else f'{r:.3g}'}" for n, r in ratios),
        "gap_closed": number(held_out.get("gap_closed")),
        "heldout_base": number(held_out.get("rmse_base")),
        "heldout_extended": number(held_out.get("rmse_extended")),
        "noise_floor": number(held_out.get("noise_floor")),
        "cpu_s": number(row["cpu"]), "wall_s": number(row["wall"]),
        "memory_mb": number(row["memory"]),
        "message": mark["note"] or (lines[-1][:200] if lines else ""),
    }  # fmt: skip


def number(value):
    """Format a number with four digits; None becomes an empty cell."""
    return "" if value is None else f"{value:.4g}"


def hidden_text(effects):
    """Format coefficients by effect@place."""
    return " + ".join(f"{n}={','.join(f'{c:.4g}' for c in cs)}" for n, cs in effects.items())


def conditions_text(**conditions):
    """Format further properties of a case."""
    return "; ".join(f"{name}={value}" for name, value in conditions.items())


def write_table(path, rows):
    """Write items.csv and return it as a frame."""
    lines = sorted((cells(row) for row in rows), key=lambda c: (c["version"], c["item"]))
    pd.DataFrame(lines, columns=COLUMNS).to_csv(path, index=False)
    return read_table(path)


def read_table(path):
    """Return items.csv with a column for each condition."""
    table = pd.read_csv(path, dtype=dict.fromkeys(TEXT, str))
    table[[*TEXT]] = table[[*TEXT]].fillna("")
    for name in LEVELS:
        table[name] = table[name].fillna(False).astype(bool)
    pairs = table.conditions.map(
        lambda text: dict(part.split("=", 1) for part in text.split("; ") if part)
    )
    return table.join(pd.DataFrame(pairs.tolist(), index=table.index))
