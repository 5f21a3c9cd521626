"""Tables, figures and a page with the results of an exam."""

from __future__ import annotations

import csv
import json

from tests.simple_exam import exam_figures
from tests.simple_exam.exam_summary import confusion, power, summarised

QUICK_SHARE = 0.8  # Minimum share of right answers in a quick exam.


def write(folder, rows):
    """Write all results into `folder` and return the summary."""
    summary = summarised(rows)
    answered = [row for row in rows if row.get("mark")]
    _items(folder / "items.csv", answered)
    _confusion(folder / "confusion.csv", confusion(answered))
    (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    (folder / "README.md").write_text(page(summary))
    exam_figures.draw(folder, power(answered), confusion(answered))
    return summary


def marks(summary):
    """Return rows (description, required, result, interval, is met) of the targets of `explain`."""
    single, clean, double = summary["single"], summary["clean"], summary["double"]
    at_least = [
        (
            "single effects at 1 x the noise or more: named, or in a set of at most 2",
            0.97,
            single["named"],
        ),
        (
            "the same, effects that no data can tell apart counted as one",
            0.97,
            single["named up to equivalence"],
        ),
        (
            "the same, or in a larger set whose others explain these data as well",
            0.97,
            single["named as data tell"],
        ),
        ("two effects: both found", 0.85, double["named"]),
        ("the same, up to equivalence", 0.85, double["named up to equivalence"]),
        ("a cause outside the library: unknown or partial", 0.95, summary["foreign"]["right"]),
    ]
    rows = [
        (
            "clean recordings: false alarms",
            "at most 1 %",
            clean["alarms"],
            _at(clean["alarms"], 0.0, 0.01),
        )
    ]
    rows += [
        (what, f"at least {wanted:.0%}", got, _at(got, wanted, 1.0))
        for what, wanted, got in at_least
    ]
    held = summary["coverage"]["all"]
    return [
        *rows,
        ("95 % intervals that hold the truth", "90 to 98 %", held, _at(held, 0.90, 0.98)),
    ]


def _at(got, low, high):
    return got["share"] is not None and low <= got["share"] <= high


def passes(summary):
    """Return whether a quick exam has no alarm, no failure and enough right answers."""
    kinds = [
        summary["single"]["named up to equivalence"],
        summary["double"]["named up to equivalence"],
    ]
    kinds.append(summary["foreign"]["right"])
    hits, of = sum(k["count"] for k in kinds), sum(k["of"] for k in kinds)
    return (
        not summary["failed"]
        and not summary["clean"]["alarms"]["count"]
        and hits >= QUICK_SHARE * of
    )


def printed(summary):
    """Return the targets as lines of text."""
    lines = [
        f"{'yes' if met else 'NO ':4}{_ratio(got):>34}  {what} ({wanted})"
        for what, wanted, got, met in marks(summary)
    ]
    return "\n".join([*lines, _seconds(summary)])


def _ratio(got):
    if got["share"] is None:
        return "none asked"
    return (
        f"{got['count']}/{got['of']} = {got['share']:.1%} ({got['low']:.1%} to {got['high']:.1%})"
    )


def _seconds(summary):
    times = summary["seconds"]
    if times["median"] is None:
        return "no times"
    middle, high, most = (f"{times[name]:.1f}" for name in ("median", "p95", "max"))
    return f"seconds an item: median {middle}, 95th percentile {high}, most {most}"


def page(summary):
    """Return the text of README.md."""
    lines = [
        "# The exam of `simgap explain`",
        "",
        INTRODUCTION,
        "",
        "| mark | wanted | reached (95 % interval) | met |",
    ]
    lines += ["|---|---|---|---|"]
    lines += [
        f"| {what} | {wanted} | {_ratio(got)} | {'yes' if met else 'no'} |"
        for what, wanted, got, met in marks(summary)
    ]
    lines += ["", _seconds(summary) + ".", ""]
    for title, kind, key in BREAKDOWNS:
        lines += _breakdown(title, summary[kind].get(key, {}))
    lines += _breakdown("Intervals that hold the truth", _coverage(summary["coverage"]))
    lines += [
        "## Outcomes",
        "",
        "What each means stands in `bench/diagnosis_benchmark/grading.py`.",
        "",
    ]
    for kind, outcomes in summary["outcomes"].items():
        lines.append(
            f"- {kind}: " + ", ".join(f"{count} {name}" for name, count in sorted(outcomes.items()))
        )
    cannot = [f"- {name}: {count}" for name, count in summary["cannot show"].items()]
    lines += ["", "## What the sensors cannot show", "", CANNOT, "", *(cannot or ["- nothing"]), ""]
    if summary["failed"]:
        lines += ["## Without an answer", "", *(f"- {name}" for name in summary["failed"]), ""]
    return "\n".join(lines)


def _coverage(coverage):
    parts = {"all": coverage["all"]}
    for key in ("of", "noise", "kind"):
        parts |= coverage[f"by {key}"]
    return parts


def _breakdown(title, shares):
    if not shares:
        return []
    rows = [f"| {name} | {_ratio(got)} |" for name, got in shares.items()]
    return [f"## {title}", "", "| | |", "|---|---|", *rows, ""]


BREAKDOWNS = (
    ("False alarms by noise", "clean", "by noise"),
    ("False alarms by whether the noise is stated", "clean", "by stated"),
    ("False alarms by system", "clean", "by system"),
    ("Single effects by size in units of the noise", "single", "by size"),
    ("Single effects by system, up to equivalence", "single", "by system up to equivalence"),
    ("Single effects by noise, up to equivalence", "single", "by noise up to equivalence"),
    ("Single effects by simulator, up to equivalence", "single", "by source up to equivalence"),
    ("Single effects by effect, up to equivalence", "single", "by effect up to equivalence"),
    ("Two effects by system, up to equivalence", "double", "by system up to equivalence"),
    ("Causes outside the library", "foreign", "by effect"),
)
INTRODUCTION = """Recordings of independent simulators (scipy and MuJoCo; never the engine that
`explain` itself uses), in each one hidden effect, two, a cause that the library
does not have, or none; `explain` sees the recording alone. `python -m tests.simple_exam`
makes all of this again. Size is the root mean square of the gap that base
parameters and initial states, refitted, leave in the runs for fitting, in units of
the noise. Intervals are Wilson's, of alarms Clopper and Pearson's.

`items.csv` has a row an item, `items.jsonl` all that was answered, `confusion.csv`
counts what was named first. `figures/power` shows the share of effects that are
found against their size, `figures/confusion` what is taken for what."""
CANNOT = """Drawn again and again, these did not reach the wanted size within twice the
plausible range, because base parameters or initial states absorb them: so many of
the questions about them could be asked."""


def _confusion(path, counts):
    truths, named = (sorted({pair[i] for pair in counts}) for i in (0, 1))
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["hidden", *named])
        writer.writerows([truth, *(counts[truth, name] for name in named)] for truth in truths)


def _items(path, rows):
    with path.open("w", newline="") as file:
        writer = None
        for row in sorted(rows, key=lambda row: row["question"]):
            line = _line(row)
            if writer is None:
                writer = csv.DictWriter(file, list(line), lineterminator="\n")
                writer.writeheader()
            writer.writerow(line)


def _line(row):
    item, mark, verdict = row["item"], row["mark"], row["verdict"] or {}
    held = [h for h in mark["covered"].values() if h is not None]
    keys = (
        "name",
        "size",
        "beyond",
        "noise",
        "stated",
        "rate",
        "seconds",
        "runs",
        "source",
        "driven",
    )
    heldout = verdict.get("heldout") or {}
    return {
        **{name: row[name] for name in ("question", "part", "kind", "system")},
        "channels": " ".join(item.get("channels", ())),
        **{"run_seconds" if key == "seconds" else key: _short(item.get(key)) for key in keys},
        "hidden": " + ".join(
            f"{n}={','.join(f'{c:.4g}' for c in cs)}" for n, cs in item.get("effects", {}).items()
        ),
        "verdict": verdict.get("verdict", ""),
        "named": mark["named"],
        "outcome": mark["outcome"],
        **{name: mark[name] for name in ("set_size", "class_size", "found", "found_class")},
        "rivals_sigmas": " ".join(
            f"{name}={rival['sigmas']:.2g}" for name, rival in row["rivals"].items()
        ),
        "gap_closed": _short(heldout.get("gap_closed")),
        "intervals_holding": f"{sum(held)}/{len(held)}" if held else "",
        "seconds": _short(row["seconds"]),
        "error": row["error"].strip().splitlines()[-1] if row["error"] else "",
    }


def _short(value):
    return f"{value:.4g}" if isinstance(value, float) else value
