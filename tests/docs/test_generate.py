"""Tests that the generated pages and schemas are up to date with the code."""

import pytest

import simgap
from tests.docs import documented_names, tuner_table
from tests.docs.documentation_pages import ROOT, text_of
from tests.docs.generate_pages import COMMAND, PAGES, ROWS, row_schema


@pytest.mark.parametrize("name", PAGES)
def test_the_generated_page_is_up_to_date(name):
    assert text_of(name) == PAGES[name](), f"docs/{name} is stale; renew it with: {COMMAND}"


@pytest.mark.parametrize("name", ROWS)
def test_the_row_schema_agrees_with_the_columns(name):
    path = ROOT / "bench" / "schemas" / f"{name}.schema.json"
    assert path.read_text() == row_schema(name), f"{path} is stale; renew it with: {COMMAND}"


def test_every_public_name_is_on_its_page():
    public = {name for name in dir(simgap) if name in simgap.__all__}
    assert set(documented_names.listed()) | documented_names.UNDOCUMENTED == public


def test_every_tuner_is_on_its_page():
    page = text_of("reference/tuners.md")
    assert len(tuner_table.registered()) > 12
    assert [name for name, *_ in tuner_table.registered() if f"`{name}`" not in page] == []


def test_every_equation_is_rendered_once_and_used():
    page = text_of("reference/tuners.md")
    assert [words for words, latex in tuner_table.SET.items() if latex not in page] == []


def test_a_changed_equation_must_be_rendered_again():
    with pytest.raises(KeyError, match="EI = f"):
        list(tuner_table.paragraphs("With m the mean:\n\n    (1)  EI = f - m"))
