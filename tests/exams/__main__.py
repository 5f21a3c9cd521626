"""Run an exam of `simgap explain`: ``python -m tests.exams EXAM [options]``.

Exams are systems (ball, pendulum, slider), robots, floating (robots with a floating base), planted
(one number of a packaged model file), models (files as people have them), geometry (wrong lengths,
payloads, wheels), contacts (one number of a contact), conventions (of logs) and recordings
(measured ones). One row an answer is added to items.jsonl of the output folder, so that
an interrupted exam continues where it was; several versions may share a folder. Tables, figures and
a page are written at the end. ``tests/exams/README.md`` describes the cases and grades.
"""

import argparse
import sys
from pathlib import Path
from pkgutil import resolve_name

from tests.exams import exam_report
from tests.exams.exam import write_table
from tests.exams.explain_calls import ExplainCall, version_of
from tests.exams.runner import run_exam, select_questions

EXAMS = {
    "systems": "tests.exams.systems.system_cases:EXAM",
    "robots": "tests.exams.robots.robot_cases:EXAM",
    "floating": "tests.exams.robots.robot_cases:FLOATING_EXAM",
    "planted": "tests.exams.planted.planted_cases:EXAM",
    "models": "tests.exams.planted.model_cases:EXAM",
    "geometry": "tests.exams.planted.geometry_cases:EXAM",
    "contacts": "tests.exams.contacts.contact_cases:EXAM",
    "conventions": "tests.exams.conventions.convention_cases:EXAM",
    "recordings": "tests.exams.recordings.recording_cases:EXAM",
}
"""Module and constant of each exam."""


def main(arguments):
    given = _parser().parse_args(arguments)
    exam = resolve_name(EXAMS[given.exam])
    try:
        questions = select_questions(
            exam, given.only, given.count, given.quick, given.spread, given.seed
        )
    except ValueError as error:
        return _refuse(f"{given.exam}: {error}")
    if not questions:
        return _refuse(f"--only {given.only}: no question of {given.exam} has such a name")
    command = given.simgap
    if command is None and exam.needs_command:
        command = Path(sys.executable).parent / "simgap"
    if command is not None and not command.is_file():
        return _refuse(f"{command}: no such command; expected bin/simgap of an installation")
    folder = given.out or Path("results/exams") / (given.exam + "-quick" * given.quick)
    folder.mkdir(parents=True, exist_ok=True)
    call = ExplainCall(command and command.absolute(), given.cpu_limit or exam.cpu_limit)
    rows = run_exam(
        questions, folder, call, given.version or version_of(command), given.seed, given.jobs,
        given.fresh, given.again, folder / "recordings" if given.keep else None,
    )  # fmt: skip
    table = write_table(folder / "items.csv", rows)
    exam_report.write_report(folder, exam, table)
    print(exam_report.format_answers(table))
    print(exam_report.format_targets(exam, table))
    for line in exam_report.differing_recordings(rows):
        print(line)
    return int(given.quick and not exam_report.passes(exam, table))


def _refuse(message):
    print(message)
    return 2


def _parser():
    parser = argparse.ArgumentParser(
        prog="python -m tests.exams", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("exam", choices=EXAMS)
    parser.add_argument("--only", default="", help="names of questions, with * and ?")
    parser.add_argument("--count", type=int, help="the first N questions (a fair sample)")
    parser.add_argument(
        "--quick", action="store_true", help="a few questions; fails unless most are right"
    )
    parser.add_argument("--spread", action="store_true", help="each effect once")
    parser.add_argument("--seed", type=int, default=0, help="another exam of the same form")
    parser.add_argument("--jobs", type=int, default=2, help="questions at once")
    parser.add_argument("--cpu-limit", type=float, help="processor seconds of one call")
    parser.add_argument("--fresh", action="store_true", help="answer everything again")
    parser.add_argument("--again", action="store_true", help="answer again what was not right")
    parser.add_argument("--keep", action="store_true", help="keep recordings and answers in --out")
    parser.add_argument("--simgap", type=Path, help="command of an installation to examine")
    parser.add_argument("--version", help="its name in the tables (default: its commit)")
    parser.add_argument("--out", type=Path, help="output folder (default: results/exams/EXAM)")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
