"""Parts of generated Python code that contain names from files."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.pages.text_format import sanitise
from sims.extended_simulator import ExtendedSimulator

COMMENT_WIDTH = 96
"""Maximum number of characters of a comment line."""


def literal(text: str) -> str:
    """Format text from a file as an ASCII Python literal that cannot end early or become code."""
    has_no_quotes = not {"'", '"'} & set(text)
    return f'"{ascii(text)[1:-1]}"' if has_no_quotes else ascii(text)


def number(value: float) -> str:
    """Format a number as a Python literal with nine digits."""
    return repr(float(f"{value:.9g}"))


def comment(texts: str | Sequence[str], indent: str = "") -> str:
    """Format comments; line breaks and control characters in names are escaped.

    Args:
        texts: Text of a comment, or of several.
        indent: Indentation of the lines.
    """
    begin = f"{indent}# "
    lines: list[str] = []
    for text in [texts] if isinstance(texts, str) else texts:
        sanitised_text = sanitise(text, 2000)
        lines += textwrap.wrap(
            sanitised_text, COMMENT_WIDTH, initial_indent=begin, subsequent_indent=begin,
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
    return "\n".join(lines)


def identifiers(names: Iterable[str]) -> Iterator[str]:
    """Yield an identifier for each name that differs from all earlier ones."""
    used_identifiers: set[str] = set()
    for name in names:
        base = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "range"
        base = base if base[0].isalpha() else f"n_{base}"
        identifier, count = base, 1
        while identifier in used_identifiers:
            count += 1
            identifier = f"{base}_{count}"
        used_identifiers.add(identifier)
        yield identifier


def list_heading(extended: ExtendedSimulator, framework: str, left_out: Iterable[str]) -> list[str]:
    """List the comments at the beginning of a file: its origin, and ranges that are left out.

    Args:
        extended: Extended simulator with the numbers.
        framework: Name of the framework.
        left_out: Reasons for ranges that are left out.
    """
    model = extended.robot.path.name if extended.robot is not None else extended.system
    return [
        f"Domain randomisation for {framework}, written by simgap explain --ranges: robot "
        f"{model}, recording {extended.title}.",
        "Each range is the 95 % interval of a number of the model file with the causes found. "
        "It states how well this recording determines the number, not how robots of one type "
        "differ.",
        *(f"Left out: {line}." for line in left_out),
    ]


def render_code(name: str, **values: Any) -> str:
    """Render a template of this folder as Python code.

    Args:
        name: File name of the code; the template has the suffix ``.jinja``.
        **values: Values of the template.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "comment": comment,
        "literal": literal,
        "number": number,
        "variable": lambda field: field.replace(".", "_"),
    }
    source = Path(__file__).with_name(f"{name}.jinja").read_text(encoding="utf-8")
    return environment.from_string(source).render(**values).rstrip() + "\n"
