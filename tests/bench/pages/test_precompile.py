import sys

import jinja2

from bench.pages import page_template
from bench.pages.precompile import BENCH, precompile


def test_no_page_compiles_a_template_after_the_installation(tmp_path, monkeypatch):
    stored = page_template.CompiledTemplates(tmp_path)
    monkeypatch.setattr(page_template, "CompiledTemplates", lambda _: stored)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    page_template._get_environment.cache_clear()
    try:
        precompile()
        templates = list(BENCH.rglob("*.html"))
        assert len(list(tmp_path.iterdir())) == len(templates) == 10
        page_template._get_environment.cache_clear()
        monkeypatch.setattr(jinja2.Environment, "compile", None)
        names = {p.name if p.parent == page_template.TEMPLATES else str(p) for p in templates}
        for name in names:
            assert page_template._get_environment().get_template(name).name == name
    finally:
        page_template._get_environment.cache_clear()
