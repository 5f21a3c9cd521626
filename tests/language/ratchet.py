"""Compare findings with `remaining.csv`, which has the accepted number of findings."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from tests.language.checks import Finding

REMAINING = Path(__file__).with_name("remaining.csv")
HEADER = ("check", "word", "folder", "findings")

Group = tuple[str, str, str]
"""Check, word or rule, and top-level folder."""


def get_group(finding: Finding) -> Group:
    """Return the group in which a finding is counted; the folder of top-level files is `.`."""
    folder = finding.path.split("/")[0] if "/" in finding.path else "."
    return finding.check, finding.rule, folder


def count_findings(findings: Iterable[Finding]) -> Counter[Group]:
    """Count findings by group."""
    return Counter(map(get_group, findings))


def load_remaining(path: Path = REMAINING) -> dict[Group, int]:
    """Load the number of allowed findings of each group; without a file, none are allowed."""
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {(row["check"], row["word"], row["folder"]): int(row["findings"]) for row in rows}


def update_remaining(counts: Mapping[Group, int], path: Path = REMAINING) -> None:
    """Lower the accepted numbers to the present counts, and never raise one.

    If the file does not exist, all present counts are written.
    """
    allowed = load_remaining(path) if path.is_file() else counts
    lowered = {group: min(number, counts.get(group, 0)) for group, number in allowed.items()}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows((*group, number) for group, number in sorted(lowered.items()) if number)
