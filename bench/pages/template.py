"""Jinja2 templates: HTML for pages (`.html`) and lines for the terminal (`.txt`).

Names and titles come from files and plugins. In HTML, a template writes them like any other text:
they are cleaned and escaped, and only `markupsafe.Markup` is written as it is.
"""

from __future__ import annotations

import shlex
import sys
import textwrap
from base64 import b64encode
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
from jinja2.bccache import Bucket, FileSystemBytecodeCache
from markupsafe import Markup, escape

from bench.pages.text_format import (
    append_unit,
    format_number,
    format_p_value,
    format_percent,
    format_significant,
    format_unit,
    joined,
    sanitise,
)
from sims.core.plain_values import align_columns, format_count

if TYPE_CHECKING:
    import pandas as pd
    from jinja2 import Environment, Template


TEMPLATES = Path(__file__).parent / "templates"
"""Folder of the templates that all pages share."""
MAX_TEXT_LENGTH = 2000
"""Maximum number of characters of a text, unless its template asks for fewer."""
MAX_DOCUMENT_LENGTH = 6000
"""Maximum number of characters of a text of several lines, unless its template asks for more."""
CELL_SEPARATOR = "¦"
"""Separator of the cells in a line of a table that a text template aligns."""


def load_template(path: Path) -> Template:
    """Load a template, compiled."""
    return _get_environment(path.suffix == ".html").get_template(str(path))


def render_text(path: Path, **values: Any) -> list[str]:
    """Render a text template.

    Args:
        path: Template with the suffix ``.txt``.
        **values: Values of the template.

    Returns:
        Lines of the text.
    """
    return load_template(path).render(**values).removesuffix("\n").split("\n")


@cache
def _get_environment(is_html: bool = True) -> Environment:
    """Create the Jinja2 environment of all pages, or of all texts, with the project's filters.

    A name that the template does not get is an error (`StrictUndefined`), not an empty text.
    Compiled templates are cached on disk.

    Args:
        is_html: whether to escape and clean every text that a template writes.
    """
    # Commands that write no page do not load Jinja2.
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    environment = Environment(
        loader=FunctionLoader(_read_template),
        bytecode_cache=CompiledTemplates(TEMPLATES / "__pycache__"),
        autoescape=is_html,
        # Constant folding takes longer than it saves for a page that is rendered once.
        optimized=False,
        finalize=_clean if is_html else None,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "call": lambda value, function: function(value),
        "base64": lambda data: Markup(b64encode(data).decode("ascii")),
        "columns": align_cells,
        "count": format_count,
        "document": format_document,
        "fill": textwrap.fill,
        "frame": format_frame,
        "joined": joined,
        "number": format_number,
        "one_line": lambda text: " ".join(text.split()),
        "p_value": format_p_value,
        "percent": format_percent,
        "shell": quote_words,
        "short": sanitise,
        "significant": format_significant,
        "unit": format_unit,
        "with_unit": append_unit,
    }
    environment.tests["finite"] = is_finite
    environment.globals["separator"] = _make_list_separator
    return environment


def is_finite(value: float | None) -> bool:
    """Return whether a value is a finite number."""
    return value is not None and isfinite(value)


def _make_list_separator(loop: Any) -> Markup:
    """Return the separator after a name of a list, such as ``a, b and c``.

    Args:
        loop: Jinja2's loop over the names.
    """
    return Markup({0: "", 1: " and "}.get(loop.revindex0, ", "))


def _read_template(name: str) -> str:
    """Read a template: one of `TEMPLATES` by its name, any other by its absolute path."""
    return (TEMPLATES / name).read_text(encoding="utf-8")


def _clean(value: object) -> object:
    """Prepare a value for output: clean text of control characters, and write nothing for None."""
    if value is None:
        return ""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    # A non-breaking space keeps a number and its percent sign on one line.
    return sanitise(value, MAX_TEXT_LENGTH).replace(" %", "\u00a0%")


def align_cells(text: str, left_columns: int) -> str:
    """Align the cells of a table for a terminal.

    Args:
        text: Lines whose cells are separated by `CELL_SEPARATOR`.
        left_columns: Number of columns, from the first one, that are left-justified.
    """
    rows = [line.split(CELL_SEPARATOR) for line in text.strip("\n").split("\n")]
    return "\n".join(align_columns(rows, left_columns)) + "\n"


def format_frame(frame: pd.DataFrame, spec: str) -> str:
    """Format a table of numbers for a terminal, without names of its axes.

    Args:
        frame: Table with the names of its rows as index.
        spec: Format of its numbers, such as ``.2g``.
    """
    unnamed: pd.DataFrame = frame.rename_axis(index=None, columns=None)
    text: str = unnamed.to_string(float_format=lambda value: f"{value:{spec}}")
    return text


def quote_words(words: Iterable[object]) -> Markup:
    """Format a command with its words quoted for a shell, as HTML.

    Line breaks and escape sequences in a path must not reach a terminal unchanged.
    """
    return escape(shlex.join(sanitise(word, 500) for word in words))


def format_document(text: str, max_length: int = MAX_DOCUMENT_LENGTH) -> Markup:
    """Format a text of several lines with its indentation, as HTML.

    Args:
        text: Text.
        max_length: Maximum number of characters.
    """
    shown = text if len(text) <= max_length else f"{text[:max_length]} …"
    lines = shown.strip("\n").replace("\t", "    ").split("\n")
    # `sanitise` removes leading spaces, so they are added again.
    indented = (" " * (len(line) - len(line.lstrip())) + sanitise(line, 1000) for line in lines)
    return escape("\n".join(indented))


class CompiledTemplates(FileSystemBytecodeCache):
    """Cache of compiled templates; without permission to write, they are compiled every time.

    Args:
        folder: Folder of the compiled templates.
    """

    def __init__(self, folder: Path) -> None:
        # Bytecode depends on the version of Python and on that of Jinja2.
        pattern = f"%s.{sys.implementation.cache_tag}-{jinja2.__version__}.bin"
        super().__init__(str(folder), pattern)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Store the compiled code of a template on disk, for reuse in the next process.

        Nothing is stored if Python may not write bytecode, or if the folder cannot be written to.

        Args:
            bucket: Jinja2's compiled template.
        """
        if not sys.dont_write_bytecode:
            with suppress(OSError):
                Path(self.directory).mkdir(exist_ok=True)
                super().dump_bytecode(bucket)
