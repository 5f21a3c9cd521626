"""What stands on the pages: fenced blocks, tables, links and headings."""

import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LINK = re.compile(r"(!?\[[^\]]*\])\(([^)\s]+)\)")
"""A link or a picture: what is shown, and where it leads."""
FENCE = re.compile(r"^```(?P<language>\w*) ?(?P<name>[^\n`]*)\n(?P<text>.*?)^```$", re.M | re.S)


def pages():
    """The Markdown pages of the project."""
    below = [ROOT.glob("*.md")]
    below += [(ROOT / name).rglob("*.md") for name in ("docs", "sims", "results/reference")]
    return sorted(page for found in below for page in found)


@cache
def anchors(page):
    """The anchors that GitHub gives to a page's headings, in order."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found = []
    for heading in re.findall(r"^#+ (.*)$", text, re.M):
        # Lower case, spaces as hyphens, all other marks away; a second one of a name is numbered.
        words = re.sub(r"[^\w\- ]", "", LINK.sub("", heading).lower()).replace(" ", "-")
        found.append(f"{words}-{found.count(words)}" if words in found else words)
    return found


def text_of(page):
    """The text of a page below docs/."""
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(text, language=None):
    """Fenced blocks, (name, text) each; the name stands behind the language."""
    found = [m for m in FENCE.finditer(text) if language in (None, m["language"])]
    return [(m["name"], m["text"]) for m in found]


def section(text, heading):
    """What stands below a heading, up to the next of its rank."""
    # A heading of the same or a higher rank ends what stands below this one.
    marks = heading.split(" ")[0]
    start = f"\n{text}".index(f"\n{heading}\n") + len(heading) + 1
    end = re.search(rf"^#{{1,{len(marks)}}} ", text[start:], re.M)
    return text[start : start + end.start()] if end else text[start:]


def tables(text):
    """Each table as a list of rows, each a list of cells; the header is the first row."""
    found = [[]]
    # Blocks of code may hold lines that begin like a table.
    for line in FENCE.sub("", text).splitlines():
        if line.startswith("|"):
            # A bar behind a backslash is a bar, not the end of a cell.
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            if not all(set(cell) <= set("-:") for cell in cells):
                found[-1].append(cells)
        elif found[-1]:
            found.append([])
    return [table for table in found if table]


def quoted(cell):
    """What stands in backquotes in a cell."""
    return re.findall(r"`([^`]+)`", cell)
