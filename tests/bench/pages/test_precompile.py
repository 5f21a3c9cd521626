import sys

import jinja2

from bench.pages import template
from bench.pages.precompile import BENCH, precompile


def test_no_page_compiles_a_template_after_the_installation(tmp_path, monkeypatch):
    stored = template.CompiledTemplates(tmp_path)
    monkeypatch.setattr(template, "CompiledTemplates", lambda _: stored)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    template._get_environment.cache_clear()
    try:
        precompile()
        templates = [*BENCH.rglob("*.html"), *BENCH.rglob("*.txt")]
        assert len(list(tmp_path.iterdir())) == len(templates) > 10
        template._get_environment.cache_clear()
        monkeypatch.setattr(jinja2.Environment, "compile", None)
        names = {p.name if p.parent == template.TEMPLATES else str(p) for p in templates}
        for name in names:
            environment = template._get_environment(name.endswith(".html"))
            assert environment.get_template(name).name == name
    finally:
        template._get_environment.cache_clear()
