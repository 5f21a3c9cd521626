"""Check the language of the repository: `python -m tests.language [FOLDER ...]`.

Exit code 1 if there are findings, otherwise 0.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.language.checks import Glossary, check_subjects, check_tree

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("bench", "methods", "sims", "examples", "tests", "docs", "simgap.py", "README.md")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the findings and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.language", description=__doc__)
    parser.add_argument("folders", nargs="*", default=FOLDERS, help="folders or files below --root")
    parser.add_argument("--root", type=Path, default=ROOT, help="root of the tree to check")
    parser.add_argument("--since", metavar="REF", help="check subjects of commits after REF")
    options = parser.parse_args(arguments)
    glossary = Glossary.load()
    findings = check_tree(options.root, options.folders, glossary)
    findings += check_subjects(options.root, options.since)
    findings = glossary.drop_allowed(findings)
    for finding in findings:
        print(finding)
    print(f"{len(findings)} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
