"""Jinja2 templates: HTML for pages (`.html`) and lines for the terminal (`.txt`).

Names and titles come from files and plugins. In HTML, a template writes them like any other text:
they are cleaned and escaped, and only `markupsafe.Markup` is written as it is.
"""

from __future__ import annotations

import sys
import textwrap
from base64 import b64encode
from contextlib import suppress
from functools import cache
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
from jinja2.bccache import Bucket, FileSystemBytecodeCache
from markupsafe import Markup

from bench.pages.text_format import (
    align_cells,
    append_unit,
    format_document,
    format_frame,
    format_number,
    format_p_value,
    format_percent,
    format_significant,
    format_unit,
    joined,
    quote_words,
    sanitise,
)
from sims.core.user_messages import format_count

if TYPE_CHECKING:
    from jinja2 import Environment, Template


TEMPLATES = Path(__file__).parent / "templates"
"""Folder of the templates that all pages share."""
MAX_TEXT_LENGTH = 2000
"""Maximum number of characters of a text, unless its template asks for fewer."""


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
