"""Maintain the register `once.toml` of the numbers on pages that no table supports.

The register has every page below docs/ by section: the source of the numbers (a command that
measures them, or a note that they are not measurements), and the numbers in order. A test fails
when a number on a page changes, until the register is updated with

    python -m tests.docs.page_numbers.stated_once

The program rewrites the numbers and keeps the sources. A new section has an empty source, which a
test reports too. Prefer a table below results/reference and a sentence that is compared with it
(`expected_sentences.py`).
"""

import re
import textwrap
from pathlib import Path

import tomli_w

from sims.core.toml_validation import read_toml
from tests.docs.documentation_pages import DOCS, ROOT
from tests.docs.page_numbers import expected_sentences
from tests.docs.page_numbers.number_sources import Account

REGISTER = Path(__file__).with_name("once.toml")
COMMAND = re.compile(r"python -m (tests\.[\w.]+)")
"""Pattern of a command that runs a program of the repository."""
HEAD = """# Numbers on pages below docs/ that no table backs, by page and section: how they came
# about, and what they are. `python -m tests.docs.page_numbers.stated_once` writes it; `from` \
is yours.

"""
WIDTH = 120


def accounts():
    """Return the pages after their numbers from tables have been checked."""
    known = {
        account.path: account for account in (make() for make in expected_sentences.PAGES.values())
    }
    pages = sorted(DOCS.glob("*.md"))
    return [known.get(page) or Account(page.relative_to(ROOT)) for page in pages]


def found():
    """Return the numbers that no table supports, by page and section."""
    by_page = {account.path.name: account.left_by_section() for account in accounts()}
    return {page: sections for page, sections in by_page.items() if sections}


def registered():
    """Return the register: ``from`` and ``numbers`` by page and section."""
    return read_toml(REGISTER)


def faults(pages, register):
    """Return the differences between pages and register, one line each.

    Args:
        pages: result of `found`.
        register: result of `registered`.
    """
    wrong = []
    for page in sorted({*pages, *register}):
        sections, entries = pages.get(page, {}), register.get(page, {})
        for name in dict.fromkeys([*sections, *entries]):
            entry = entries.get(name, {"from": "", "numbers": ""})
            now, then = sections.get(name, []), entry["numbers"].split()
            if now != then:
                wrong.append(f"{page}, {name!r}: {_changed(then, now)}")
            elif not entry["from"]:
                wrong.append(f"{page}, {name!r}: where its numbers are from is not said")
            for module in COMMAND.findall(entry["from"]):
                path = ROOT / module.replace(".", "/")
                if not (path.with_suffix(".py").exists() or (path / "__main__.py").exists()):
                    wrong.append(f"{page}, {name!r}: there is no {module}")
    return wrong


def _changed(then, now):
    """Describe the first number that has changed."""
    place = next(
        (i for i, pair in enumerate(zip(then, now, strict=False)) if pair[0] != pair[1]),
        min(len(then), len(now)),
    )
    was, has = (" ".join(numbers[place : place + 3]) or "nothing" for numbers in (then, now))
    return f"number {place + 1} was {was!r}, and is {has!r}"


def text(pages, register):
    """Return the text of the register with the present numbers and the registered sources."""
    document = {}
    for page, sections in pages.items():
        for name, numbers in sections.items():
            said = register.get(page, {}).get(name, {}).get("from", "")
            lines = textwrap.wrap(" ".join(numbers), WIDTH)
            entry = {"from": said, "numbers": "\n".join([*lines, ""])}
            document.setdefault(page, {})[name] = entry
    return HEAD + tomli_w.dumps(document, multiline_strings=True)


def main():
    register = registered() if REGISTER.exists() else {}
    REGISTER.write_text(text(found(), register), encoding="utf-8")
    for line in faults(found(), registered()):
        print(line)


if __name__ == "__main__":
    main()
