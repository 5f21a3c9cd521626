"""Insert numbers from tables into pages: ``python -m tests.docs.page_numbers.inserted_numbers``.

A page marks what is inserted; Markdown does not show the marks.

* A number: ``<!--= EXPRESSION -->0.12<!--/-->``.
* The numbers of a table's cells: ``<!-- cells: EXPRESSION -->`` in front of the table. The
  expression is a function from a row (cells by heading) and a heading to the numbers of the cell in
  order, or to None for a cell that is written by hand. An empty cell of the first column stands for
  the cell above it.
* Lines: ``<!-- lines: EXPRESSION -->`` up to ``<!-- /lines -->``.

Expressions use the names of `page_values`, `page_cells` and `diagnoser_board`. A number keeps its
text while it agrees with its value, rounded to the written digits.
"""

import math
import re
from itertools import pairwise

from tests.docs.documentation_pages import pages
from tests.docs.page_numbers import diagnoser_board, page_cells, page_values

NUMBER = re.compile(r"(?<![\w.,/-])[-−]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w]|-\w)")
"""Pattern of a number; digits in names such as UR5 or squash-018 do not match."""
INLINE = re.compile(r"<!--= (?P<source>.+?) -->(?P<text>.*?)<!--/-->")
CELLS = re.compile(r"<!-- cells: (?P<source>.+?) -->\n\n(?P<text>(?: *\|.*\n)+)")
LINES = re.compile(r"<!-- lines: (?P<source>.+?) -->\n\n(?P<text>.*?)\n<!-- /lines -->", re.S)
BAR = re.compile(r"(?<!\\)\|")
WORDS = "none one two three four five six seven eight nine ten eleven twelve".split()  # noqa: SIM905
NAMES = {**vars(page_values), **vars(page_cells), **vars(diagnoser_board)}


def insert_numbers(text):
    """Return the text of a page with the present numbers."""
    for pattern, insert in ((INLINE, _inline), (CELLS, _cells), (LINES, _lines)):
        text = pattern.sub(lambda match, insert=insert: _replace(match, insert), text)
    return text


def list_inserted_spans(text):
    """Return the positions (begin, end) of the numbers that are inserted."""
    spans = [match.span() for pattern in (INLINE, LINES) for match in pattern.finditer(text)]
    for match in CELLS.finditer(text):
        start = match.start("text")
        spans += [(start + a, start + b) for a, b, _ in _cell_numbers(match)]
        spans.append((start, text.index("\n", start)))
    return spans


def _replace(match, insert):
    """Return a mark with its new text."""
    begin, end = (place - match.start() for place in match.span("text"))
    return match[0][:begin] + insert(match) + match[0][end:]


def _value(match):
    return eval(match["source"], NAMES)


def _inline(match):
    return format_like(match["text"], _value(match))


def _lines(match):
    return "\n".join(_value(match)) + "\n"


def _cells(match):
    text = match["text"]
    for begin, end, value in reversed(_cell_numbers(match)):
        text = text[:begin] + format_like(text[begin:end], value) + text[end:]
    return text


def _cell_numbers(match):
    """Return (begin, end, value) of each inserted number of a table.

    Raises:
        ValueError: a cell has more numbers than values.
    """
    value_of, found = _value(match), []
    (heads, _), (_, _), *rows = list(table_rows(match["text"]))
    above = ""
    for texts, starts in rows:
        above = texts[0] or above
        row = dict(zip(heads, [above, *texts[1:]], strict=True))
        for place, (head, text, start) in enumerate(zip(heads, texts, starts, strict=True)):
            values = value_of(row | {"column": place}, head)
            numbers = list(NUMBER.finditer(text))
            if values is not None and len(numbers) > len(values):
                raise ValueError(f"{head}: {text!r} has more numbers than the tables: {values}")
            found += [
                (start + number.start(), start + number.end(), value)
                for number, value in zip(numbers, values or (), strict=False)
            ]
    return found


def table_rows(text):
    """Yield (cells, their positions) of each line of a Markdown table."""
    begin = 0
    for line in text.splitlines(keepends=True):
        bars = [bar.start() for bar in BAR.finditer(line)]
        cells = [line[a + 1 : b] for a, b in pairwise(bars)]
        starts = [
            begin + bar + 1 + len(cell) - len(cell.lstrip())
            for bar, cell in zip(bars, cells, strict=False)
        ]
        yield [cell.strip() for cell in cells], starts
        begin += len(line)


def format_like(text, value):
    """Format a value as a number is written; a text that agrees with it does not change."""
    if isinstance(value, str) or agrees(text, value):
        return value if isinstance(value, str) else text
    if text.isalpha():
        word = WORDS[round(value)]
        return word.capitalize() if text[0].isupper() else word
    mantissa, _, power = text.partition("e")
    digits = len(mantissa.partition(".")[2])
    if power:
        number = re.sub(r"e([+-])0*", lambda m: "e" + m[1].strip("+"), f"{value:.{digits}e}")
    else:
        number = f"{value:,.{digits}f}" if value >= 1000 else f"{value:.{digits}f}"
    return number.replace("-", "−") if "−" in text else number


def agrees(text, value):
    """Return whether a written number equals a value rounded to the written digits."""
    if text.isalpha():
        return text.lower() in WORDS and WORDS.index(text.lower()) == round(value)
    if not NUMBER.fullmatch(text) or not math.isfinite(value):
        return False
    plain = text.replace(",", "").replace("−", "-")
    digits, _, power = plain.partition("e")
    last = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    return abs(float(plain) - value) <= 0.5 * last * (1 + 1e-6) + 1e-15 * abs(value)


def main():
    for page in pages():
        text = page.read_text(encoding="utf-8")
        page.write_text(insert_numbers(text), encoding="utf-8")


if __name__ == "__main__":
    main()
