"""Holds a page's numbers against tables: every number is one that a table has, or one of those
that are said to be known otherwise, with the reason.

A sentence is quoted with `{}` where a number stands, and the values it must have. A number agrees
with a value that rounds to it, to the digits that the page shows. What no sentence and no table
claimed is left over, and a test says so: a number cannot be added, or changed, unnoticed.
"""

import math
import re

from tests.docs.documentation_pages import FENCE, ROOT

NUMBER = re.compile(r"(?<![\w.,/-])[-−]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w]|-\w)")
"""A number of the text, not one of a name such as UR5 or squash-018."""
NO_TEXT = re.compile(
    r"`[^`\n]*`|\]\([^)]*\)|<!--(?:.|\n)*?-->|^#+ .*$|^\d+\. |95 %\s+interval", re.M
)
"""Code, addresses, comments, headings, counts of lists, the level of intervals: no statements."""


TABLE = re.compile(r"(?:^ *\|.*\n?)+", re.M)
LINE = re.compile(r"^.+$", re.M)
HEADING = re.compile(r"^#+ (.*)$", re.M)


class Account:
    """The numbers of a page, and which of them have been held against something.

    Attributes:
        path: the page.
        text: its text.
        held: where in the text stand numbers that were held against something: (begin, end).
        wrong: what did not agree, a line each.
    """

    def __init__(self, path, text=None):
        self.path = ROOT / path
        self.text = self.path.read_text(encoding="utf-8") if text is None else text
        self.held = set()
        self.wrong = []

    def says(self, sentence, *values):
        """The page has this sentence once, with numbers that agree with these values."""
        found = self._found(sentence)
        if found is None:
            return
        groups = found.re.groups
        for place, value in zip(range(1, groups + 1), values, strict=True):
            self._hold(found.span(place), value)

    def known(self, sentence, why):
        """The page has this sentence, whose numbers stand in no table, for a reason."""
        found = self._found(sentence)
        if found is None:
            return
        numbers = {number.span() for number in NUMBER.finditer(self.text, *found.span())}
        self.held |= numbers
        if not numbers or not why:
            self.wrong.append(f"has no number, or it has no reason: {sentence!r}")

    def written(self, text):
        """The page has every line of a text that a program wrote from the tables."""
        lines = {line.group(): line.span() for line in LINE.finditer(self.text)}
        for line in filter(None, text.splitlines()):
            if line not in lines:
                self.wrong.append(f"has no line: {line!r}")
                continue
            self.held.update(n.span() for n in NUMBER.finditer(self.text, *lines[line]))

    def table(self, header, value, place=0):
        """The page has a table that begins with this header line, and its cells agree.

        Args:
            header: the first cells, as the page has them.
            place: among the tables that begin so.
            value: of a row's cells by their headings and a heading: the values of the numbers of
                that cell, in order; None for a cell that is no statement.

        Returns:
            How many numbers were compared.
        """
        begins = [found.start() for found in re.finditer(re.escape(f"| {header}"), self.text)]
        names, _, *rows = lines_of(self.text, begins[place])
        headings = [text for text, _ in names]
        for text, start in names:
            here = NUMBER.finditer(self.text, start, start + len(text))
            self.held.update(number.span() for number in here)
        count = 0
        for row in rows:
            cells = dict(zip(headings, [text for text, _ in row], strict=True))
            for heading, (text, start) in zip(headings, row, strict=True):
                expected = value(cells, heading)
                numbers = list(NUMBER.finditer(self.text, start, start + len(text)))
                if expected is None:
                    continue
                if len(numbers) != len(expected):
                    self.wrong.append(f"{heading}: {text!r} where the tables have {expected}")
                for number, wanted in zip(numbers, expected, strict=False):
                    self._hold(number.span(), wanted)
                    count += 1
        return count

    def left(self):
        """Numbers that nothing was said of, each with the words about it."""
        found = []
        for number in self._untold():
            about = self.text[max(0, number.start() - 40) : number.end() + 20]
            found.append((number[0], " ".join(about.split())))
        return found

    def left_by_section(self):
        """The same numbers by the heading that they stand below, as the page has them."""
        fenced = [m.span() for m in FENCE.finditer(self.text)]
        heads = [(m.start(), m[1]) for m in HEADING.finditer(self.text)]
        # A comment in a block of code looks like a heading.
        heads = [(at, name) for at, name in heads if not any(a <= at < b for a, b in fenced)]
        found = {}
        for number in self._untold():
            above = [name for at, name in heads if at < number.start()]
            found.setdefault(above[-1] if above else "", []).append(number[0])
        return found

    def _untold(self):
        """Where numbers stand that nothing was said of."""
        nothing = [m.span() for m in NO_TEXT.finditer(self.text)]
        nothing += [m.span() for m in FENCE.finditer(self.text)]
        spans = sorted([*nothing, *self.held])
        for number in NUMBER.finditer(self.text):
            begin, end = number.span()
            if not any(a <= begin and end <= b for a, b in spans):
                yield number

    def _hold(self, span, value):
        """Hold the number that stands somewhere against a value."""
        self.held.add(span)
        number = self.text[slice(*span)]
        if not agrees(number, value):
            words = " ".join(self.text[max(0, span[0] - 60) : span[1] + 20].split())
            self.wrong.append(f"says {number} where the tables have {value!r}: ...{words}...")

    def _found(self, sentence):
        """Where the page has a sentence, its numbers as groups; line ends count as spaces."""
        parts = [r"\s+".join(map(re.escape, part.split(" "))) for part in sentence.split("{}")]
        found = list(re.finditer(f"({NUMBER.pattern}|[A-Za-z]+)".join(parts), self.text))
        if len(found) == 1:
            return found[0]
        self.wrong.append(f"has this {len(found)} times: {sentence!r}")
        return None


def lines_of(text, begin):
    """The lines of the table that stands somewhere, each a list of cells: (text, its place)."""
    rows = []
    begin = text.rfind("\n", 0, begin) + 1
    for line in TABLE.match(text, begin)[0].splitlines():
        cells, at = [], begin + line.index("|") + 1
        for cell in re.split(r"(?<!\\)\|", line)[1:-1]:
            inner = cell.strip()
            cells.append((inner, at + cell.index(inner) if inner else at))
            at += len(cell) + 1
        rows.append(cells)
        begin += len(line) + 1
    return rows


WORDS = "none one two three four five six seven eight nine ten eleven twelve"
"""Small numbers as words, from nothing on."""


def agrees(text, value):
    """Whether a number as it is written is a value, rounded to the digits that are shown."""
    if isinstance(value, str):
        return text == value
    if text.isalpha():
        return text.lower() in WORDS.split() and WORDS.split().index(text.lower()) == round(value)
    plain = text.replace(",", "").replace("−", "-")
    digits, _, power = plain.partition("e")
    last = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    if not math.isfinite(value):
        return False
    return abs(float(plain) - value) <= 0.5 * last * (1 + 1e-6) + 1e-15 * abs(value)
