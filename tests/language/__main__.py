"""Check the language of the repository: `python -m tests.language [FOLDER ...]`.

Exit code 1 if a number of findings exceeds the one in `remaining.csv`, otherwise 0.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.language.checks import Glossary, check_subjects, check_tree
from tests.language.ratchet import (
    REMAINING,
    count_findings,
    get_group,
    load_remaining,
    update_remaining,
)

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("bench", "methods", "sims", "examples", "tests", "docs", "simgap.py", "README.md")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the findings that exceed the accepted numbers and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.language", description=__doc__)
    parser.add_argument("folders", nargs="*", default=FOLDERS, help="folders or files below --root")
    parser.add_argument("--root", type=Path, default=ROOT, help="root of the tree to check")
    parser.add_argument("--since", metavar="REF", help="check subjects of commits after REF")
    parser.add_argument("--all", action="store_true", help="print the remaining findings too")
    parser.add_argument("--update", action="store_true", help="lower the numbers, never raise one")
    parser.add_argument("--remaining", type=Path, default=REMAINING, help="file of the numbers")
    options = parser.parse_args(arguments)
    if options.update and tuple(options.folders) != FOLDERS:
        parser.error("--update: expected no folders, because it counts the whole repository")

    glossary = Glossary.load()
    findings = check_tree(options.root, options.folders, glossary)
    findings += check_subjects(options.root, options.since)
    findings = glossary.drop_allowed(findings)
    counts = count_findings(findings)
    if options.update:
        update_remaining(counts, options.remaining)
    allowed = load_remaining(options.remaining)
    grown = {group for group, count in counts.items() if count > allowed.get(group, 0)}
    for finding in findings:
        if options.all or get_group(finding) in grown:
            print(finding)
    for group in sorted(grown):
        print(
            f"{' / '.join(group)}: expected at most {allowed.get(group, 0)}, found {counts[group]}"
        )
    new = sum(counts[group] - allowed.get(group, 0) for group in grown)
    print(f"{len(findings)} findings, {new} more than {options.remaining.name} allows")
    # Folders that were not checked have no findings, so only a check of all folders is compared.
    fewer = sum(max(number - counts.get(group, 0), 0) for group, number in allowed.items())
    if fewer and tuple(options.folders) == FOLDERS:
        print(
            f"{fewer} findings are gone: lower the numbers with python -m tests.language --update"
        )
    return 1 if grown else 0


if __name__ == "__main__":
    sys.exit(main())
