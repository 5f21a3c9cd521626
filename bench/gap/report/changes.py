"""The lines of a robot's model file that its extended one has otherwise."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher

from bench.gap.report.story import Change

ALIKE = 0.5
"""Share of elements that stay: where fewer do, the file was written anew, with no lines before."""
FITTED = ", fitted to "
"""What a comment says that names a cause."""
_COMMENT = re.compile(r"<!--\s*(.*?)\s*-->")
_PART = re.compile(r"<!--.*?-->|<[^>]*>", re.DOTALL)
_HEAD = re.compile(r"<(\w+)")
_NAME = re.compile(r"\bname\s*=\s*[\"']([^\"']*)")


def changes(before: str, after: str) -> tuple[Change, ...]:
    """The changed lines of a model file, in its order; those with a comment alone where the file
    was written anew.

    Args:
        before: text of the file; empty where there is none of the same form.
        after: text of the extended one, in which a comment stands above what it changes.
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
    """Tags and comments, one each, however they lie on lines."""
    return [" ".join(part.split()) for part in _PART.findall(text)]


def _block(old: Sequence[str], new: Sequence[str]) -> Iterator[Change]:
    """Lines that stand instead of others, each with the comments above it."""
    elements = list(_with_comments(new))
    # As many as before: each stands instead of the one at its place.
    if len(old) != len(elements):
        for i, (line, comment) in enumerate(elements):
            yield Change(_element(line), "\n".join(old) if i == 0 else "", line, comment)
        if not elements and old:
            yield Change(_element(old[0]), "\n".join(old), "")
        return
    for line_before, (line, comment) in zip(old, elements, strict=True):
        yield Change(_element(line), line_before, line, comment)


def _commented(lines: Sequence[str]) -> Iterator[Change]:
    """The elements with a comment, of a file that was written anew."""
    for line, comment in _with_comments(lines):
        if comment:
            yield Change(_element(line), "", line, comment)


def _with_comments(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Each line that is no comment, with the comments above it."""
    above: list[str] = []
    for line in lines:
        if match := _COMMENT.fullmatch(line):
            # A comment on the whole file says nothing of the element below it.
            above += [match[1]] if FITTED in match[1] else []
            continue
        yield line, "; ".join(above)
        above = []


def _element(line: str) -> str:
    """``joint elbow`` of a line of XML."""
    head, name = _HEAD.search(line), _NAME.search(line)
    return " ".join(match[1] for match in (head, name) if match)
