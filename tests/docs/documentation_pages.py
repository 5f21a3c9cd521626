"""Read fenced blocks, tables, links and headings of the documentation pages."""

import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LINK = re.compile(r"(!?\[[^\]]*\])\(([^)\s]+)\)")
"""Pattern of a link or an image: displayed part and address."""
FENCE = re.compile(r"^```(?P<language>\w*) ?(?P<name>[^\n`]*)\n(?P<text>.*?)^```$", re.M | re.S)


def pages():
    """Return the Markdown pages of the project."""
    below = [ROOT.glob("*.md")]
    below += [(ROOT / name).rglob("*.md") for name in ("docs", "sims", "results/reference")]
    return sorted(page for found in below for page in found)


@cache
def anchors(page):
    """Return the anchors that GitHub gives to the headings of a page, in order."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found = []
    for heading in re.findall(r"^#+ (.*)$", text, re.M):
        # GitHub writes lower case, replaces spaces by hyphens, drops other marks, and numbers
        # repeated anchors.
        words = re.sub(r"[^\w\- ]", "", LINK.sub("", heading).lower()).replace(" ", "-")
        found.append(f"{words}-{found.count(words)}" if words in found else words)
    return found


def text_of(page):
    """Return the text of a page below docs/."""
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(text, language=None):
    """Return the fenced blocks as pairs (name, text); the name follows the language."""
    found = [m for m in FENCE.finditer(text) if language in (None, m["language"])]
    return [(m["name"], m["text"]) for m in found]


def section(text, heading):
    """Return the text below a heading, up to the next heading of the same or a higher level."""
    marks = heading.split(" ")[0]
    start = f"\n{text}".index(f"\n{heading}\n") + len(heading) + 1
    end = re.search(rf"^#{{1,{len(marks)}}} ", text[start:], re.M)
    return text[start : start + end.start()] if end else text[start:]


def tables(text):
    """Return each table as a list of rows of cells; the first row is the header."""
    found = [[]]
    # Code blocks may contain lines that look like table rows.
    for line in FENCE.sub("", text).splitlines():
        if line.startswith("|"):
            # An escaped bar belongs to the cell.
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            if not all(set(cell) <= set("-:") for cell in cells):
                found[-1].append(cells)
        elif found[-1]:
            found.append([])
    return [table for table in found if table]


def quoted(cell):
    """Return the texts in backquotes in a cell."""
    return re.findall(r"`([^`]+)`", cell)
