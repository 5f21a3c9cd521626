"""Run an exam: answer its questions in worker processes, and write rows as they are answered.

An interrupted exam continues where it was. Several versions may share a folder; a question is
answered once by each version.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import tempfile
import warnings
from concurrent.futures import as_completed
from fnmatch import fnmatch
from pathlib import Path

from tests.exams.exam import UndrawableError, read_rows
from tests.exams.explain_calls import (
    ONE_THREAD,
    WALL_FACTOR,
    Outcome,
    end_commands_when_terminated,
)
from tests.exams.marking import Mark


def select_questions(exam, only="", count=None, quick=False, spread=False, seed=0):
    """Return the chosen questions in an order in which every first N are a fair sample.

    Args:
        exam: `tests.exams.exam.Exam`.
        only: pattern of names with * and ?, or their beginning.
        count: number of questions.
        quick: whether to choose from the quick questions.
        spread: whether to choose from each effect once.
        seed: another exam of the same form.
    """
    choose = exam.quick if quick else exam.spread if spread else lambda: exam.questions(seed)
    if choose is None:
        raise ValueError("this exam has no such selection; expected another one or none")
    questions = sorted(choose(), key=lambda q: hashlib.sha256(q.name.encode()).digest())
    pattern = only.rstrip("/")
    return [
        question
        for question in questions
        if not pattern or any(fnmatch(question.name, p) for p in (only, pattern, f"{pattern}/*"))
    ][:count]


def run_exam(questions, folder, call, version, seed=0, jobs=2, fresh=False, again=False, keep=None):
    """Answer the questions that this version has not answered, and return all rows.

    Args:
        questions: questions to answer.
        folder: folder of items.jsonl.
        call: `ExplainCall`.
        version: name of the examined version.
        seed: seed of the cases.
        jobs: number of worker processes.
        fresh: whether to answer again what this version has answered.
        again: whether to answer again what was not answered well.
        keep: folder for recordings and answers; None to delete them.
    """
    from pebble import ProcessPool
    from tqdm import tqdm

    path, names = folder / "items.jsonl", {question.name for question in questions}

    def is_kept(row):
        own = row["version"] == version and row["item"] in names
        is_poor = row["case"] is not None and not row["mark"]["equivalent"]
        return not own or not (fresh or (again and is_poor))

    rows = read_rows(path)
    saved = list_saved(rows, seed)
    rows = [row for row in rows if is_kept(row)]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    answered = {row["item"] for row in rows if row["version"] == version}
    os.environ.update(ONE_THREAD)
    work = Path(keep or tempfile.mkdtemp(prefix="exam-")).absolute()
    context = multiprocessing.get_context("spawn")
    pool = ProcessPool(jobs, context=context, initializer=end_commands_when_terminated)
    with pool, path.open("a") as file:
        futures = {
            pool.schedule(
                answer_question,
                [q, seed, call, work, saved.get(q.name)],
                timeout=WALL_FACTOR * call.cpu_limit,
            ): q
            for q in questions
            if q.name not in answered
        }
        try:
            for future in tqdm(as_completed(futures), total=len(futures), disable=None):
                row = _row_of(future, futures[future]) | {"version": version}
                file.write(json.dumps(row) + "\n")
                file.flush()
        except BaseException:
            pool.stop()
            raise
        finally:
            if keep is None:
                shutil.rmtree(work, ignore_errors=True)
    return [row for row in read_rows(path) if row["item"] in names]


def list_saved(rows, seed):
    """Return the cases that a version has drawn with a seed, by question.

    Drawing a case may take as long as answering it, so it is done once for all versions.
    """
    drawn = [(row["item"], row["saved"]) for row in rows if row.get("saved")]
    return {item: saved for item, saved in drawn if saved["seed"] == seed}


def _row_of(future, question):
    try:
        return future.result()
    except Exception as error:  # A worker that was killed or timed out costs one question only.
        outcome = Outcome(None, None, output=f"{type(error).__name__}: {error}")
        return _identity(question) | outcome.to_json() | {
            "case": {}, "digest": "", "mark": Mark("failed").to_json()
        }  # fmt: skip


def _identity(question):
    names = {"item": question.name, "kind": question.kind}
    return names | {"system": question.system, "effect": question.effect}


def answer_question(question, seed, call, work, saved=None):
    """Draw the case, write and explain its recording, grade the answer, and return the row.

    Args:
        question: the question.
        seed: seed of the case.
        call: `ExplainCall`.
        work: folder for recordings and answers.
        saved: seed and case of an earlier drawing, which is used; None to draw.
    """
    row = _identity(question)
    place = work / question.name.replace("/", "-").replace(" ", "-")
    shutil.rmtree(place, ignore_errors=True)
    (place / "recording").mkdir(parents=True)
    with warnings.catch_warnings():
        # MuJoCo warns about deprecated attributes in old model files.
        warnings.simplefilter("ignore")
        try:
            case = question.restore(saved["case"]) if saved else question.draw(seed)
            recording = case.write(place / "recording")
        except UndrawableError as error:
            return row | {"case": None, "message": str(error)}
        outcome = case.answer(recording, place / "answer", call)
        mark = case.mark(outcome)
    row |= {"case": case.describe(), "digest": digest(place / "recording")}
    if fields := case.save():
        row |= {"saved": {"seed": seed, "case": fields}}
    return row | {"mark": mark.to_json()} | outcome.to_json()


def digest(folder):
    """Return a SHA-256 hash of all files of a recording; equal hashes mean equal cases."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]
