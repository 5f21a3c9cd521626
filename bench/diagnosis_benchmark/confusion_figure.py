"""Confusion matrices of cause families."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.diagnosis_benchmark.wrong_answers import is_correct, select_graded_answers
from bench.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FAMILY_LABELS = ("several", "unknown", "nothing", "no answer")
"""Answers that are not the name of a family; `nothing` means that the simulation is adequate."""
_PANELS_PER_ROW = 4
"""Maximum number of panels in a row."""
_MIN_LABELLED_PERCENT = 10.0
"""Minimum percentage of its row for which a cell shows its number."""


def draw_confusion_matrices(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw one confusion matrix of cause families for each diagnoser.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
        title: title of the figure.
    """
    graded_rows = select_graded_answers(rows[rows["kind"] != "double"])
    graded_rows = graded_rows.assign(
        family=_list_hidden_families(graded_rows), answer=_list_answer_families(graded_rows)
    )
    hidden = sorted(set(graded_rows["family"]), key=lambda name: (name in _LAST_ROW_LABELS, name))
    answer_labels = [name for name in hidden if name not in _LAST_ROW_LABELS]
    answer_labels += sorted(set(graded_rows["answer"]) - {*answer_labels, *_FAMILY_LABELS})
    answer_labels += [name for name in _FAMILY_LABELS if (graded_rows["answer"] == name).any()]
    column_count = min(_PANELS_PER_ROW, len(order))
    row_count = -(-len(order) // column_count)
    size = (
        1.6 + column_count * max(2.2, 0.16 * len(answer_labels)),
        1.4 + row_count * max(1.4, 0.17 * len(hidden)),
    )
    figure, axes = style.make_panel_grid(row_count, column_count, size, sharex=True, sharey=True)
    for panel_index, axis in enumerate(axes.flat):
        if panel_index >= len(order):
            axis.set_axis_off()
            continue
        diagnoser_rows = graded_rows[graded_rows["diagnoser"] == order[panel_index]]
        counts = pd.crosstab(diagnoser_rows["family"], diagnoser_rows["answer"]).reindex(
            index=hidden, columns=answer_labels, fill_value=0
        )
        _draw_confusion_matrix(axis, counts, order[panel_index])
    figure.suptitle(title, fontsize=11)
    figure.supylabel("hidden", fontsize=9)
    cases = graded_rows.drop_duplicates("question")
    style.add_caption(
        figure,
        f"{len(cases)} recordings with nothing hidden, one effect of at least one noise or a "
        "foreign cause. Per cent of a row. Black frames: right. A cause that is found alone or in "
        "a set of at most two counts as its family, otherwise the first named cause counts.",
        letters=16,
    )
    return figure


_LAST_ROW_LABELS = ("(foreign)", "(clean)")
"""Row labels that follow below those of the effect families."""
_CORRECT_ANSWERS = {"(clean)": ("nothing",), "(foreign)": ("unknown",)}
"""Correct answers for the rows of clean recordings and unmodelled causes."""


def _list_hidden_families(rows: pd.DataFrame) -> pd.Series[str]:
    """Return the row of the confusion matrix of each answer: the family of the hidden effect.

    The family is the part of the name before the dot. Clean recordings and unmodelled causes have
    the rows ``(clean)`` and ``(foreign)``.
    """
    family = rows["hidden"].astype(str).str.partition(".")[0]
    return family.where(rows["kind"] == "single", "(" + rows["kind"] + ")")


def _list_answer_families(rows: pd.DataFrame) -> list[str]:
    """Return the column of the confusion matrix of each answer.

    It is the family that the answer names, or one of `_FAMILY_LABELS`.

    Args:
        rows: one row per answer.
    """
    correct = is_correct(rows)
    return [
        _get_answer_family(row, is_right)
        for row, is_right in zip(rows.to_dict("records"), correct, strict=True)
    ]


def _get_answer_family(row: dict[Any, Any], is_right: bool) -> str:
    """Return the family that an answer names, or the label of an answer without a family.

    An answer that is correct because its small set contains the cause counts as the hidden family,
    otherwise the leading name counts.

    Args:
        row: row of the answer.
        is_right: whether the answer is correct.
    """
    if row["status"] != "done":
        return "no answer"
    if row["verdict"] == "adequate":
        return "nothing"
    if is_right and row["kind"] == "single":
        return str(row["hidden"]).partition(".")[0]
    if row["verdict"] in ("unknown", "unidentifiable") or (is_right and row["kind"] == "foreign"):
        return "unknown"
    named_effects = str(row["named"] or "")
    if not named_effects:
        return "unknown"
    return (
        "several" if " + " in named_effects else named_effects.partition("|")[0].partition(".")[0]
    )


def _draw_confusion_matrix(axis: Axes, counts: pd.DataFrame, name: str) -> None:
    """Draw the confusion matrix of one diagnoser in per cent; frames mark correct answers.

    Args:
        axis: axes to draw on.
        counts: number of answers, hidden families in rows and named families in columns.
        name: name of the diagnoser.
    """
    from matplotlib.patches import Rectangle

    totals = counts.sum(axis=1).to_numpy()
    shares = 100.0 * counts.to_numpy() / np.maximum(totals, 1)[:, None]
    axis.imshow(shares, cmap="Greys", vmin=0, vmax=100, aspect="auto")
    answer_labels = list(counts.columns)
    for i, family in enumerate(counts.index):
        for right_answer in _CORRECT_ANSWERS.get(family, (family,)):
            if right_answer in answer_labels:
                corner = answer_labels.index(right_answer) - 0.5, i - 0.5
                axis.add_patch(
                    Rectangle(corner, 1, 1, fill=False, edgecolor=style.NEUTRAL_MARK, linewidth=1.0)
                )
        for j, share in enumerate(shares[i]):
            if share >= _MIN_LABELLED_PERCENT:
                # White text on dark cells.
                ink = "white" if share > 55 else style.NEUTRAL_MARK
                axis.text(j, i, f"{share:.0f}", ha="center", va="center", fontsize=5.5, color=ink)
    axis.set_title(name, fontsize=9)
    axis.set_xticks(range(len(answer_labels)), answer_labels, rotation=90, fontsize=6.5)
    labels = [f"{family} {n}" for family, n in zip(counts.index, totals, strict=True)]
    axis.set_yticks(range(len(labels)), labels, fontsize=6.5)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
