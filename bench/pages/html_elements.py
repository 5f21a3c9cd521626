"""HTML building blocks with escaping.

Text between tags must be safe already or be passed through `safe`.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape

from bench.pages.text_format import sanitise

NUMERIC_HEADING_PREFIX = "-"
"""Prefix of a table's column head that marks numbers, which are right-aligned."""


def safe(value: object, most: int = 400) -> str:
    """Escape a text from a file or plugin for the page, including attributes.

    Args:
        value: Value to write.
        most: Maximum length in characters.
    """
    # A non-breaking space keeps a number and its percent sign on one line.
    return escape(sanitise(value, most)).replace(" %", "\u00a0%")


def make_heading(text: str) -> str:
    """Return the head of a section."""
    return f"<h2>{text}</h2>"


def make_paragraph(content: str, kind: str = "") -> str:
    """Return a paragraph, optionally with a class of the style sheet.

    Args:
        content: Safe HTML.
        kind: Class of the style sheet; empty for none.
    """
    return f"<p{_of_class(kind)}>{content}</p>"


def make_strong(content: str) -> str:
    """Return emphasised text."""
    return f"<strong>{content}</strong>"


def make_code(content: str) -> str:
    """Return a registered name or a path as code."""
    return f"<code>{content}</code>"


def make_list(items: Iterable[str]) -> str:
    """Return a bulleted list."""
    return "<ul>" + "".join(f"<li>{item}</li>" for item in items) + "</ul>"


def make_table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = ()
) -> str:
    """Return a table of cells that are safe HTML already.

    Args:
        heads: Heads of the columns, see `NUMERIC_HEADING_PREFIX`.
        rows: Rows with as many cells.
        marks: Class of the style sheet for each row; empty for plain rows.
    """
    kinds = ["number" if head.startswith(NUMERIC_HEADING_PREFIX) else "" for head in heads]
    top = []
    for head, kind in zip(heads, kinds, strict=True):
        # The scope connects cells with their heads for screen readers.
        top.append(
            f'<th scope="col"{_of_class(kind)}>{head.removeprefix(NUMERIC_HEADING_PREFIX)}</th>'
        )
    body = []
    for row, mark in zip(rows, marks or [""] * len(rows), strict=True):
        cells = [f"<td{_of_class(k)}>{c}</td>" for c, k in zip(row, kinds, strict=True)]
        body.append(f"<tr{_of_class(mark)}>{''.join(cells)}</tr>")
    # A wide table scrolls separately, since a page that scrolls sideways is hard to read on a
    # phone.
    return "\n".join(
        [
            # With tabindex the table can get the focus and be scrolled by keyboard.
            '<div class="scroll" tabindex="0"><table>',
            f"<thead><tr>{''.join(top)}</tr></thead>",
            "<tbody>",
            *(body or [""]),
            "</tbody>",
            "</table></div>",
        ]
    )


def make_collapsible(head: str, content: str) -> str:
    """Return content that is shown after a click on its head.

    Args:
        head: Safe HTML.
        content: Safe HTML.
    """
    return f"<details>\n<summary>{head}</summary>\n{content}\n</details>"


def make_figure(png: bytes, alternative: str, caption: str) -> str:
    """Return an image embedded in the page, with its caption.

    Args:
        png: Bytes of the PNG file.
        alternative: Text description for readers who cannot see it; safe HTML.
        caption: Safe HTML.
    """
    # Embedded, so that a report remains one file when it is sent.
    data = b64encode(png).decode("ascii")
    image = f'<img src="data:image/png;base64,{data}" alt="{alternative}">'
    return f"<figure>\n{image}\n<figcaption>{caption}</figcaption>\n</figure>"


def make_bar(kind: str, share: float) -> str:
    """Return a bar that covers a share of its cell, 0 to 100 %.

    Args:
        kind: Class of the style sheet.
        share: Width in percent.
    """
    style = f"display:block;width:{share:.1f}%"
    return f'<span><span class="bar {kind}" style="{style}"></span></span>'


def make_iframe(html: str) -> str:
    """Embed a page in another one as a sandboxed frame.

    Neither page's styles or scripts affect the other, and the frame's policy allows only its own
    script.
    """
    # Quotes are escaped, since a quote would end the attribute and the rest would become markup.
    source = escape(html, quote=True)
    style = "width: 100%; height: 46rem; border: 0"
    allowed = "allow-scripts allow-downloads"
    return f'<iframe title="report" sandbox="{allowed}" style="{style}" srcdoc="{source}"></iframe>'


def _of_class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
