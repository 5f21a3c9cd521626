"""The register of numbers that no table of the repository backs: `once.toml`.

Every page below docs/ is in it, section by section: how its numbers came about (a command that
measures them again, or that they are no measurements), and the numbers themselves, in order. A
number that is added, changed or taken away makes a test fail until it is entered here:

    python -m tests.docs.page_numbers.stated_once

writes the numbers anew and keeps what is said of each section; what is new has nothing said of it
yet, which a test finds too. Better than an entry is a table below results/reference and a sentence
that is held against it (`expected_sentences.py`).
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
"""A program of the repository that is named."""
HEAD = """# Numbers on pages below docs/ that no table backs, by page and section: how they came
# about, and what they are. `python -m tests.docs.page_numbers.stated_once` writes it; `from` \
is yours.

"""
WIDTH = 120


def accounts():
    """The pages, with what tables are known to hold accounted for."""
    known = {
        account.path: account for account in (make() for make in expected_sentences.PAGES.values())
    }
    pages = sorted(DOCS.glob("*.md"))
    return [known.get(page) or Account(page.relative_to(ROOT)) for page in pages]


def found():
    """By page and section the numbers that nothing else accounts for."""
    by_page = {account.path.name: account.left_by_section() for account in accounts()}
    return {page: sections for page, sections in by_page.items() if sections}


def registered():
    """The same as the register has them: by page and section ``from`` and ``numbers``."""
    return read_toml(REGISTER)


def faults(pages, register):
    """Where pages and register differ, a line each.

    Args:
        pages: of `found`.
        register: of `registered`.
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
    """The first number that is not as it was."""
    place = next(
        (i for i, pair in enumerate(zip(then, now, strict=False)) if pair[0] != pair[1]),
        min(len(then), len(now)),
    )
    was, has = (" ".join(numbers[place : place + 3]) or "nothing" for numbers in (then, now))
    return f"number {place + 1} was {was!r}, and is {has!r}"


def text(pages, register):
    """The register with today's numbers, and what it said of each section."""
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
