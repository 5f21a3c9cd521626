"""Text of generated Python code: literals, comments and identifiers, and templates of code."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.pages.text_format import sanitise

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
        lines += textwrap.wrap(
            sanitise(text, 2000), COMMENT_WIDTH, initial_indent=begin, subsequent_indent=begin,
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
    return "\n".join(lines)


def identifiers(names: Iterable[str]) -> Iterator[str]:
    """Yield an identifier for each name, as valid in Python, that differs from all earlier ones.

    Other characters than letters and digits become underscores. Of equal identifiers, the second
    one gets the suffix ``_2``, and so on. An identifier that would begin with a digit gets the
    prefix ``n_``, and an empty one is ``range``.
    """
    used_identifiers: set[str] = set()
    for name in names:
        base = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "range"
        if not base[0].isalpha():
            base = f"n_{base}"
        identifier, count = base, 1
        while identifier in used_identifiers:
            count += 1
            identifier = f"{base}_{count}"
        used_identifiers.add(identifier)
        yield identifier


def render_code(template: Path, **values: Any) -> str:
    """Render a template as Python code, with filters for comments, literals and numbers.

    Args:
        template: Jinja template of the code.
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
    source = template.read_text(encoding="utf-8")
    return environment.from_string(source).render(**values).rstrip() + "\n"
