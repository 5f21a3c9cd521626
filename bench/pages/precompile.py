"""Compile the templates of all pages during installation.

The first command that writes a page then need not compile them. `make install` runs `python -m
bench.pages.precompile`.
"""

from __future__ import annotations

from pathlib import Path

from bench.pages.template import TEMPLATES, load_template

BENCH = Path(__file__).parents[1]
"""Folder of all packages that have templates."""


def precompile() -> None:
    """Load each template once, so that its byte code is stored."""
    for path in sorted([*BENCH.rglob("*.html"), *BENCH.rglob("*.txt")]):
        # Shared templates are included by name, and the name is part of the key of the cache.
        load_template(Path(path.name) if path.parent == TEMPLATES else path)


if __name__ == "__main__":
    precompile()
