"""What differs between two settings, environments or other trees of plain values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

ALPHA = 0.05
"""Chance of any false alarm among all that is compared."""
OF_A_MACHINE = ("simgap", "python", "platform", "machine", "stepping", "seals", "packages")
"""Keys of an environment that may matter to what came out."""


def changes(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What differs, by dotted key: None where it is not there."""
    flat_a, flat_b = dict(_flat(a)), dict(_flat(b))
    return [
        {"what": key, "a": flat_a.get(key), "b": flat_b.get(key)}
        for key in sorted({*flat_a, *flat_b})
        if flat_a.get(key) != flat_b.get(key)
    ]


def _flat(value: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _flat(inner, f"{before}{key}.")
        elif isinstance(inner, list | tuple):
            yield f"{before}{key}", list(inner)
        else:
            yield f"{before}{key}", inner


def of_machine(environment: Mapping[str, Any]) -> dict[str, Any]:
    """The part of an environment that may matter, with the hash of the code that made runs."""
    told = {key: environment[key] for key in OF_A_MACHINE if key in environment}
    code = environment.get("fingerprint", {}).get("code")
    return {**told, **({"code": code} if code else {})}


def side(folder: Any, name: str, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Which of the two it is."""
    return {
        "folder": folder,
        "name": name,
        "simgap": environment.get("simgap", ""),
        "started": environment.get("started"),
    }


def said(found: Iterable[Mapping[str, Any]], most: int = 12) -> list[str]:
    """Changes in words, some of many."""
    lines = [f"  {each['what']}: {_short(each['a'])} -> {_short(each['b'])}" for each in found]
    rest = len(lines) - most
    return [*lines[:most], *([f"  and {rest} more (--json has all)"] if rest > 0 else [])]


def _short(value: Any) -> str:
    text = "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns of words, the first three to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i < 3 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def number(value: float | None) -> str:
    """Three digits, or a dash."""
    return "-" if value is None else f"{value:.3g}"
