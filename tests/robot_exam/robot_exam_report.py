"""Tables, figures and a page with the results of the robot exam."""

from __future__ import annotations

import csv
import json
from collections import Counter

import numpy as np

from tests.robot_exam import robot_exam_figures
from tests.simple_exam.exam_summary import share

ABOUT = "about.md"
HIDDEN = ("single", "family", "double")


def write(folder, rows):
    """Write all results into `folder` and return the summary.

    Remarks of a person in the file `ABOUT` of the folder become part of the page.
    """
    asked = [row for row in rows if row.get("mark")]
    summary, about = summarised(rows), folder / ABOUT
    listed(folder / "items.csv", asked)
    (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    said = about.read_text() if about.exists() else ""
    (folder / "README.md").write_text(page(summary, said))
    robot_exam_figures.draw(folder, confusion(asked), _seconds(asked))
    return summary


def summarised(rows):
    """Return all numbers about the rows of an exam."""
    asked = [row for row in rows if row.get("mark")]
    of = {kind: [r for r in asked if r["kind"] == kind] for kind in KINDS}
    covered = [held for r in asked for held in r["mark"]["covered"].values() if held is not None]
    return {
        "items": len(asked),
        "code": dict(Counter(row.get("code", "unknown") for row in asked)),
        "outcomes": {
            kind: dict(Counter(r["mark"]["outcome"] for r in group)) for kind, group in of.items()
        },
        "named": {
            kind: {how: share(of[kind], _is(how)) for how in HOWS} for kind in (*HIDDEN, "numerics")
        },
        "alarms": share(of["clean"], lambda r: r["mark"]["outcome"] != "right", exact=True),
        "foreign": share(of["foreign"], _is("strict")),
        "coverage": share(covered, bool),
        "seconds": _quantiles(asked, "seconds"),
        "processor": _quantiles(asked, "processor"),
        "by": {key: _by(asked, key) for key in ("effect", "robot", "noise")},
        "confusion": [[*pair, count] for pair, count in sorted(confusion(asked).items())],
        "cannot show": sorted(row["question"] for row in rows if not row.get("mark")),
        "failed": sorted(r["question"] for r in asked if r["mark"]["outcome"] == "failed"),
    }


def _quantiles(asked, key):
    """Return quantiles of a duration in seconds."""
    seconds = [row[key] for row in asked if row.get(key) is not None]
    return {
        name: float(np.quantile(seconds, q)) if seconds else None
        for name, q in (("median", 0.5), ("p95", 0.95), ("max", 1.0))
    }


def _is(how):
    return lambda row: row["mark"][how]


def _by(asked, key):
    """Return shares of diagnosed hidden causes, grouped by a column and by drive."""
    groups = {}
    for row in asked:
        if row["kind"] in HIDDEN:
            value = row["item"].get("noise", "?") if key == "noise" else row[key]
            drive = row["robot"].partition("-")[2]
            name = value if key == "robot" else f"{value} {drive}"
            groups.setdefault(name, []).append(row)
    return {
        name: {how: share(group, _is(how)) for how in HOWS}
        for name, group in sorted(groups.items())
    }


def confusion(asked):
    """Return counts by (hidden effect, effect that was diagnosed first)."""
    return Counter((_hidden(row), _first(row)) for row in asked if row["kind"] != "double")


def _hidden(row):
    if row["kind"] in ("clean", "numerics"):
        return f"({row['kind']})"
    return f"{row['effect']}@*" if row["kind"] == "family" else row["effect"]


def _first(row):
    verdict = row["verdict"]
    if verdict is None:
        return "(failed)"
    if not verdict["causes"] or verdict["verdict"] in ("adequate", "unknown", "unidentifiable"):
        return f"({verdict['verdict']})"
    effect, _, place = verdict["causes"][0]["effect"].partition("@")
    return f"{effect}@*" if place == "*" else effect


def _seconds(asked):
    """Return seconds by robot."""
    groups = {}
    for row in asked:
        if row["seconds"] is not None:
            groups.setdefault(row["robot"], []).append(row["seconds"])
    return dict(sorted(groups.items()))


def marks(summary):
    """Return rows (description, required, result, is met) of the targets of `explain`."""
    named, rows = summary["named"], []
    for what, wanted, got in (
        ("a single cause: effect and place, alone", None, named["single"]["strict"]),
        ("the same, or in a set of at most 4", None, named["single"]["few"]),
        ("the same, or in a set whose members do as well, refitted", 0.95, named["single"]["fair"]),
        ("the same, or in any set", None, named["single"]["any"]),
        ("a family", None, named["family"]["any"]),
        ("two causes: both found", 0.80, named["double"]["any"]),
        ("a cause outside the library: unknown or partial", 0.95, summary["foreign"]),
        ("numerics that are too coarse: named", None, named["numerics"]["strict"]),
    ):
        met = None if wanted is None or got["share"] is None else got["share"] >= wanted
        rows.append((what, "" if wanted is None else f"at least {wanted:.0%}", got, met))
    alarms, held = summary["alarms"], summary["coverage"]
    few = None if alarms["share"] is None else alarms["share"] <= 0.01
    rows.append(("clean recordings: false alarms", "at most 1 %", alarms, few))
    inside = None if held["share"] is None else 0.90 <= held["share"] <= 0.98
    rows.append(("95 % intervals that hold the truth", "90 to 98 %", held, inside))
    return rows


def printed(summary):
    """Return the targets as lines of text."""
    lines = [f"{_ratio(got):>34}  {what} {wanted}" for what, wanted, got, _ in marks(summary)]
    return "\n".join([*lines, _times(summary)])


def _ratio(got):
    if got["share"] is None:
        return "none asked"
    between = f"{got['low']:.0%} to {got['high']:.0%}"
    return f"{got['count']}/{got['of']} = {got['share']:.1%} ({between})"


def _times(summary):
    if summary["seconds"]["median"] is None:
        return "no times"
    return "; ".join(
        f"{what}: median {times['median']:.1f}, 95th percentile {times['p95']:.1f},"
        f" most {times['max']:.1f}"
        for what, times in (
            ("seconds a question", summary["seconds"]),
            ("of a processor", summary["processor"]),
        )
        if times["median"] is not None
    )


def page(summary, about=""):
    """Return the text of README.md, including the remarks of a person."""
    lines = ["# Causes hidden in robots", "", INTRODUCTION, ""]
    lines += [about.strip(), ""] if about else []
    lines += ["| mark | wanted | reached (95 % interval) | met |", "|---|---|---|---|"]
    for what, wanted, got, met in marks(summary):
        lines.append(f"| {what} | {wanted} | {_ratio(got)} | {_WORDS[met]} |")
    lines += ["", _times(summary) + ".", ""]
    if "code" in summary:  # Summaries of older exams have no code version.
        code = ", ".join(f"{count} by `{name}`" for name, count in summary["code"].items())
        lines += [f"Answers by version of the code: {code}.", ""]
    for key, groups in summary["by"].items():
        lines += [f"## By {key}", "", f"| | {' | '.join(HOWS)} |", "|---|" + "---|" * len(HOWS)]
        for name, shares in groups.items():
            cells = " | ".join(f"{shares[how]['count']}/{shares[how]['of']}" for how in HOWS)
            lines.append(f"| {name} | {cells} |")
        lines.append("")
    lines += [
        "## Outcomes",
        "",
        "What each means stands in `tests/robot_exam/robot_exam_score.py`.",
        "",
    ]
    for kind, outcomes in summary["outcomes"].items():
        counts = ", ".join(f"{count} {name}" for name, count in sorted(outcomes.items()))
        lines.append(f"- {kind}: {counts or 'none asked'}")
    for title, names in (("Without an answer", "failed"), ("What does not show", "cannot show")):
        lines += ["", f"## {title}", "", *(f"- {n}" for n in summary[names] or ["none"])]
    return "\n".join(lines) + "\n"


def listed(path, asked):
    """Write the answers as a CSV table, one line per answer."""
    lines = [_line(row) for row in sorted(asked, key=lambda row: row["question"])]
    with path.open("w", newline="") as file:
        names = list(lines[0]) if lines else []
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def _line(row):
    item, mark, verdict = row["item"], row["mark"], row["verdict"] or {}
    held = [h for h in mark["covered"].values() if h is not None]
    hidden = item.get("effects", {}).items()
    ratios = {name: r for name, r in mark["equal"].items() if r is not None}
    return {
        **{name: row[name] for name in ("question", "kind", "robot")},
        **{name: _short(item.get(name)) for name in ("size", "beyond", "numerics", "noise")},
        "step": f"{item.get('integrator')} {item.get('step')}",
        "hidden": " + ".join(f"{n}={','.join(f'{c:.4g}' for c in cs)}" for n, cs in hidden),
        "verdict": verdict.get("verdict", ""),
        **{name: mark[name] for name in ("named", "outcome", "members", *HOWS)},
        "held_out_ratios": " ".join(f"{name}={ratio:.3f}" for name, ratio in ratios.items()),
        "gap_closed": _short((verdict.get("heldout") or {}).get("gap_closed")),
        "intervals_holding": f"{sum(held)}/{len(held)}" if held else "",
        "seconds": _short(row["seconds"]),
        "processor": _short(row.get("processor")),
        "error": row["error"].strip().splitlines()[-1] if row["error"] else "",
    }


def _short(value):
    return f"{value:.4g}" if isinstance(value, float) else value


KINDS = ("clean", "single", "family", "double", "foreign", "numerics")
HOWS = ("strict", "few", "fair", "any")
_WORDS = {None: "", True: "yes", False: "no"}
INTRODUCTION = """Recordings of robots of 2 to 7 joints, driven by forces or by position servos,
made by Pinocchio and a solver written for the tests (`tests/robot_exam`; MuJoCo, which explains \
them,
makes none): in each one hidden cause, a family, two, one that the library does not have, a time
step that is too coarse, or none. `explain` sees the robot's file and the recording. `python -m
tests.robot_exam` makes all of this again. `strict`: effect and place named alone; `few`: or in a \
set of
at most 4; `fair`: or in a set whose other members, refitted in the world that made the data, do as
well on the runs held out (error at most 5 % larger); `any`: or in any set."""
