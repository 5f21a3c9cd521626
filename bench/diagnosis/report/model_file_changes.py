"""Changed lines between a robot's model file and the extended model file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher

from bench.diagnosis.report.report_data import ModelFileChange

MIN_UNCHANGED_SHARE = 0.5
"""Minimum share of unchanged elements; with fewer, the file counts as rewritten and old lines are
not shown.
"""
FITTED_COMMENT_MARKER = ", fitted to "
"""Text that marks comments about a cause."""
_COMMENT = re.compile(r"<!--\s*(.*?)\s*-->")
_PART = re.compile(r"<!--.*?-->|<[^>]*>", re.DOTALL)
_HEAD = re.compile(r"<(\w+)")
_NAME = re.compile(r"\bname\s*=\s*[\"']([^\"']*)")


def find_model_file_changes(before: str, after: str) -> tuple[ModelFileChange, ...]:
    """Find the changed lines of a model file, in its order.

    For a rewritten file, these are the elements with a comment.

    Args:
        before: Text of the file; empty if there is none of the same format.
        after: Text of the extended file, where comments precede the elements that they describe.
    """
    old_elements, new_elements = _split_into_elements(before), _split_into_elements(after)
    matcher = SequenceMatcher(None, old_elements, new_elements, autojunk=False)
    if matcher.ratio() < MIN_UNCHANGED_SHARE:
        return tuple(_list_commented_elements(new_elements))
    changes: list[ModelFileChange] = []
    for kind, i1, i2, j1, j2 in matcher.get_opcodes():
        if kind != "equal":
            changes += _compare_blocks(old_elements[i1:i2], new_elements[j1:j2])
    return tuple(changes)


def _split_into_elements(text: str) -> list[str]:
    """Split the text into tags and comments, whatever the line breaks."""
    return [" ".join(part.split()) for part in _PART.findall(text)]


def _compare_blocks(old: Sequence[str], new: Sequence[str]) -> Iterator[ModelFileChange]:
    """Yield the changes of a block of elements, each with the comments before it."""
    elements = list(_pair_with_comments(new))
    # With equal counts, each new element replaces the old one at its position.
    if len(old) != len(elements):
        for i, (line, comment) in enumerate(elements):
            yield ModelFileChange(
                _format_element(line), "\n".join(old) if i == 0 else "", line, comment
            )
        if not elements and old:
            yield ModelFileChange(_format_element(old[0]), "\n".join(old), "")
        return
    for line_before, (line, comment) in zip(old, elements, strict=True):
        yield ModelFileChange(_format_element(line), line_before, line, comment)


def _list_commented_elements(lines: Sequence[str]) -> Iterator[ModelFileChange]:
    """Yield the elements with a comment, of a rewritten file."""
    for line, comment in _pair_with_comments(lines):
        if comment:
            yield ModelFileChange(_format_element(line), "", line, comment)


def _pair_with_comments(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each XML element (a line) with the comments before it that explain a fitted value."""
    comments: list[str] = []
    for line in lines:
        if match := _COMMENT.fullmatch(line):
            # A comment on the whole file does not describe the next element.
            comments += [match[1]] if FITTED_COMMENT_MARKER in match[1] else []
            continue
        yield line, "; ".join(comments)
        comments = []


def _format_element(line: str) -> str:
    """Format the element of a line of XML, such as ``joint elbow``."""
    head, name = _HEAD.search(line), _NAME.search(line)
    return " ".join(match[1] for match in (head, name) if match)
