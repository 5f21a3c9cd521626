"""Answer one question in a worker: draw the case, write and explain its recording, grade it."""

from __future__ import annotations

from dataclasses import replace

from bench.benchmark.runner.code_digest import EXPLAIN_SOURCE_FOLDERS, hash_source_folders
from tests.robot_exam.equivalent_effects import Rivals
from tests.robot_exam.exam_recording import realise, recorded
from tests.robot_exam.robot_exam_score import Mark, marked, sets_of
from tests.robot_exam.robot_items import Item, setting_of
from tests.robot_exam.robot_questions import Question
from tests.simple_exam.explain_items import EXPLAIN, explained

MOST_RIVALS = 6


def answered(question, offset, known=None, explain=EXPLAIN, equal=True):
    """Return the result row of a question: case, verdict and grade.

    Args:
        question: question as JSON.
        offset: offset of the seeds.
        known: case as JSON if it was drawn before, {} if no drawing is visible, None if it was not
            drawn.
        explain: module:function to examine.
        equal: whether the members of a set are refitted.
    """
    asked = Question(**question)
    item = asked.drawn(offset) if known is None else Item.of(known) if known else None
    row = {"question": asked.name, "kind": asked.kind, "robot": asked.robot}
    row |= {"effect": asked.effect, "item": item.json() if item else {}}
    return row if item is None else row | _answer(item, explain, equal)


def _answer(item, explain, equal):
    row = explained(lambda folder: realise(item, folder), explain)
    mark = marked(item, row["verdict"])
    if equal and mark.outcome == "set":
        mark = replace(mark, equal=_equal(item, row["verdict"]))
    return row | {"mark": mark.json(), "code": hash_source_folders(EXPLAIN_SOURCE_FOLDERS)}


def _equal(item, verdict):
    """Return held-out error ratios of the other members of the sets that hold the truth."""
    rivals = Rivals(setting_of(item.name), item.effects, recorded(item))
    ratios = {}
    truth = set(item.effects)
    for names in sets_of(verdict):
        beside = truth - set(names) if not item.family else ()
        for name in [n for n in names if n not in truth][:MOST_RIVALS]:
            ratios[name] = rivals.ratio(name, beside)
    return ratios


def lost(question, known, error):
    """Return the row of a question whose worker failed."""
    asked = question.json()
    row = {name: asked[name] for name in ("kind", "robot", "effect")}
    row |= {"question": question.name, "item": known or {}, "verdict": None, "seconds": None}
    return row | {"processor": None, "error": error, "mark": Mark("failed").json()}
