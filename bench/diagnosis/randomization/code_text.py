"""Parts of generated Python code that contain names from files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from bench.pages.text_format import sanitise
from sims.extended_simulator import ExtendedSimulator

WIDTH = 96
"""Maximum number of characters of a comment line."""


def literal(text: str) -> str:
    """Format text from a file as an ASCII Python literal that cannot end early or become code."""
    plain = not {"'", '"'} & set(text)
    return f'"{ascii(text)[1:-1]}"' if plain else ascii(text)


def number(value: float) -> str:
    """Format a number as a Python literal with nine digits."""
    return repr(float(f"{value:.9g}"))


def comment(text: str, indent: str = "") -> Iterator[str]:
    """Yield the lines of a comment; line breaks and control characters in names are escaped.

    Args:
        text: Text of the comment.
        indent: Indentation of the lines.
    """
    words = sanitise(text, 2000).split(" ")
    line = f"{indent}#"
    for word in words:
        if len(line) + 1 + len(word) > WIDTH and line != f"{indent}#":
            yield line
            line = f"{indent}#"
        line += f" {word}"
    yield line


def identifiers(names: Iterable[str]) -> Iterator[str]:
    """Yield an identifier for each name that differs from all earlier ones."""
    used: set[str] = set()
    for name in names:
        base = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "range"
        base = base if base[0].isalpha() else f"n_{base}"
        found, count = base, 1
        while found in used:
            count += 1
            found = f"{base}_{count}"
        used.add(found)
        yield found


def heading(extended: ExtendedSimulator, framework: str, left_out: Iterable[str]) -> Iterator[str]:
    """Yield the first lines of a file: its origin, and the ranges that are left out.

    Args:
        extended: Extended simulator with the numbers.
        framework: Name of the framework.
        left_out: Reasons for ranges that are left out.
    """
    model = extended.robot.path.name if extended.robot is not None else extended.system
    yield from comment(
        f"Domain randomisation for {framework}, written by simgap explain --ranges: robot "
        f"{model}, recording {extended.title}."
    )
    yield from comment(
        "Each range is the 95 % interval of a number of the model file with the causes that were "
        "found: how well this recording determines it, not how robots of one kind differ."
    )
    for line in left_out:
        yield from comment(f"Left out: {line}.")
