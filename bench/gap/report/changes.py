"""Changed lines between a robot's model file and the extended model file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher

from bench.gap.report.story import Change

ALIKE = 0.5
"""Minimum share of unchanged elements; with fewer, the file counts as rewritten and old lines are
not shown.
"""
FITTED = ", fitted to "
"""Text that marks comments about a cause."""
_COMMENT = re.compile(r"<!--\s*(.*?)\s*-->")
_PART = re.compile(r"<!--.*?-->|<[^>]*>", re.DOTALL)
_HEAD = re.compile(r"<(\w+)")
_NAME = re.compile(r"\bname\s*=\s*[\"']([^\"']*)")


def changes(before: str, after: str) -> tuple[Change, ...]:
    """Find the changed lines of a model file, in its order.

    For a rewritten file, these are the elements with a comment.

    Args:
        before: Text of the file; empty if there is none of the same format.
        after: Text of the extended file, where comments precede the elements that they describe.
    """
    old, new = _elements(before), _elements(after)
    matcher = SequenceMatcher(None, old, new, autojunk=False)
    if matcher.ratio() < ALIKE:
        return tuple(_commented(new))
    found: list[Change] = []
    for kind, i1, i2, j1, j2 in matcher.get_opcodes():
        if kind != "equal":
            found += _block(old[i1:i2], new[j1:j2])
    return tuple(found)


def _elements(text: str) -> list[str]:
    """Split the text into tags and comments, whatever the line breaks."""
    return [" ".join(part.split()) for part in _PART.findall(text)]


def _block(old: Sequence[str], new: Sequence[str]) -> Iterator[Change]:
    """Yield the changes of a block of elements, each with the comments before it."""
    elements = list(_with_comments(new))
    # With equal counts, each new element replaces the old one at its position.
    if len(old) != len(elements):
        for i, (line, comment) in enumerate(elements):
            yield Change(_element(line), "\n".join(old) if i == 0 else "", line, comment)
        if not elements and old:
            yield Change(_element(old[0]), "\n".join(old), "")
        return
    for line_before, (line, comment) in zip(old, elements, strict=True):
        yield Change(_element(line), line_before, line, comment)


def _commented(lines: Sequence[str]) -> Iterator[Change]:
    """Yield the elements with a comment, of a rewritten file."""
    for line, comment in _with_comments(lines):
        if comment:
            yield Change(_element(line), "", line, comment)


def _with_comments(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each element with the comments before it."""
    above: list[str] = []
    for line in lines:
        if match := _COMMENT.fullmatch(line):
            # A comment on the whole file does not describe the next element.
            above += [match[1]] if FITTED in match[1] else []
            continue
        yield line, "; ".join(above)
        above = []


def _element(line: str) -> str:
    """Format the element of a line of XML, such as ``joint elbow``."""
    head, name = _HEAD.search(line), _NAME.search(line)
    return " ".join(match[1] for match in (head, name) if match)
