"""Compare the numbers of a page with tables.

Every number must come from a table, or be listed with a reason why it does not. A sentence is given
with `{}` in place of its numbers, and with the expected values. A number agrees with a value that
rounds to it, with the digits that the page has. Tests report numbers that no sentence and no table
covers, so a number cannot be added or changed unnoticed.
"""

import math
import re

from tests.docs.documentation_pages import FENCE, ROOT

NUMBER = re.compile(r"(?<![\w.,/-])[-−]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w]|-\w)")
"""Pattern of a number; digits in names such as UR5 or squash-018 do not match."""
NO_TEXT = re.compile(
    r"`[^`\n]*`|\]\([^)]*\)|<!--(?:.|\n)*?-->|^#+ .*$|^\d+\. |95 %\s+interval", re.M
)
"""Pattern of text that makes no statement: code, addresses, comments, headings, list numbers,
interval levels.
"""


TABLE = re.compile(r"(?:^ *\|.*\n?)+", re.M)
LINE = re.compile(r"^.+$", re.M)
HEADING = re.compile(r"^#+ (.*)$", re.M)


class Account:
    """Numbers of a page and the results of their checks.

    Attributes:
        path: file of the page.
        text: text of the page.
        held: positions (begin, end) of the numbers that have been checked.
        wrong: disagreements, one line each.
    """

    def __init__(self, path, text=None):
        self.path = ROOT / path
        self.text = self.path.read_text(encoding="utf-8") if text is None else text
        self.held = set()
        self.wrong = []

    def says(self, sentence, *values):
        """Check that the page has this sentence once, with numbers that agree with the values."""
        found = self._found(sentence)
        if found is None:
            return
        groups = found.re.groups
        for place, value in zip(range(1, groups + 1), values, strict=True):
            self._hold(found.span(place), value)

    def known(self, sentence, why):
        """Accept the numbers of a sentence that come from no table, for the reason `why`."""
        found = self._found(sentence)
        if found is None:
            return
        numbers = {number.span() for number in NUMBER.finditer(self.text, *found.span())}
        self.held |= numbers
        if not numbers or not why:
            self.wrong.append(f"has no number, or it has no reason: {sentence!r}")

    def written(self, text):
        """Check that the page has every line of a text that was generated from the tables."""
        lines = {line.group(): line.span() for line in LINE.finditer(self.text)}
        for line in filter(None, text.splitlines()):
            if line not in lines:
                self.wrong.append(f"has no line: {line!r}")
                continue
            self.held.update(n.span() for n in NUMBER.finditer(self.text, *lines[line]))

    def table(self, header, value, place=0):
        """Check that the page has a table with this header line and with cells that agree.

        Args:
            header: first cells of the header, as on the page.
            place: index among the tables with this header.
            value: function of a row (cells by heading) and a heading; it returns the expected
                numbers of that cell in order, or None for a cell that is not checked.

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
        """Return the numbers that have not been checked, each with the surrounding text."""
        found = []
        for number in self._untold():
            about = self.text[max(0, number.start() - 40) : number.end() + 20]
            found.append((number[0], " ".join(about.split())))
        return found

    def left_by_section(self):
        """Return the unchecked numbers by the heading above them."""
        fenced = [m.span() for m in FENCE.finditer(self.text)]
        heads = [(m.start(), m[1]) for m in HEADING.finditer(self.text)]
        # A comment in a code block looks like a heading.
        heads = [(at, name) for at, name in heads if not any(a <= at < b for a, b in fenced)]
        found = {}
        for number in self._untold():
            above = [name for at, name in heads if at < number.start()]
            found.setdefault(above[-1] if above else "", []).append(number[0])
        return found

    def _untold(self):
        """Yield the matches of unchecked numbers."""
        nothing = [m.span() for m in NO_TEXT.finditer(self.text)]
        nothing += [m.span() for m in FENCE.finditer(self.text)]
        spans = sorted([*nothing, *self.held])
        for number in NUMBER.finditer(self.text):
            begin, end = number.span()
            if not any(a <= begin and end <= b for a, b in spans):
                yield number

    def _hold(self, span, value):
        """Compare the number at a position with a value."""
        self.held.add(span)
        number = self.text[slice(*span)]
        if not agrees(number, value):
            words = " ".join(self.text[max(0, span[0] - 60) : span[1] + 20].split())
            self.wrong.append(f"says {number} where the tables have {value!r}: ...{words}...")

    def _found(self, sentence):
        """Find a sentence on the page, with its numbers as groups; line ends count as spaces."""
        parts = [r"\s+".join(map(re.escape, part.split(" "))) for part in sentence.split("{}")]
        found = list(re.finditer(f"({NUMBER.pattern}|[A-Za-z]+)".join(parts), self.text))
        if len(found) == 1:
            return found[0]
        self.wrong.append(f"has this {len(found)} times: {sentence!r}")
        return None


def lines_of(text, begin):
    """Return the lines of the table at a position, each as a list of cells (text, position)."""
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
"""Small numbers as words, from zero on."""


def agrees(text, value):
    """Return whether a written number equals a value rounded to the written digits."""
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
