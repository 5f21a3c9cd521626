"""Jinja2 templates of HTML pages: text is escaped, cleaned and shortened wherever it is written.

Names and titles come from files and plugins. A template writes them like any other text; only
`markupsafe.Markup` is written as it is.
"""

from __future__ import annotations

import marshal
import os
import shlex
import sys
from base64 import b64encode
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType
from typing import TYPE_CHECKING

import jinja2
from jinja2.bccache import Bucket, BytecodeCache
from markupsafe import Markup, escape

from bench.pages.text_format import format_number, format_p_value, format_percent, sanitise

if TYPE_CHECKING:
    from jinja2 import Environment, Template


TEMPLATES = Path(__file__).parent / "templates"
"""Folder of the templates that all pages share."""
MAX_TEXT_LENGTH = 2000
"""Maximum number of characters of a text, unless its template asks for fewer."""
MAX_DOCUMENT_LENGTH = 6000
"""Maximum number of characters of a text of several lines, unless its template asks for more."""


def load_template(path: Path) -> Template:
    """Load a template, compiled."""
    return _get_environment().get_template(str(path))


@cache
def _get_environment() -> Environment:
    """Create the Jinja2 environment of all pages, with escaping and the project's filters.

    A name that the template does not get is an error (`StrictUndefined`), not an empty text.
    Compiled templates are cached on disk.
    """
    # Commands that write no page do not load Jinja2.
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    environment = Environment(
        loader=FunctionLoader(_read_template),
        bytecode_cache=CompiledTemplates(TEMPLATES / "__pycache__"),
        autoescape=True,
        # Constant folding takes longer than it saves for a page that is rendered once.
        optimized=False,
        finalize=_clean,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "base64": lambda data: Markup(b64encode(data).decode("ascii")),
        "document": format_document,
        "number": format_number,
        "p_value": format_p_value,
        "percent": format_percent,
        "shell": quote_words,
        "short": sanitise,
    }
    return environment


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


class CompiledTemplates(BytecodeCache):
    """Cache of compiled templates; without permission to write, they are compiled every time.

    Args:
        folder: Folder of the compiled templates.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load the code of a template, if it was compiled from the same source."""
        with suppress(OSError, ValueError, EOFError, TypeError):
            content = self._get_path(bucket).read_bytes()
            checksum = bucket.checksum.encode()
            code = marshal.loads(content[len(checksum) :]) if content.startswith(checksum) else None
            bucket.code = code if isinstance(code, CodeType) else None

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Store the compiled code of a template on disk, for reuse in the next process."""
        if sys.dont_write_bytecode or bucket.code is None:
            return
        path = self._get_path(bucket)
        # Another process may load the file while it is written.
        temporary = path.with_suffix(f".{os.getpid()}")
        with suppress(OSError):
            self._folder.mkdir(exist_ok=True)
            temporary.write_bytes(bucket.checksum.encode() + marshal.dumps(bucket.code))
            temporary.replace(path)

    def _get_path(self, bucket: Bucket) -> Path:
        # Bytecode depends on the version of Python and on that of Jinja2.
        name = f"{bucket.key}.{sys.implementation.cache_tag}-{jinja2.__version__}"
        return self._folder / f"{name}.bin"
