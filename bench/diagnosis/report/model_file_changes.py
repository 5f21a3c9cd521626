"""Differences between the user's model file and the extended one, for the report.

Both files are split into elements, tags and comments, so that line breaks do not count.
"""

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
_ELEMENT = re.compile(r"<!--.*?-->|<[^>]*>", re.DOTALL)
_TAG_NAME = re.compile(r"<(\w+)")
_NAME_ATTRIBUTE = re.compile(r"\bname\s*=\s*[\"']([^\"']*)")
"""Patterns of a comment, a tag or comment, the name of a tag, and its attribute `name`."""


def find_model_file_changes(before: str, after: str) -> tuple[ModelFileChange, ...]:
    """Find the changed lines of a model file, in its order.

    The files are compared element by element. If hardly anything is equal, the file was rewritten
    (for example from another format): then the elements with a comment are the changes.

    Args:
        before: Text of the file; empty if there is none of the same format.
        after: Text of the extended file, where comments precede the elements that they describe.
    """
    old_elements, new_elements = _split_into_elements(before), _split_into_elements(after)
    matcher = SequenceMatcher(None, old_elements, new_elements, autojunk=False)
    if matcher.ratio() < MIN_UNCHANGED_SHARE:
        return tuple(_list_commented_elements(new_elements))
    changes: list[ModelFileChange] = []
    for kind, old_begin, old_end, new_begin, new_end in matcher.get_opcodes():
        if kind != "equal":
            changes += _compare_blocks(
                old_elements[old_begin:old_end], new_elements[new_begin:new_end]
            )
    return tuple(changes)


def _split_into_elements(text: str) -> list[str]:
    """Split the text into tags and comments, whatever the line breaks."""
    return [" ".join(part.split()) for part in _ELEMENT.findall(text)]


def _compare_blocks(old: Sequence[str], new: Sequence[str]) -> Iterator[ModelFileChange]:
    """Yield the changes of a block of elements, each with the comments before it.

    With equal counts, each new element replaces the old one at its position. Otherwise the first
    new element stands for all old ones; a block without new elements was removed.

    Args:
        old: lines of the block in the user's file, one for each element.
        new: lines of the block in the extended file, with comments before elements.
    """
    elements = list(_pair_with_comments(new))
    lines_before = list(old)
    if len(old) != len(elements):
        # All old elements stand before the first new one.
        lines_before = ["\n".join(old), *[""] * (len(elements) - 1)]
    if elements:
        for line_before, (line, comment) in zip(lines_before, elements, strict=True):
            yield ModelFileChange(_format_element(line), line_before, line, comment)
    # The block was removed.
    elif old:
        yield ModelFileChange(_format_element(old[0]), "\n".join(old), "")


def _list_commented_elements(lines: Sequence[str]) -> Iterator[ModelFileChange]:
    """Yield the elements with a comment, of a rewritten file."""
    for line, comment in _pair_with_comments(lines):
        if comment:
            yield ModelFileChange(_format_element(line), "", line, comment)


def _pair_with_comments(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each XML element (a line) with the comments before it that explain a fitted value.

    Args:
        lines: tags and comments of the file, one each; a comment precedes its element.
    """
    comments: list[str] = []
    for line in lines:
        match = _COMMENT.fullmatch(line)
        if match is None:
            yield line, "; ".join(comments)
            comments = []
        # Other comments, such as one on the whole file, do not describe the next element.
        elif FITTED_COMMENT_MARKER in match[1]:
            comments.append(match[1])


def _format_element(line: str) -> str:
    """Format the element of a line of XML, such as ``joint elbow``."""
    head, name = _TAG_NAME.search(line), _NAME_ATTRIBUTE.search(line)
    return " ".join(match[1] for match in (head, name) if match)
