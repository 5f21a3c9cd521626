"""Examine one case: draw it, write its recording, explain it, grade the answer."""

from __future__ import annotations

import shutil
import warnings

from tests.planted_causes import planted_recording, run_explain
from tests.planted_causes.equivalent_causes import held_out_ratios
from tests.planted_causes.planted_items import UndrawableItemError, draw
from tests.planted_causes.planted_marking import mark


def examine(question, simgap, folder, cpu_limit=run_explain.CPU_LIMIT):
    """Return a row of items.jsonl.

    Args:
        question: specification of the case.
        simgap: path of the examined command.
        folder: parent of the folder for the recording and the answer.
        cpu_limit: processor seconds of the call.
    """
    row = {"item": question.name, "robot": question.robot, "kind": question.kind}
    try:
        with warnings.catch_warnings():
            # MuJoCo warns about deprecated attributes in old files.
            warnings.simplefilter("ignore")
            item = draw(question)
            place = folder / question.name.replace("/", "-")
            table = planted_recording.write(item, place / "recording")
    except UndrawableItemError as error:
        return row | {"drawn": None, "message": str(error)}
    shutil.rmtree(place / "answer", ignore_errors=True)
    outcome = run_explain.explain(simgap, table, place / "answer", cpu_limit)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        marked = mark(
            item.change.effect,
            item.size,
            outcome.verdict,
            lambda names: held_out_ratios(item, names),
        )
    row |= {"drawn": item.json(), "digest": planted_recording.digest(table.parent)}
    return row | {"mark": marked.json()} | outcome.json()
