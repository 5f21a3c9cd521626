"""Causes hidden in robots: ``python -m tests.robot_exam [--out DIR] [--jobs 2] [--only
KIND/ROBOT-DRIVE/EFFECT] [--spread]``.

Recordings of independent worlds, in each a hidden cause or none; every answer is marked. One row a
question is added to items.jsonl as it is answered, so that what was interrupted goes on where it
was, also where it was published (``--out results/reference/robots``), each with a hash of the code
that answered; tables and figures are made from it at the end. ``--fresh`` asks everything again
(what was drawn by the same code is kept).
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import sys
from concurrent.futures import as_completed
from fnmatch import fnmatch
from pathlib import Path

from tests.robot_exam import robot_answers, robot_exam_report, robot_questions
from tests.simple_exam.__main__ import ALONE, _before

LIMIT = 900  # Maximum seconds to draw, record, explain and grade one question.


def main(arguments):
    given = _parser().parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    path, drawn = given.out / "items.jsonl", [robot_questions.digest(), given.seed_offset]
    sheet = robot_questions.quick() if given.quick else robot_questions.sheet()
    sheet = robot_questions.spread() if given.spread else sheet
    # Sort by hash, so that the questions answered first are a fair sample.
    sheet = sorted(sheet, key=lambda q: hashlib.sha256(q.name.encode()).digest())
    asked = [q for q in sheet if not given.only or fnmatch(q.name, f"{given.only}*")]
    rows = {name: row for name, row in _before(path).items() if row.get("drawn") == drawn}
    known = {name: row["item"] for name, row in rows.items() if row["item"] or not row.get("mark")}
    if given.fresh:
        rows = {name: row for name, row in rows.items() if name not in {q.name for q in asked}}
    path.write_text("".join(json.dumps(row) + "\n" for row in rows.values()))
    _ask([q for q in asked if q.name not in rows], path, known, drawn, given)
    summary = robot_exam_report.write(given.out, list(_before(path).values()))
    print(robot_exam_report.printed(summary))
    return 0


def _parser():
    parser = argparse.ArgumentParser(prog="python -m tests.robot_exam", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="six questions about two robots")
    parser.add_argument("--spread", action="store_true", help="each effect once, robots in turn")
    parser.add_argument("--out", type=Path, default=Path("results/robots"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--limit", type=int, default=LIMIT, help="seconds for one question")
    parser.add_argument("--only", default="", help="KIND/ROBOT-DRIVE/EFFECT, with * and ?")
    parser.add_argument("--seed-offset", type=int, default=0, help="others of the same form")
    parser.add_argument("--fresh", action="store_true", help="answer everything again")
    parser.add_argument(
        "--explain", default=robot_answers.EXPLAIN, help="MODULE:FUNCTION to examine"
    )
    return parser


def _ask(asked, path, known, drawn, given):
    from pebble import ProcessPool
    from tqdm import tqdm

    for name in ALONE:
        os.environ[name] = "1"
    context = multiprocessing.get_context("spawn")
    with ProcessPool(max_workers=given.jobs, context=context) as pool, path.open("a") as file:
        running = {
            pool.schedule(
                robot_answers.answered,
                [q.json(), given.seed_offset, known.get(q.name), given.explain],
                timeout=given.limit,
            ): q
            for q in asked
        }
        try:
            for future in tqdm(as_completed(running), total=len(running), smoothing=0.05):
                file.write(json.dumps(_row(future, running[future], known) | {"drawn": drawn}))
                file.write("\n")
                file.flush()
        except BaseException:
            pool.stop()
            raise


def _row(future, question, known):
    try:
        return future.result()
    except Exception as error:  # A worker that was killed or timed out costs one question only.
        return robot_answers.lost(
            question, known.get(question.name), f"{type(error).__name__}: {error}"
        )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
