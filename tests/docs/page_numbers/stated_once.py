"""Maintain the register `once.toml` of the numbers on pages that no table supports.

The register has every page by section: the source of the numbers (a command that measures them, or
a note that they are not measurements), and the numbers in order. A test fails when a number on a
page changes, until the register is updated with

    python -m tests.docs.page_numbers.stated_once

The program rewrites the numbers and keeps the sources. A new section has an empty source, which a
test reports too. Prefer a table below results/reference and a mark (`inserted_numbers.py`).
"""

import re
import textwrap
from pathlib import Path

import tomli_w

from sims.core.toml_validation import read_toml
from tests.docs.documentation_pages import DOCS, FENCE, ROOT, pages
from tests.docs.page_numbers.inserted_numbers import NUMBER, list_inserted_spans

REGISTER = Path(__file__).with_name("once.toml")
COMMAND = re.compile(r"python -m (tests\.[\w.]+)")
"""Pattern of a command that runs a program of the repository."""
NO_TEXT = re.compile(
    r"`[^`\n]*`|\]\([^)]*\)|<!-- results -->(?:.|\n)*?<!-- /results -->|<!--(?:.|\n)*?-->|"
    r"^#+ .*$|^\d+\. |95 %\s+interval",
    re.M,
)
"""Pattern of text that makes no statement: code, addresses, results of an exam, comments, headings,
list numbers, interval levels.
"""
HEADING = re.compile(r"^#+ (.*)$", re.M)
HEAD = """# Numbers on pages that no table backs, by page and section: how they came
# about, and what they are. `python -m tests.docs.page_numbers.stated_once` writes it; `from` \
is yours.

"""
WIDTH = 120
REFERENCE_PAGES = (
    "", "ball-drop-video", "bounce-shot", "exam", "multi", "next-recording", "real",
    "real/datasheets", "robots", "tunenet-study",
)  # fmt: skip
"""Folders below results/reference whose README.md is registered."""


def registered_pages():
    """Return the pages whose numbers are registered, by their name in the register."""
    below = {page.name: page for page in pages() if page.parent == DOCS}
    results = [Path("results/reference", name, "README.md") for name in REFERENCE_PAGES]
    return below | {str(path): ROOT / path for path in (Path("README.md"), *results)}


def find_numbers():
    """Return the numbers that no table supports, by page and section."""
    texts = {name: page.read_text(encoding="utf-8") for name, page in registered_pages().items()}
    by_page = {name: numbers_by_section(text) for name, text in texts.items()}
    return {name: sections for name, sections in by_page.items() if sections}


def numbers_by_section(text):
    """Return the numbers of a page that are not inserted, by the heading above them."""
    fenced = [match.span() for match in FENCE.finditer(text)]
    spans = [*fenced, *list_inserted_spans(text)]
    spans += [match.span() for match in NO_TEXT.finditer(text)]
    # A comment in a code block looks like a heading.
    heads = [(m.start(), m[1]) for m in HEADING.finditer(text)]
    heads = [(at, name) for at, name in heads if not any(a <= at < b for a, b in fenced)]
    sections = {}
    for number in NUMBER.finditer(text):
        begin, end = number.span()
        if not any(a <= begin and end <= b for a, b in spans):
            above = [name for at, name in heads if at < begin]
            sections.setdefault(above[-1] if above else "", []).append(number[0])
    return sections


def read_register():
    """Return the register: ``from`` and ``numbers`` by page and section."""
    return read_toml(REGISTER)


def find_differences(found, register):
    """Return the differences between pages and register, one line each.

    Args:
        found: result of `find_numbers`.
        register: result of `read_register`.
    """
    lines = []
    for page in sorted({*found, *register}):
        sections, entries = found.get(page, {}), register.get(page, {})
        for name in dict.fromkeys([*sections, *entries]):
            entry = entries.get(name, {"from": "", "numbers": ""})
            now, then = sections.get(name, []), entry["numbers"].split()
            if now != then:
                lines.append(f"{page}, {name!r}: {_first_change(then, now)}")
            elif not entry["from"]:
                lines.append(f"{page}, {name!r}: the source of its numbers is missing")
            for module in COMMAND.findall(entry["from"]):
                path = ROOT / module.replace(".", "/")
                if not (path.with_suffix(".py").exists() or (path / "__main__.py").exists()):
                    lines.append(f"{page}, {name!r}: there is no {module}")
    return lines


def _first_change(then, now):
    """Describe the first number that has changed."""
    place = next(
        (i for i, pair in enumerate(zip(then, now, strict=False)) if pair[0] != pair[1]),
        min(len(then), len(now)),
    )
    was, has = (" ".join(numbers[place : place + 3]) or "nothing" for numbers in (then, now))
    return f"number {place + 1} was {was!r}, and is {has!r}"


def format_register(found, register):
    """Return the text of the register with the present numbers and the registered sources."""
    document = {}
    for page, sections in found.items():
        for name, numbers in sections.items():
            source = register.get(page, {}).get(name, {}).get("from", "")
            lines = textwrap.wrap(" ".join(numbers), WIDTH)
            entry = {"from": source, "numbers": "\n".join([*lines, ""])}
            document.setdefault(page, {})[name] = entry
    return HEAD + tomli_w.dumps(document, multiline_strings=True)


def main():
    register = read_register() if REGISTER.exists() else {}
    found = find_numbers()
    REGISTER.write_text(format_register(found, register), encoding="utf-8")
    for line in find_differences(found, read_register()):
        print(line)


if __name__ == "__main__":
    main()
