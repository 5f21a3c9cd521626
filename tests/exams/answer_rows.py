"""Rows of answers: items.jsonl holds all that is known, items.csv one line an answer.

All exams have the same columns.
"""

from __future__ import annotations

import json

import pandas as pd

LEVELS = ("strict", "few", "equivalent", "fair", "any")
COLUMNS = (
    "item", "version", "kind", "system", "effect", "hidden", "size", "noise", "conditions",
    "verdict", "causes", "outcome", "members", *LEVELS, "intervals_held", "intervals", "ratios",
    "gap_closed", "heldout_base", "heldout_extended", "noise_floor", "cpu_s", "wall_s",
    "memory_mb", "message",
)  # fmt: skip
TEXT = (
    "item", "version", "kind", "system", "effect", "hidden", "noise", "conditions", "verdict",
    "causes", "outcome", "ratios", "message",
)  # fmt: skip
NOT_DRAWN = "not drawn"


def read_rows(path):
    """Return the rows of items.jsonl without an incomplete last line."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def cells(row):
    """Return the line of items.csv of a row."""
    start = {name: row[name] for name in ("item", "version", "kind", "system", "effect")}
    if row["case"] is None:
        return start | {"outcome": NOT_DRAWN, "message": row["message"]}
    mark, verdict = row["mark"], row["verdict"] or {}
    held_out = verdict.get("heldout") or {}
    held = [is_held for is_held in mark["covered"].values() if is_held is not None]
    ratios = mark["ratios"].items()
    lines = row["message"].strip().splitlines()
    return start | row["case"] | {
        "verdict": verdict.get("verdict", ""),
        **{name: mark[name] for name in ("causes", "outcome", "members", *LEVELS)},
        "intervals_held": sum(held), "intervals": len(held),
        "ratios": " ".join(f"{n}={'-' if r is None else f'{r:.3g}'}" for n, r in ratios),
        "gap_closed": number(held_out.get("gap_closed")),
        "heldout_base": number(held_out.get("rmse_base")),
        "heldout_extended": number(held_out.get("rmse_extended")),
        "noise_floor": number(held_out.get("noise_floor")),
        "cpu_s": number(row["cpu"]), "wall_s": number(row["wall"]),
        "memory_mb": number(row["memory"]),
        "message": mark["note"] or (lines[-1][:200] if lines else ""),
    }  # fmt: skip


def number(value):
    """Format a number with four digits; None becomes an empty cell."""
    return "" if value is None else f"{value:.4g}"


def hidden_text(effects):
    """Format coefficients by effect@place."""
    return " + ".join(f"{n}={','.join(f'{c:.4g}' for c in cs)}" for n, cs in effects.items())


def conditions_text(**conditions):
    """Format further properties of a case."""
    return "; ".join(f"{name}={value}" for name, value in conditions.items())


def write_table(path, rows):
    """Write items.csv and return it as a frame."""
    lines = sorted((cells(row) for row in rows), key=lambda c: (c["version"], c["item"]))
    pd.DataFrame(lines, columns=COLUMNS).to_csv(path, index=False)
    return read_table(path)


def read_table(path):
    """Return items.csv with a column for each condition."""
    table = pd.read_csv(path, dtype=dict.fromkeys(TEXT, str))
    table[[*TEXT]] = table[[*TEXT]].fillna("")
    for name in LEVELS:
        table[name] = table[name].fillna(False).astype(bool)
    pairs = table.conditions.map(
        lambda text: dict(part.split("=", 1) for part in text.split("; ") if part)
    )
    return table.join(pd.DataFrame(pairs.tolist(), index=table.index))
