"""Answers and processor time of `simgap explain` on all measured recordings and cases.

``python -m tests.answer_table [--simgap PATH] [--out FILE.csv] [--only NAME] [--shared DIR]``

Each row of the table is written as soon as its recording is explained; rows of the same version
are not made again, so that an interrupted table continues where it was. Several versions may share
a table.
"""

import csv
import os
import subprocess
import sys
import tempfile
from fnmatch import fnmatch
from pathlib import Path

from sims.core.toml_validation import tomllib
from tests.answer_table.answer_marking import faults
from tests.planted_causes import run_explain

RECORDINGS = Path(__file__).with_name("recordings.toml")
SHARED = Path(__file__).parents[3] / "shared"
COLUMNS = (
    "item", "version", "verdict", "causes", "right", "faults", "cpu_s", "cpu_asked", "wall_s",
    "memory_mb", "heldout_base", "heldout_extended", "noise_floor", "unit", "exit", "message",
)  # fmt: skip


def main(arguments):
    given = _parser().parse_args(arguments)
    version = given.version or run_explain.version_of(given.simgap)
    recordings = tomllib.loads(RECORDINGS.read_text())
    chosen = {n: r for n, r in recordings.items() if not given.only or fnmatch(n, given.only)}
    if not chosen:
        print(f"--only {given.only}: no such recording; there are: {', '.join(recordings)}")
        return 2
    rows = read_rows(given.out)
    if given.fresh:
        rows = [r for r in rows if r["version"] != version or r["item"] not in chosen]
    write_rows(given.out, rows)
    answered = {row["item"] for row in rows if row["version"] == version}
    for name, expected in chosen.items():
        if name in answered:
            continue
        folder = given.shared / expected["folder"]
        if not folder.is_dir():
            print(f"skipped: {name}: no folder {folder} (--shared names the folder)")
            continue
        row = measure(name, expected, given.shared, given.simgap.absolute(), given.cpu_limit)
        row["version"] = version
        print(line(row), flush=True)
        rows.append(row)
        write_rows(given.out, rows)
    print()
    print(totals(rows))
    return 0


def _parser():
    parser = run_explain.parser_of("tests.answer_table", __doc__, "results/explain-table.csv")
    parser.add_argument("--only", default="", help="name of a recording, with * and ?")
    parser.add_argument(
        "--shared",
        type=Path,
        default=Path(os.environ.get("SIMGAP_SHARED", SHARED)),
        help="folder with cases/, data/ and robots/ (default: %(default)s)",
    )
    return parser


def read_rows(path):
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path, rows):
    """Replace the whole table, so that an interruption leaves no incomplete row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    part.replace(path)


def measure(name, expected, shared, simgap, cpu_limit):
    """Explain one recording and return its row."""
    with tempfile.TemporaryDirectory(prefix="explain-table-") as temporary:
        work = Path(temporary)
        recording, failure = prepared(expected, shared / expected["folder"], simgap, work)
        if failure:
            outcome = run_explain.Outcome(None, 2, 0.0, 0.0, 0.0, failure)
        else:
            options = ("--jobs", "1", *expected.get("options", ()))
            outcome = run_explain.explain(simgap, recording, work / "answer", cpu_limit, options)
    wrong = faults(expected, outcome)
    verdict = outcome.verdict or {}
    held_out = verdict.get("heldout") or {}
    lines = outcome.output.replace(f"{shared}{os.sep}", "").strip().splitlines() or [""]
    return {
        "item": name,
        "verdict": verdict.get("verdict", "none"),
        "causes": " + ".join(map(_cause_text, verdict.get("causes", []))),
        "right": "" if wrong is None else "no" if wrong else "yes",
        "faults": expected.get("plain", "") if wrong is None else "; ".join(wrong),
        "cpu_s": f"{outcome.cpu:.1f}",
        "cpu_asked": expected.get("cpu", ""),
        "wall_s": f"{outcome.wall:.1f}",
        "memory_mb": f"{outcome.memory:.0f}",
        "heldout_base": _number(held_out.get("rmse_base")),
        "heldout_extended": _number(held_out.get("rmse_extended")),
        "noise_floor": _number(held_out.get("noise_floor")),
        "unit": held_out.get("unit", ""),
        "exit": "limit" if outcome.code is None else outcome.code,
        "message": lines[-1][:200] if outcome.verdict is None else "",
    }


def prepared(expected, folder, simgap, work):
    """Write or import a description where needed; return (path of the recording, error message)."""
    if "description" in expected:
        (work / "log.toml").write_text(expected["description"].replace("{folder}", str(folder)))
        if "model" in expected:
            (work / "model.xml").write_text(expected["model"])
        return work / "log.toml", ""
    if "import" in expected:
        options = [option.replace("{folder}", str(folder)) for option in expected["import"]]
        command = [simgap, "import", folder, *options, "--out", work / "log.toml"]
        done = subprocess.run(
            [str(word) for word in command], capture_output=True, text=True, check=False
        )
        if done.returncode:
            return None, done.stdout + done.stderr
        return work / "log.toml", ""
    if "recording" in expected:
        return folder / expected["recording"], ""
    return folder / "log.toml", ""


def _cause_text(cause):
    values = " ".join(f"{c['value']:.4g}" for c in cause["coefficients"].values())
    return f"{'|'.join([cause['effect'], *cause['alternatives']])} ({values})"


def _number(value):
    return "" if value is None else f"{value:.4g}"


def line(row):
    said = row["causes"] or row["message"] or "-"
    return (
        f"{row['item']:34} {row['right'] or '?':4} {row['cpu_s']:>6} s {row['memory_mb']:>6} MB  "
        f"{row['verdict']}: {said}" + (f"  [{row['faults']}]" if row["faults"] else "")
    )


def totals(rows):
    """Return right answers and processor time, one line per version."""
    lines = []
    for version in dict.fromkeys(row["version"] for row in rows):
        own = [row for row in rows if row["version"] == version]
        known = [row for row in own if row["right"]]
        right = sum(row["right"] == "yes" for row in known)
        seconds = sum(float(row["cpu_s"]) for row in own)
        ended = sum(row["exit"] == "limit" for row in own)
        lines.append(
            f"{version}: {right} of {len(known)} right, {len(own)} recordings, "
            f"{seconds:.0f} s of processor time, {ended} ended at the limit"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    run_explain.end_when_terminated()
    sys.exit(main(sys.argv[1:]))
