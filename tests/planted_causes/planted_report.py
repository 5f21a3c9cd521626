"""Tables of the planted-cause test: one row per case, and shares by version, robot and kind."""

from __future__ import annotations

import csv

import numpy as np

MIN_ITEMS = 100  # Minimum number of cases of a complete test.
MIN_SHARE = 0.9  # Minimum share of fair answers.
MAX_MEDIAN_CPU = 5.0  # Maximum median of the processor seconds of an answer.
COLUMNS = (
    "item", "version", "place", "size", "gap", "outcome", "strict", "fair", "verdict", "causes",
    "number", "other_members", "cpu_s", "wall_s", "memory_mb", "heldout_base",
    "heldout_extended", "message",
)  # fmt: skip
GROUP_COLUMNS = (
    "version", "group", "items", "strict", "fair", "no_answer", "cpu_median_s", "cpu_p95_s",
    "cpu_max_s", "wall_median_s", "memory_max_mb",
)  # fmt: skip


def write(folder, rows):
    """Write items.csv and summary.csv into a folder."""
    drawn = sorted((r for r in rows if r["drawn"]), key=lambda r: (r["version"], r["item"]))
    _write_csv(folder / "items.csv", COLUMNS, map(_item_cells, drawn))
    _write_csv(folder / "summary.csv", GROUP_COLUMNS, groups(rows))


def _write_csv(path, columns, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _item_cells(row):
    mark, item, verdict = row["mark"], row["drawn"], row["verdict"] or {}
    held_out = verdict.get("heldout") or {}
    ratios = mark["ratios"].items()
    return {
        "item": row["item"],
        "version": row["version"],
        "place": item["place"],
        "size": item["size"],
        "gap": f"{item['gap']:.3g}",
        "outcome": mark["outcome"],
        "strict": int(mark["strict"]),
        "fair": int(mark["fair"]),
        "verdict": verdict.get("verdict", ""),
        "causes": " + ".join(mark["causes"]),
        "number": "" if mark["number"] is None else f"{mark['number']:.4g}",
        "other_members": " ".join(f"{n}={'-' if r is None else f'{r:.3f}'}" for n, r in ratios),
        "cpu_s": f"{row['cpu']:.1f}",
        "wall_s": f"{row['wall']:.1f}",
        "memory_mb": f"{row['memory']:.0f}",
        "heldout_base": _number(held_out.get("rmse_base")),
        "heldout_extended": _number(held_out.get("rmse_extended")),
        "message": row["message"].splitlines()[-1][:160] if row["message"] else "",
    }


def _number(value):
    return "" if value is None else f"{value:.4g}"


def groups(rows):
    """Return counts and times: all cases of a version, by robot, by kind, and with force limits."""
    result = []
    for version in dict.fromkeys(row["version"] for row in rows):
        drawn = [r for r in rows if r["version"] == version and r["drawn"]]
        result.append(_group(version, "all", drawn))
        for key in ("robot", "kind"):
            for value in sorted({r[key] for r in drawn}):
                result.append(_group(version, value, [r for r in drawn if r[key] == value]))
        limited = [r for r in drawn if r["drawn"]["force_limits"]]
        result.append(_group(version, "force limits reached", limited))
    return [group for group in result if group["items"]]


def _group(version, name, rows):
    cpu = [r["cpu"] for r in rows] or [0.0]
    return {
        "version": version,
        "group": name,
        "items": len(rows),
        "strict": sum(r["mark"]["strict"] for r in rows),
        "fair": sum(r["mark"]["fair"] for r in rows),
        "no_answer": sum(r["mark"]["outcome"] == "none" for r in rows),
        "cpu_median_s": f"{np.median(cpu):.1f}",
        "cpu_p95_s": f"{np.quantile(cpu, 0.95):.1f}",
        "cpu_max_s": f"{max(cpu):.1f}",
        "wall_median_s": f"{np.median([r['wall'] for r in rows] or [0.0]):.1f}",
        "memory_max_mb": f"{max([r['memory'] for r in rows] or [0.0]):.0f}",
    }


def text(rows):
    """Return the tables as aligned text."""
    lines = []
    for version in dict.fromkeys(row["version"] for row in rows):
        for row in rows:
            if row["version"] == version and row["drawn"]:
                lines.append(_line(row))
    totals = groups(rows)
    lines += ["", _table(GROUP_COLUMNS, totals), ""]
    lines += [verdict(total) for total in totals if total["group"] == "all"]
    digests = {}
    for row in rows:
        digests.setdefault(row["item"], set()).add(row.get("digest"))
    changed = sorted(name for name, found in digests.items() if len(found) > 1)
    if changed:
        lines += ["", "recordings differ between versions (use --fresh): " + ", ".join(changed)]
    undrawn = sorted({row["item"] for row in rows if not row["drawn"]})
    if undrawn:
        lines += ["", "no place shows such a change: " + ", ".join(undrawn)]
    return "\n".join(lines)


def verdict(total):
    """Return a line that says whether a version reaches the targets, from its row of all cases."""
    share, seconds = total["fair"] / total["items"], float(total["cpu_median_s"])
    is_reached = total["items"] >= MIN_ITEMS and share >= MIN_SHARE and seconds <= MAX_MEDIAN_CPU
    return (
        f"{total['version']}: {total['fair']} of {total['items']} right ({share:.0%}), median "
        f"{seconds} s of processor time; expected {MIN_SHARE:.0%} of at least {MIN_ITEMS}, "
        f"{MAX_MEDIAN_CPU:g} s: {'reached' if is_reached else 'not reached'}"
    )


def _line(row):
    cells = _item_cells(row)
    worth = "strict" if row["mark"]["strict"] else "fair" if row["mark"]["fair"] else "-"
    planted = f"{cells['size']} at {cells['place']}, gap {cells['gap']}"
    said = f"{cells['verdict'] or 'no answer'}: {cells['causes'] or cells['message'] or '-'}"
    return (
        f"{row['item']:34} {cells['outcome']:8} {worth:6} {cells['cpu_s']:>6} s  "
        f"{planted}  ->  {said} {cells['number']} {cells['other_members']}"
    ).rstrip()


def _table(columns, rows):
    cells = [list(columns), *([str(row[c]) for c in columns] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in cells
    )
