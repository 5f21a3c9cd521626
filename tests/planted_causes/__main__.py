"""The planted-cause test of `simgap explain` on model files of installed packages.

``python -m tests.planted_causes [--simgap PATH] [--out DIR] [--count N] [--only ROBOT/KIND] [--jobs
N]``

One number of a robot's file is changed at a random place, plain MuJoCo makes three runs of three
seconds, and the public command explains them with the unchanged file. Each answer is added to
items.jsonl of the output folder, so that an interrupted test continues where it was. Several
versions may share a folder; tables at the end compare them.
"""

import json
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from fnmatch import fnmatch
from pathlib import Path

from tests.planted_causes import planted_report, run_explain
from tests.planted_causes.examine_items import examine
from tests.planted_causes.planted_items import sheet
from tests.planted_causes.planted_robots import ROBOTS, MissingModelError


def main(arguments):
    given = _parser().parse_args(arguments)
    if not given.simgap.is_file():
        print(f"{given.simgap}: no such command; expected bin/simgap of an installation (--simgap)")
        return 2
    given.out.mkdir(parents=True, exist_ok=True)
    version = given.version or run_explain.version_of(given.simgap)
    path = given.out / "items.jsonl"
    questions = [q for q in sheet() if _is_chosen(q.name, given.only)][: given.count]
    if not questions:
        print(f"--only {given.only}: no such item; robots are {', '.join(ROBOTS)}")
        return 2
    questions = _available(questions)
    rows = read_rows(path)
    answered = set() if given.fresh else {r["item"] for r in rows if r["version"] == version}
    kept = [r for r in rows if r["version"] != version or r["item"] in answered]
    path.write_text("".join(json.dumps(row) + "\n" for row in kept))
    _examine([q for q in questions if q.name not in answered], version, path, given)
    names = {q.name for q in questions}
    rows = [row for row in read_rows(path) if row["item"] in names]
    planted_report.write(given.out, rows)
    print(planted_report.text(rows))
    return 0


def _parser():
    parser = run_explain.parser_of("tests.planted_causes", __doc__, "results/planted")
    parser.add_argument("--count", type=int, help="the first N items (a fair sample)")
    parser.add_argument("--only", default="", help="ROBOT/KIND/DRAW, with * and ?")
    parser.add_argument("--jobs", type=int, default=1, help="calls at once")
    parser.add_argument("--keep", action="store_true", help="keep recordings and answers in --out")
    return parser


def _is_chosen(name, only):
    return not only or fnmatch(name, only) or fnmatch(name, f"{only.rstrip('/')}/*")


def _available(questions):
    """Return the questions whose model files are installed, and print the others."""
    missing = {}
    for name in dict.fromkeys(q.robot for q in questions):
        try:
            ROBOTS[name].source()
        except MissingModelError as error:
            missing[name] = error
            print(f"skipped: {error}")
    return [q for q in questions if q.robot not in missing]


def read_rows(path):
    """Return the rows of items.jsonl without an incomplete last line."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def _examine(questions, version, path, given):
    from tqdm import tqdm

    with path.open("a") as file, ThreadPoolExecutor(given.jobs) as pool:
        work = Path(tempfile.mkdtemp(prefix="planted-"))
        folder = given.out / version if given.keep else work
        futures = [
            pool.submit(
                examine, question, given.simgap.absolute(), folder.absolute(), given.cpu_limit
            )
            for question in questions
        ]
        try:
            for future in tqdm(as_completed(futures), total=len(futures), disable=None):
                file.write(json.dumps(future.result() | {"version": version}) + "\n")
                file.flush()
        finally:
            for future in futures:
                future.cancel()
            shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    run_explain.end_when_terminated()
    sys.exit(main(sys.argv[1:]))
