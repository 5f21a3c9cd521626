"""Differences between two settings, environments or other trees of plain values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

FAMILYWISE_ERROR_RATE = 0.05
"""Familywise error rate: probability of any false alarm among all comparisons."""
_MAX_CHANGES = 12
"""Maximum number of changes that are printed."""
RESULT_RELEVANT_KEYS = ("simgap", "python", "platform", "machine", "stepping", "seals", "packages")
"""Keys of an environment that may influence the results."""


def find_changes(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Find the differences between two trees of values.

    Args:
        a: first tree.
        b: second tree.

    Returns:
        For each dotted key that differs, the values in both; None where the key does not exist.
    """
    flat_a, flat_b = dict(_flatten_table(a)), dict(_flatten_table(b))
    return [
        {"what": key, "a": flat_a.get(key), "b": flat_b.get(key)}
        for key in sorted({*flat_a, *flat_b})
        if flat_a.get(key) != flat_b.get(key)
    ]


def _flatten_table(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables, each with its path such as ``noise.q``.

    `prefix` is the path of the table with its final dot. A tuple becomes a list, so that it equals
    the list read from a file.
    """
    for key, item in value.items():
        if isinstance(item, Mapping):
            yield from _flatten_table(item, f"{prefix}{key}.")
        elif isinstance(item, list | tuple):
            yield f"{prefix}{key}", list(item)
        else:
            yield f"{prefix}{key}", item


def select_relevant_environment(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Select the part of an environment that may influence results, with the hash of the code."""
    selected = {key: environment[key] for key in RESULT_RELEVANT_KEYS if key in environment}
    code = environment.get("fingerprint", {}).get("code")
    return {**selected, **({"code": code} if code else {})}


def describe_side(folder: Any, name: str, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Describe one of the two compared results.

    Args:
        folder: its folder.
        name: its name.
        environment: its environment.
    """
    return {
        "folder": folder,
        "name": name,
        "simgap": environment.get("simgap", ""),
        "started": environment.get("started"),
    }


def format_changes(changes: Iterable[Mapping[str, Any]]) -> list[str]:
    """Format changes as text lines, at most `_MAX_CHANGES` of them.

    Args:
        changes: the changes.
    """
    lines = [
        f"  {each['what']}: {_shorten_text(each['a'])} -> {_shorten_text(each['b'])}"
        for each in changes
    ]
    remaining_count = len(lines) - _MAX_CHANGES
    return [
        *lines[:_MAX_CHANGES],
        *([f"  and {remaining_count} more (--json has all)"] if remaining_count > 0 else []),
    ]


def _shorten_text(value: Any) -> str:
    text = "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def format_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align columns of texts: the first three to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i < 3 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def format_number(value: float | None) -> str:
    """Format a number with three digits; None as a dash."""
    return "-" if value is None else f"{value:.3g}"
