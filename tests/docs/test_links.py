"""Tests that links between pages and to headings are valid, and that the index lists every page."""

import re

import pytest

from tests.docs.documentation_pages import DOCS, FENCE, LINK, ROOT, anchors, pages


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_links_exist(page):
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    broken = []
    for _, link in LINK.findall(text):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


PLACE = re.compile(r"`((?:bench|docs|examples|methods|results|sims|tests)/[\w./*-]*)`")
"""Pattern of a project file or folder on a page."""


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_files_that_a_page_names_exist(page):
    named = PLACE.findall(page.read_text(encoding="utf-8"))
    made = {"results/train/", "results/inspect/"}  # written by commands
    # Names in capitals are placeholders for the reader.
    fixed = [n for n in named if n not in made and not re.search("[A-Z]{4}", n)]
    assert [name for name in fixed if not [*ROOT.glob(name)]] == []


def test_every_page_below_docs_is_in_the_index():
    listed = {
        (index.parent / link.partition("#")[0]).resolve()
        for index in (DOCS / "index.md", DOCS / "decisions" / "index.md")
        for _, link in LINK.findall(index.read_text(encoding="utf-8"))
    }
    there = {p.resolve() for p in pages() if DOCS in p.parents and p.name != "index.md"}
    assert there <= listed, f"not in docs/index.md: {sorted(p.name for p in there - listed)}"
