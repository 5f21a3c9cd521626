"""Causes hidden in robots that float.

``python -m tests.robot_exam.floating_base --out DIR [--only TEXT]``.

One row a question is added to items.jsonl as it is answered; what is there is not asked again.
A table of the answers, items.csv, is made from it at the end.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

from tests.robot_exam import robot_exam_report
from tests.robot_exam.floating_base import floating_items
from tests.robot_exam.robot_exam_score import marked
from tests.simple_exam.explain_items import explained

GOOD = {"single": ("right", "set"), "clean": ("right",), "foreign": ("right",)}


def main(arguments=None):
    parser = argparse.ArgumentParser(
        prog="python -m tests.robot_exam.floating_base", description=__doc__
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", default="", help="questions whose names hold this")
    parser.add_argument("--part", type=int, default=0, help="of how many, asked in this process")
    parser.add_argument("--parts", type=int, default=1)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "items.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    known = {row["question"] for row in rows}
    for question in floating_items.questions()[given.part :: given.parts]:
        name = "/".join(map(str, question))
        if name in known or given.only not in name:
            continue
        rows.append({"question": name} | answered(*question))
        with path.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(name, rows[-1]["mark"] or "does not show", flush=True)
    robot_exam_report.listed(given.out / "items.csv", [row for row in rows if row["mark"]])
    print(table(rows))
    return 0


def answered(kind, robot, effect, index):
    """Return the result row of a question: case, verdict and grade."""
    found = floating_items.drawn(kind, robot, effect, index)
    row = {"kind": kind, "robot": robot, "effect": effect, "item": None, "mark": None}
    if found is None:
        return row
    item, made = found
    row |= explained(lambda folder: floating_items.written(item, made, folder))
    return row | {"item": item.json(), "mark": marked(item, row["verdict"]).json()}


def table(rows):
    """Return right answers among the visible cases, by robot and kind."""
    counted, right, outcomes = Counter(), Counter(), Counter()
    for row in (row for row in rows if row["mark"]):
        key, outcome = (row["robot"], row["kind"]), row["mark"]["outcome"]
        counted[key] += 1
        right[key] += outcome in GOOD[row["kind"]]
        outcomes[row["kind"], outcome] += 1
    lines = [f"{robot:16} {kind:8} {right[robot, kind]} of {n}"
             for (robot, kind), n in sorted(counted.items())]  # fmt: skip
    return "\n".join([*lines, ", ".join(f"{k} {o}: {n}" for (k, o), n in sorted(outcomes.items()))])


if __name__ == "__main__":
    sys.exit(main())
