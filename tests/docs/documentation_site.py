"""Build the site: `python -m tests.docs.documentation_site`, which `make docs` calls.

site/html/index.html opens from the disk, without a server.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from tests.docs.documentation_pages import DOCS, ROOT
from tests.docs.example_folder import Stage

SHIM = "https://unpkg.com/iframe-worker/shim"
"""Address of the script that search needs without a server; the site generator loads it from the
network.
"""
LOCAL_SHIM = "assets/iframe-worker.js"
"""Address of the local copy of that script."""


def build(folder, run=False):
    """Build the site from the pages; raise an error for any fault on a page.

    Args:
        folder: output folder, recreated; `pages` and `html` are written below it.
        run: whether to run the notebooks.

    Returns:
        The folder of the built site.
    """
    shutil.rmtree(folder, ignore_errors=True)
    pages, built = folder / "pages", folder / "html"
    Stage(pages, run).every_page()
    shutil.copytree(DOCS / "assets", pages / "assets")
    settings = (DOCS / "zensical.toml").read_text(encoding="utf-8")
    settings = settings.replace('"ROOT"', f"'{ROOT}'")
    (folder / "zensical.toml").write_text(settings, encoding="utf-8")
    tool = Path(sys.executable).with_name("zensical")
    subprocess.run([tool, "build", "--clean", "--strict"], cwd=folder, check=True)
    for page in built.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        if SHIM in text:
            up = "../" * len(page.relative_to(built).parent.parts)
            page.write_text(text.replace(SHIM, up + LOCAL_SHIM), encoding="utf-8")
    return built


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--notebooks", action="store_true", help="run them and show what they show")
    print(build(ROOT / "site", parser.parse_args().notebooks) / "index.html")
