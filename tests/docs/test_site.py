"""Tests that the site builds without warnings, loads nothing from the network, and has
valid links.
"""

from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

import pytest

from tests.browser import WIDTHS, Opened
from tests.docs.documentation_pages import DOCS, pages
from tests.docs.documentation_site import build
from tests.docs.example_folder import Stage, place

tomllib = pytest.importorskip("tomllib")  # the site generator also needs Python 3.11 or newer
pytest.importorskip("zensical")

FETCHED = {
    "audio": "src",
    "iframe": "src",
    "img": "src",
    "link": "href",
    "script": "src",
    "source": "src",
    "video": "src",
}
"""Attributes whose address a browser loads by itself, by element."""


VERBATIM = {"code", "math", "pre", "script", "style"}
"""Elements whose text is not prose."""


class Page(HTMLParser):
    """IDs, links, loaded addresses, CSS classes and prose of a page of the site."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.links, self.fetched, self.classes = set(), [], [], set()
        self.words, self._inside = "", []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        if tag in VERBATIM:
            self._inside.append(tag)
        self.ids.add(named.get("id"))
        self.classes.update((named.get("class") or "").split())
        if tag == "a" and named.get("href"):
            self.links.append(named["href"])
        if named.get(FETCHED.get(tag)):
            self.fetched.append(named[FETCHED[tag]])

    def handle_endtag(self, tag):
        if tag in VERBATIM and self._inside:
            self._inside.pop()

    def handle_data(self, text):
        if not self._inside:
            self.words += text


def parsed(built):
    """Parse every page of a built site; the result is keyed by path."""
    return {file: Page(file.read_text(encoding="utf-8")) for file in built.rglob("*.html")}


def from_elsewhere(page):
    """Return the addresses that a page loads from the network."""
    return [address for address in page.fetched if urlsplit(address).netloc]


def lost(site):
    """Return broken links and images within a site as pairs (page, address)."""
    found = []
    for file, page in site.items():
        for address in [*page.links, *page.fetched]:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            there = target in site and parts.fragment in {"", *site[target].ids}
            if not there and (parts.fragment or not target.is_file()):
                found.append((file.name, address))
    return found


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Build the site with warnings as errors."""
    return build(tmp_path_factory.mktemp("docs") / "site")


@pytest.fixture(scope="module")
def site(built):
    """Return the parsed pages of the site, without the page for error 404."""
    there = parsed(built)
    return {file: page for file, page in there.items() if file.name != "404.html"}


@pytest.mark.slow
def test_the_site_requests_nothing_from_the_network(built, site):
    assert len(site) > 80
    assert {
        file.name: from_elsewhere(page) for file, page in site.items() if from_elsewhere(page)
    } == {}
    styles = [file.read_text(encoding="utf-8") for file in built.rglob("*.css")]
    assert styles
    assert not any("url(http" in style or "@import" in style for style in styles)
    # The generator's script loads resources from the network for pages with these classes.
    used = set().union(*(page.classes for page in site.values()))
    assert not used & {"mermaid", "glightbox", "pyodide"}


@pytest.mark.slow
def test_links_and_pictures_of_the_site_exist(site):
    assert sum(len(page.links) for page in site.values()) > 5000
    assert lost(site) == []


@pytest.mark.slow
@pytest.mark.parametrize("page", ["compare", "explain", "add-a-tuner", "verdicts", "start"])
def test_the_front_page_links_to_every_section(built, site, page):
    front = (built / "index.html").read_text(encoding="utf-8")
    cards = front[front.index('class="grid cards"') : front.index('id="one-page-a-task"')]
    assert f"{page}.html" in Page(cards).links


@pytest.mark.slow
def test_all_markdown_is_rendered(built, site):
    left = {"```", "](", "**", "{#", ":::"}
    found = {
        (file.name, mark)
        for file, page in site.items()
        if "source" not in file.relative_to(built).parts
        for mark in left
        if mark in page.words
    }
    assert found == set()


@pytest.mark.slow
def test_equations_are_rendered_without_a_script(built):
    page = (built / "reference" / "tuners.html").read_text(encoding="utf-8")
    assert page.count("<math") > 20


@pytest.mark.slow
def test_public_names_show_their_docstrings(built):
    page = (built / "reference" / "api.html").read_text(encoding="utf-8")
    assert "Everything that a tuner gets of one target" in page


@pytest.mark.slow
def test_sources_are_shown_and_not_searched(built):
    assert "class" in (built / "source" / "examples" / "puck.py.html").read_text(encoding="utf-8")
    assert "source/examples/puck" not in (built / "search.json").read_text(encoding="utf-8")


def test_every_page_is_in_the_navigation():
    settings = tomllib.loads((DOCS / "zensical.toml").read_text(encoding="utf-8"))

    def leaves(entry):
        """Return the pages below an entry."""
        if isinstance(entry, str):
            return [entry]
        inner = entry if isinstance(entry, list) else entry.values()
        return [page for part in inner for page in leaves(part)]

    listed = leaves(settings["project"]["nav"])
    notebooks = sorted((DOCS / "notebooks").glob("*.ipynb"))
    assert sorted(listed) == sorted(str(place(page)) for page in [*pages(), *notebooks])


# Tests of the helper functions with faulty pages.


def test_an_external_picture_is_found():
    assert from_elsewhere(
        Page('<img src="https://example.org/a.png"><a href="https://x.org">x</a>')
    )
    assert from_elsewhere(Page('<script src="//cdn.example.org/a.js"></script>'))
    assert not from_elsewhere(Page('<img src="a.png"><a href="https://example.org">x</a>'))


@pytest.mark.parametrize("address", ["gone.html", "there.html#gone", "#gone", "gone.png"])
def test_a_dead_link_is_found(tmp_path, address):
    (tmp_path / "there.html").write_text('<h1 id="here">a</h1>', encoding="utf-8")
    sound = '<a href="there.html#here">x</a><a href="https://example.org">x</a>'
    (tmp_path / "page.html").write_text(sound, encoding="utf-8")
    assert lost(parsed(tmp_path)) == []
    (tmp_path / "page.html").write_text(f'{sound}<a href="{address}">x</a>', encoding="utf-8")
    assert lost(parsed(tmp_path)) == [("page.html", address)]


def test_a_page_has_the_requested_layout(tmp_path):
    text = Stage(tmp_path).page(DOCS / "verdicts.md")
    assert "# What the verdicts mean {#what-the-verdicts-mean}" in text
    text = Stage(tmp_path).page(DOCS / "explain.md")
    assert "(sims/effects/index.md)" in text
    assert (tmp_path / "sims" / "effects" / "index.md").exists()


# Tests in a real browser.


@pytest.mark.slow
@pytest.mark.parametrize("name", ["index", "verdicts", "reference/tuners", "reference/api"])
@pytest.mark.parametrize("width", WIDTHS)
def test_a_page_works_without_a_server(browser, built, name, width):
    with Opened(browser, built / f"{name}.html", width=width) as opened:
        opened.page.wait_for_load_state("load")
        assert opened.complaints == []
        assert opened.overflow() <= 0


@pytest.mark.slow
def test_the_search_works_without_a_server(browser, built):
    with Opened(browser, built / "index.html") as opened:
        opened.page.keyboard.press("Control+k")
        opened.page.locator("input:focus").fill("eccentricity")
        results = opened.page.locator("a:visible", has_text="Causes and their places")
        results.last.click(timeout=10_000)  # the results of the page itself come first
        opened.page.wait_for_url("**/places.html*")
        assert opened.complaints == []


@pytest.mark.slow
def test_the_front_page_is_accessible(browser, built):
    with Opened(browser, built / "index.html") as opened:
        assert opened.barriers() == []
