"""Conventions of random logs: ``python -m tests.convention_exam [--count 120] [--seed 100] [--out
DIR]``.

As many logs with one convention broken as sound logs with a cause. One row a log is added to
``items.csv`` as it is checked, so that an interrupted test continues where it was;
``summary.csv`` has one row for each convention and for the sound logs.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from pathlib import Path

from tests.convention_exam.convention_logs import BROKEN, CAUSES, write_log

COLUMNS = ("log", "broken", "cause", "joints", "size", "found", "right", "evaluations", "cpu_s")


def main(arguments):
    parser = argparse.ArgumentParser(prog="python -m tests.convention_exam", description=__doc__)
    parser.add_argument("--count", type=int, default=120, help="logs of each kind")
    parser.add_argument("--seed", type=int, default=100, help="of the first log")
    parser.add_argument("--out", type=Path, default=Path("results/conventions"))
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "items.csv"
    rows = list(csv.DictReader(path.open())) if path.exists() else []
    known = {row["log"] for row in rows}
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not rows:
            writer.writeheader()
        for name, seed, broken, cause in _logs(given.seed, given.count):
            if name not in known:
                writer.writerow(_row(name, seed, broken, cause))
                file.flush()
    rows = list(csv.DictReader(path.open()))
    summary = list(_summary(rows))
    with (given.out / "summary.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ("convention", "logs", "right", "share", "median_cpu_s"))
        writer.writeheader()
        writer.writerows(summary)
    for row in summary:
        print(*row.values(), sep="  ")
    return 0


def _logs(seed, count):
    for number in range(seed, seed + count):
        yield f"broken-{number}", number, BROKEN[number % len(BROKEN)], "nothing"
    for number in range(seed, seed + count):
        yield f"sound-{number}", 10_000 + number, None, CAUSES[number % len(CAUSES)]


def _row(name, seed, broken, cause):
    from bench.diagnosis.conventions.convention_comparison import ConventionComparison
    from bench.diagnosis.conventions.unit_check import Subject
    from bench.logs.inspection import load_recording

    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", seed, broken, cause)
        recording, kind = load_recording(log.path)
        begun = time.process_time()
        comparison = ConventionComparison(Subject(kind, recording, None))
        differences = comparison.differences()
        seconds = time.process_time() - begun
    return {
        "log": name,
        "broken": broken or "",
        "cause": cause,
        "joints": " ".join(map(str, log.joints)),
        "size": f"{log.size:.4g}",
        "found": "; ".join(one.description for one in differences),
        "right": "yes" if is_right(log, differences) else "no",
        "evaluations": comparison.evaluations,
        "cpu_s": f"{seconds:.2f}",
    }


def is_right(log, differences):
    """Return whether the answer to a log is right.

    The broken convention must be first or among the equally likely ones, with its joints and
    offset. For a correct log there must be no answer.
    """
    if log.broken is None:
        return not differences
    if len(differences) != 1:
        return False
    (first,) = differences
    return any(_matches(log, one) for one in (first.hypothesis, *first.alternatives))


def _matches(log, hypothesis):
    words = {
        "sign of position": "the sign of q.",
        "sign of command": "the sign of u.",
        "sign of both": "the axis of joint",
        "zero of position": "position q.",
        "zero of both": "counted from another zero",
        "unit of one": "look like",
        "unit of all": "look like",
        "exchanged positions": "the channels of",
        "exchanged commands": "the commands of",
        "exchanged both": "the channels and commands of",
        "wrapped": "wrapped",
        "late commands": "stamped",
    }
    if words[log.broken] not in hypothesis.description:
        return False
    if log.broken == "late commands":
        return abs(hypothesis.late - log.size) < 1e-6
    concerned = {int(name.partition(".")[2][1:]) for name in hypothesis.changes}
    if concerned != set(log.joints):
        return False
    if log.broken.startswith("zero"):
        offsets = [change.offset for change in hypothesis.changes.values()]
        turns = [
            abs((offset + log.size + 3.14159265) % 6.2831853 - 3.14159265) for offset in offsets
        ]
        return max(turns) < 0.05
    return True


def _summary(rows):
    groups = {broken: [r for r in rows if r["broken"] == broken] for broken in BROKEN}
    groups["all broken"] = [row for row in rows if row["broken"]]
    groups["sound"] = [row for row in rows if not row["broken"]]
    for name, own in groups.items():
        right = sum(row["right"] == "yes" for row in own)
        seconds = sorted(float(row["cpu_s"]) for row in own)
        yield {
            "convention": name,
            "logs": len(own),
            "right": right,
            "share": f"{right / max(len(own), 1):.3f}",
            "median_cpu_s": f"{seconds[len(seconds) // 2]:.2f}" if seconds else "",
        }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
