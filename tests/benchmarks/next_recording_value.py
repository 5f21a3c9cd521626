"""Does the run that ``simgap design`` proposes split what was open? ``python -m
tests.benchmarks.next_recording_value [--sets 20] [--seed 0] [--out DIR]``.

From the exam questions with one hidden cause (tests/exams/systems), sets of causes that explain
cannot distinguish are drawn by seed; the causes of a set are not all equivalent by
`find_equivalent_effects`. The proposed run is recorded once by the exam's own simulators, with the
hidden cause and new noise, and everything is explained together. A set is

* settled, if all remaining causes are equivalent in any data to the true cause, or, according to
the
  design, cannot be distinguished from it by any run of this kind; one of these causes remains,
* split, if fewer causes remain than before, the true cause among them, but more than in a settled
set,
* open, if no cause was excluded,
* lost, if the true cause is excluded, or explain gives another verdict.

The prediction of the design is kept if no two remaining causes are predicted to be distinguishable,
and the true cause is not lost.
"""

import argparse
import collections
import csv
import itertools
import json
import multiprocessing
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import simgap
from bench.diagnosis_benchmark.case_generation.case_sampling import restore_conditions
from bench.diagnosis_benchmark.case_generation.equivalent_effects import find_equivalent_effects
from bench.diagnosis_benchmark.case_generation.recording_conditions import SIMULATORS
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    simulate_with_mujoco,
    simulate_with_scipy,
)
from bench.diagnosis_benchmark.case_set import write_case
from sims.core.simulator import Scenario
from sims.recording.recording import Recording, Run
from sims.recording.recording_writer import write_recording
from tests.exams.exam import UndrawableError
from tests.exams.systems.system_cases import questions

SECONDS = 4.0
# Relative error of the initial states (absolute below 1 m or 1 rad), as in a real experiment.
SLIPPED = 0.01
COLUMNS = (
    "question", "hidden", "before", "groups", "worth", "says", "after", "verdict", "outcome",
    "kept", "seconds",
)  # fmt: skip


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--offset", type=int, default=0, help="of the exam's seeds")
    parser.add_argument("--longest", type=float, default=5 * SECONDS, help="s, of the run")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", default="", help="questions whose name holds this")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args(arguments)
    asked = [q for q in questions(given.offset) if q.part == "marks" and q.kind == "single"]
    asked = [q for q in asked if given.only in q.name]
    order = np.random.default_rng(given.seed).permutation(len(asked))
    rows = []
    calls = [(asked[place], given.offset, given.longest) for place in order.tolist()]
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
        for row in pool.imap(_evaluate_question, calls):
            if row is None:
                continue
            rows.append(row)
            print(" | ".join(str(row[name]) for name in COLUMNS), flush=True)
            if len(rows) == given.sets:
                pool.terminate()
                break
    _summarise(rows, given)


def _evaluate_question(call):
    """Return a row about a question; None if it leaves no set open that data could split."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    question, offset, longest = call
    try:
        item = question.draw(offset).item
    except UndrawableError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        before = write_case(item, Path(folder), truth=False)
        proposed = simgap.design(before, seconds=SECONDS, longest=longest, jobs=1)
        known = _set_of(proposed.explanation)
        if known is None or len(_classes(item, known)) < 2 or proposed.design is None:
            return None
        after = recorded(item, proposed.design, Path(folder))
        found = simgap.explain([before, after], jobs=1)
    return _row(question, item, known, proposed, found)


def _set_of(explanation):
    """Return the causes of an ambiguous set; None for another result."""
    causes = explanation.answer.causes
    if explanation.answer.verdict != "ambiguous" or len(causes) != 1:
        return None
    return causes[0].effect, *causes[0].alternatives


def _classes(item, names):
    return {min(find_equivalent_effects(item.system, item.driven, name)) for name in names}


def recorded(item, design, folder):
    """Record the proposed run with the reference simulators of a case, and return its path."""
    setting, rng = restore_conditions(item), np.random.default_rng(item.seed + 7)
    begin = {
        name: value + SLIPPED * rng.standard_normal() * max(abs(value), 1.0) * (value != 0.0)
        for name, value in design.initial.items()
    }
    scenario = Scenario(design.times, begin, dict(design.inputs))
    make = simulate_with_mujoco if item.source == "mujoco" else simulate_with_scipy
    seen = make(setting.make_true_system(item.effects), scenario, setting.channels)
    seen = setting.noise.add_to(seen, rng)
    channels = dict(zip(setting.channels, seen.T, strict=True))
    run = Run("next", design.times, channels, scenario.inputs, {}, {}, held_out=False)
    noise = setting.noise.sigma if item.stated else {}
    constants = {} if item.system == "slider" else setting.constants
    path = folder / "next.csv"
    about = Recording(path, item.system, "", constants, noise, (run,))
    write_recording(path, about, SIMULATORS[item.system].system(), digits=9)
    return path


def _row(question, item, known, proposed, found):
    design = proposed.design
    answer = found.answer
    left = {name for cause in answer.causes for name in (cause.effect, *cause.alternatives)}
    (truth,) = item.effects
    # Causes that the design cannot distinguish from the true cause, and their equivalents.
    twins = next(set(group) for group in design.groups if truth in group)
    alike = {
        name for twin in twins for name in find_equivalent_effects(item.system, item.driven, twin)
    }
    found_one = answer.verdict in ("ambiguous", "named", "partial") and len(answer.causes) == 1
    if not found_one or not alike & left:
        outcome = "lost"
    elif left <= alike and len(design.groups) > 1:
        outcome = "settled"
    else:
        outcome = "split" if len(left) < len(known) else "open"
    # No two causes that are predicted to be distinguishable may remain.
    broken = [
        (a, b)
        for mine, others in itertools.combinations(design.groups, 2)
        for a, b in itertools.product(mine, others)
        if {a, b} <= left
    ]
    worth = {name: round(float(value), 1) for name, value in design.told.items()}
    return {
        "question": question.name, "hidden": truth, "before": "/".join(known),
        "groups": " | ".join("/".join(group) for group in design.groups),
        "worth": json.dumps(worth), "says": design.says, "after": "/".join(sorted(left)),
        "verdict": answer.verdict, "outcome": outcome, "kept": not broken and outcome != "lost",
        "seconds": round(answer.seconds, 1),
    }  # fmt: skip


def _summarise(rows, given):
    told = [row for row in rows if " | " in row["groups"]]
    rest = [row for row in rows if row not in told]
    for name, some in (
        ("predicted distinguishable", told),
        ("predicted distinguishable by no run", rest),
    ):
        counts = collections.Counter(row["outcome"] for row in some)
        listed = ", ".join(f"{count} {outcome}" for outcome, count in sorted(counts.items()))
        kept = sum(row["kept"] for row in some)
        print(f"{len(some)} {name}: {listed or 'none'}; the word held in {kept}")
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        with (given.out / "sets.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1:])
