"""Numbers of an exam: shares with 95 % intervals, interval coverage, times, power and confusion."""

from __future__ import annotations

from collections import Counter

import numpy as np
from scipy.stats import binomtest

BINS = ((1.0, 10**0.25), (10**0.25, 10**0.5), (10**0.5, 10**0.75), (10**0.75, 10.001))
"""Intervals of the size of single effects, in units of the noise, that are counted together."""
EVIDENCE = 4.0  # Sigmas above which the data exclude a cause.


def share(rows, right, exact=False):
    """Return the count of right rows, the total, and the share with its 95 % interval.

    The interval is Wilson's, or Clopper-Pearson's with `exact`.
    """
    rows = list(rows)
    hits = sum(bool(right(row)) for row in rows)
    if not rows:
        return {"count": 0, "of": 0, "share": None, "low": None, "high": None}
    interval = binomtest(hits, len(rows)).proportion_ci(0.95, method="exact" if exact else "wilson")
    return {
        "count": hits,
        "of": len(rows),
        "share": hits / len(rows),
        "low": interval.low,
        "high": interval.high,
    }


def found(row):
    return row["mark"]["found"]


def found_class(row):
    return row["mark"]["found_class"]


def as_data_tell(row):
    """Return whether the cause is found, or in a set that the data cannot reduce."""
    sigmas = [rival["sigmas"] for rival in row["rivals"].values()]
    return found_class(row) or (
        row["mark"]["outcome"] == "set" and max(sigmas, default=np.inf) < EVIDENCE
    )


def alarmed(row):
    return row["mark"]["outcome"] in ("alarm", "failed")


def right(row):
    return row["mark"]["outcome"] == "right"


def summarised(rows):
    """Return all numbers about the rows of an exam."""
    answered = [row for row in rows if row.get("mark")]
    marks = [row for row in answered if row["part"] == "marks"]
    of = {
        kind: [row for row in marks if row["kind"] == kind]
        for kind in ("clean", "single", "double", "foreign")
    }
    seconds = [row["seconds"] for row in answered if row["seconds"] is not None]
    return {
        "items": len(answered),
        "outcomes": {
            kind: dict(Counter(row["mark"]["outcome"] for row in group))
            for kind, group in of.items()
        },
        "single": _named(of["single"]),
        "clean": {
            "alarms": share(of["clean"], alarmed, exact=True),
            **_by(of["clean"], alarmed, exact=True),
        },
        "double": {**_named(of["double"], by=("system",)), "one": share(of["double"], _one)},
        "foreign": {
            "right": share(of["foreign"], right),
            **_by(of["foreign"], right, ("system", "effect")),
        },
        "coverage": _coverage(marks),
        "seconds": _times(seconds),
        "cannot show": _cannot(rows),
        "failed": [row["question"] for row in answered if row["mark"]["outcome"] == "failed"],
    }


def _one(row):
    return row["mark"]["outcome"] == "one"


def _named(rows, by=("system", "effect", "noise", "stated", "source", "size")):
    """Return shares by effect, by equivalence class, and as far as the data distinguish causes."""
    result = {"named": share(rows, found), "named up to equivalence": share(rows, found_class)}
    result["named as data tell"] = share(rows, as_data_tell)
    result["named alone"] = share(rows, right)
    result |= _by(rows, found, by) | {
        f"{k} up to equivalence": v for k, v in _by(rows, found_class, by).items()
    }
    return result


def _by(rows, right, by=("system", "noise", "stated"), exact=False):
    return {
        f"by {key}": {str(v): share(group, right, exact) for v, group in _groups(rows, key)}
        for key in by
    }


def _groups(rows, key):
    groups = {}
    for row in rows:
        groups.setdefault(_value(row, key), []).append(row)
    return sorted(groups.items(), key=lambda pair: str(pair[0]))


def _value(row, key):
    if key == "size":
        size = row["item"].get("size", 0.0)
        return next(
            (f"{low:.2g} to {high:.2g}" for low, high in BINS if low <= size < high), "other"
        )
    return row[key] if key in row else row["item"].get(key)


def _coverage(rows):
    """Return the coverage of finite 95 % intervals, by kind of quantity and by noise."""
    counts = [
        {
            "of": "coefficients" if "." in name else "parameters",
            "noise": row["item"]["noise"],
            "kind": row["kind"],
            "held": held,
        }
        for row in rows
        for name, held in row["mark"]["covered"].items()
    ]
    closed = [c for c in counts if c["held"] is not None]

    def held(c):
        return c["held"]

    result = {"all": share(closed, held), "open": len(counts) - len(closed)}
    for key in ("of", "noise", "kind"):
        result[f"by {key}"] = {
            v: share([c for c in closed if c[key] == v], held)
            for v in sorted({c[key] for c in closed})
        }
    return result


def _times(seconds):
    if not seconds:
        return {"median": None, "p95": None, "max": None}
    return {
        "median": float(np.median(seconds)),
        "p95": float(np.quantile(seconds, 0.95)),
        "max": float(max(seconds)),
    }


def _cannot(rows):
    """Return the effects for which some or all drawings are not visible.

    A drawing is not visible if it needs more than twice the plausible range.
    """
    asked, shown = Counter(), Counter()
    for row in rows:
        if row["kind"] == "single" and row["part"] == "marks":
            asked[row["system"], row["effect"]] += 1
            shown[row["system"], row["effect"]] += bool(row.get("mark"))
    return {
        f"{s} {e}": f"{shown[s, e]} of {n} drawn"
        for (s, e), n in sorted(asked.items())
        if shown[s, e] < n
    }


def power(rows):
    """Return (size, share, share up to equivalence) by group of sizes."""
    singles = [row for row in rows if row["kind"] == "single" and row["item"]]
    groups = {}
    for row in singles:
        size = row["item"]["size"]
        limits = (
            next((b for b in BINS if b[0] <= size < b[1]), (size, size))
            if row["part"] == "marks"
            else (size, size)
        )
        groups.setdefault((row["part"] == "marks", limits), []).append(row)
    return [
        (float(np.sqrt(low * high)), share(group, found), share(group, found_class))
        for (_, (low, high)), group in sorted(groups.items())
    ]


def confusion(rows):
    """Return counts by (truth, cause that was diagnosed first)."""
    counts = Counter()
    for row in rows:
        if row["part"] == "marks" and row["kind"] != "double":
            truth = {"clean": "(clean)", "foreign": "(foreign)"}.get(row["kind"], row["effect"])
            counts[truth, _first(row)] += 1
    return counts


def _first(row):
    verdict = row["verdict"]
    if verdict is None:
        return "(failed)"
    if verdict["verdict"] in ("adequate", "unknown", "unidentifiable"):
        return f"({verdict['verdict']})"
    if len(verdict["causes"]) != 1:
        return "(several)"
    return verdict["causes"][0]["effect"]
