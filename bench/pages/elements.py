"""Pieces of HTML. What stands between tags is safe already, or has passed `safe` here."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape

from bench.pages.text import clean

NUMBERS = "-"
"""A table's head that begins with this is the head of numbers, which stand to the right."""


def safe(value: object, most: int = 400) -> str:
    """A text from a file or plugin, fit to stand in the page, in an attribute too."""
    # A number is not torn from its percent sign at the end of a line.
    return escape(clean(value, most)).replace(" %", "\u00a0%")


def heading(text: str) -> str:
    """The head of a section."""
    return f"<h2>{text}</h2>"


def paragraph(content: str, kind: str = "") -> str:
    """A paragraph, perhaps of a class of the style sheet."""
    return f"<p{_of_class(kind)}>{content}</p>"


def strong(content: str) -> str:
    """What a skimming eye should meet."""
    return f"<strong>{content}</strong>"


def code(content: str) -> str:
    """A registered name or a path."""
    return f"<code>{content}</code>"


def listed(items: Iterable[str]) -> str:
    """A list with dots."""
    return "<ul>" + "".join(f"<li>{item}</li>" for item in items) + "</ul>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = ()) -> str:
    """A table of cells that are safe already.

    Args:
        heads: of the columns, see `NUMBERS`.
        rows: of as many cells.
        marks: a class of the style sheet for each row; none at all for plain rows.
    """
    kinds = ["number" if head.startswith(NUMBERS) else "" for head in heads]
    top = []
    for head, kind in zip(heads, kinds, strict=True):
        # The scope ties cells to their heads for those who have the table read to them.
        top.append(f'<th scope="col"{_of_class(kind)}>{head.removeprefix(NUMBERS)}</th>')
    body = []
    for row, mark in zip(rows, marks or [""] * len(rows), strict=True):
        cells = [f"<td{_of_class(k)}>{c}</td>" for c, k in zip(row, kinds, strict=True)]
        body.append(f"<tr{_of_class(mark)}>{''.join(cells)}</tr>")
    # A wide table scrolls by itself, by keys too: the page must not, or its text could not be read
    # on a phone.
    return "\n".join(
        [
            # By keyboard it scrolls once it has the focus.
            '<div class="scroll" tabindex="0"><table>',
            f"<thead><tr>{''.join(top)}</tr></thead>",
            "<tbody>",
            *(body or [""]),
            "</tbody>",
            "</table></div>",
        ]
    )


def folded(head: str, content: str) -> str:
    """What is shown once its head is clicked on."""
    return f"<details>\n<summary>{head}</summary>\n{content}\n</details>"


def figure(png: bytes, alternative: str, caption: str) -> str:
    """A picture within the page itself, with its caption.

    Args:
        png: the picture.
        alternative: what it shows, for those who do not see it; safe.
        caption: safe.
    """
    # Within the page: a report that is sent to somebody stays one file.
    data = b64encode(png).decode("ascii")
    image = f'<img src="data:image/png;base64,{data}" alt="{alternative}">'
    return f"<figure>\n{image}\n<figcaption>{caption}</figcaption>\n</figure>"


def bar(kind: str, share: float) -> str:
    """A bar over so much of its cell, 0 to 100 %."""
    style = f"display:block;width:{share:.1f}%"
    return f'<span><span class="bar {kind}" style="{style}"></span></span>'


def framed(html: str) -> str:
    """A page as an element of another one: neither's styles nor scripts reach the other, and of
    scripts none runs but the page's own, by its policy.
    """
    # Quotes too: a bare one would end the attribute, and the rest would be the cell's markup.
    source = escape(html, quote=True)
    style = "width: 100%; height: 46rem; border: 0"
    allowed = "allow-scripts allow-downloads"
    return f'<iframe title="report" sandbox="{allowed}" style="{style}" srcdoc="{source}"></iframe>'


def _of_class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
