import sys

import jinja2

from bench.pages import html_page
from bench.pages.precompile import BENCH, precompile


def test_no_page_compiles_a_template_after_the_installation(tmp_path, monkeypatch):
    stored = html_page.CompiledTemplates(tmp_path)
    monkeypatch.setattr(html_page, "CompiledTemplates", lambda _: stored)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    html_page._get_environment.cache_clear()
    try:
        precompile()
        templates = list(BENCH.rglob("*.html"))
        assert len(list(tmp_path.iterdir())) == len(templates) == 10
        html_page._get_environment.cache_clear()
        monkeypatch.setattr(jinja2.Environment, "compile", None)
        names = {p.name if p.parent == html_page.TEMPLATES else str(p) for p in templates}
        for name in names:
            assert html_page._get_environment().get_template(name).name == name
    finally:
        html_page._get_environment.cache_clear()
