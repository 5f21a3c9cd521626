"""The exam of `simgap explain`.

``python -m tests.simple_exam [--quick] [--out DIR] [--jobs 2] [--only KIND/SYSTEM]``.

Recordings of independent simulators, in each a hidden cause or none; every answer is marked. One
row a question is added to items.jsonl as it is answered, so that an exam that was interrupted goes
on where it was; tables and figures are made from it at the end. ``--fresh`` asks everything again
(what was drawn by the same code is kept); what another code or seed drew is asked again in any
case.
"""

import argparse
import json
import multiprocessing
import os
import sys
from concurrent.futures import as_completed
from pathlib import Path

from sims.engines.compiled import kernel
from tests.simple_exam import exam_answers, exam_questions, exam_report

LIMIT = 600  # Maximum seconds to draw, record, explain and grade one case.
ALONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main(arguments):
    given = _parser().parse_args(arguments)
    folder = given.out or Path("results/exam-quick" if given.quick else "results/reference/exam")
    folder.mkdir(parents=True, exist_ok=True)
    asked = [
        q
        for q in (
            exam_questions.quick() if given.quick else exam_questions.sheet(given.seed_offset)
        )
        if _chosen(q, given)
    ]
    drawn = [exam_questions.digest(), given.seed_offset]
    rows = {
        name: row
        for name, row in _before(folder / "items.jsonl").items()
        if row.get("drawn") == drawn
    }
    known = {name: row["item"] for name, row in rows.items() if row["item"] or not row.get("mark")}
    again = {q.name for q in asked if given.fresh or (given.again and _amiss(rows.get(q.name)))}
    rows = {name: row for name, row in rows.items() if name not in again}
    (folder / "items.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows.values()))
    _ask([q for q in asked if q.name not in rows], folder / "items.jsonl", known, drawn, given)
    rows = _before(folder / "items.jsonl")
    summary = exam_report.write(folder, list(rows.values()))
    print(exam_report.printed(summary))
    return int(given.quick and not exam_report.passes(summary))


def _parser():
    parser = argparse.ArgumentParser(prog="python -m tests.simple_exam", description=__doc__)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a few of every kind; fails unless nearly all are right",
    )
    parser.add_argument("--out", type=Path, help="results/reference/exam, or results/exam-quick")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="KIND, KIND/SYSTEM or KIND/SYSTEM/EFFECT")
    parser.add_argument("--seed-offset", type=int, default=0, help="another exam of the same form")
    parser.add_argument("--fresh", action="store_true", help="answer everything again")
    parser.add_argument(
        "--again", action="store_true", help="answer again what was not answered rightly"
    )
    parser.add_argument(
        "--explain", default=exam_answers.EXPLAIN, help="MODULE:FUNCTION to examine"
    )
    return parser


def _chosen(question, given):
    return f"{question.kind}/{question.system}/{question.effect or 'any'}/".startswith(
        given.only.rstrip("/") + "/" * bool(given.only)
    )


def _amiss(row):
    return bool(row and row.get("mark")) and not row["mark"]["found"]


def _before(path):
    """Return rows by question; incomplete lines are ignored."""
    rows = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        rows[row["question"]] = row
    return rows


def _ask(asked, path, known, drawn, given):
    from pebble import ProcessPool
    from tqdm import tqdm

    for name in ALONE:
        os.environ[name] = "1"
    kernel.get_kernel()  # Compile now, so that the time does not count for a question.
    context = multiprocessing.get_context("spawn")
    with ProcessPool(max_workers=given.jobs, context=context) as pool, path.open("a") as file:
        running = {
            pool.schedule(
                exam_answers.answered,
                [q.json(), given.seed_offset, known.get(q.name), given.explain],
                timeout=LIMIT,
            ): q
            for q in asked
        }
        try:
            for future in tqdm(as_completed(running), total=len(running), smoothing=0.05):
                question = running[future]
                try:
                    row = future.result()
                except (
                    Exception
                ) as error:  # A worker that was killed or timed out costs one question only.
                    row = exam_answers.lost(
                        question, known.get(question.name), f"{type(error).__name__}: {error}"
                    )
                file.write(json.dumps(row | {"drawn": drawn}) + "\n")
                file.flush()
        except BaseException:
            pool.stop()
            raise


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
