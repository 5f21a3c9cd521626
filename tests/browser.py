"""Open pages in headless Chromium, collect their errors, and check accessibility with axe."""

import os
import shutil
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
REQUIRED = "SIMGAP_BROWSER"
"""Environment variable that makes a missing browser a failure instead of a skip, as in CI."""
WIDTHS = (1280, 400)


def chromium():
    """Return the path of the browser, or an empty string if none is installed."""
    return os.environ.get("SIMGAP_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), "")


@contextmanager
def launched():
    """Start a browser for a whole test session."""
    path = chromium()
    if not path:
        says = f"no browser: expected one of {', '.join(NAMES)} on PATH; apt-get install chromium"
        if os.environ.get(REQUIRED):
            pytest.fail(says)
        pytest.skip(says)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Root in a container has no sandbox, and all pages opened here are local files.
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


class Opened:
    """An HTML file opened in a browser.

    Attributes:
        page: the Playwright page.
        complaints: console errors and warnings, script errors, and requests to other addresses.
    """

    def __init__(self, browser, path, address="", width=1280, **options):
        self.context = browser.new_context(
            viewport={"width": width, "height": 900}, accept_downloads=True, **options
        )
        self.page = self.context.new_page()
        self.complaints = []
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.complaints.append(f"script: {error}"))
        self.page.on("request", self._request)
        self.page.goto(f"{path.resolve().as_uri()}{address}")

    def _console(self, message):
        if message.type in ("error", "warning"):
            self.complaints.append(f"console: {message.text}")

    def _request(self, request):
        if not request.url.startswith(("file:", "data:", "blob:")):
            self.complaints.append(f"request: {request.url}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.context.close()

    def text(self, selector):
        return self.page.locator(selector).first.inner_text()

    def state(self):
        """Return the fragment of the page's address (after `#`)."""
        return self.page.evaluate("decodeURIComponent(location.hash.slice(1))")

    def overflow(self):
        """Return the number of pixels by which the page is wider than the screen."""
        return self.page.evaluate("document.documentElement.scrollWidth - innerWidth")

    def saved(self, act):
        """Return the name and the bytes of the file that the action `act` downloads."""
        with self.page.expect_download() as waiting:
            act()
        download = waiting.value
        with open(download.path(), "rb") as file:
            return download.suggested_filename, file.read()

    def barriers(self):
        """Return the serious and critical accessibility violations that axe finds."""
        from axe_playwright_python.sync_playwright import Axe

        found = Axe().run(self.page).response["violations"]
        return [
            f"{one['id']}: {node['html'][:200]}"
            for one in found
            if one["impact"] in ("serious", "critical")
            for node in one["nodes"]
        ]
