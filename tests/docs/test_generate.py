"""The pages that are written from the code are what the code says now."""

import pytest

from tests.docs.generate import COMMAND, PAGES, ROWS, row_schema
from tests.docs.pages import ROOT, text_of


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_what_the_code_says(name):
    assert text_of(name) == PAGES[name](), f"docs/{name} is stale; renew it with: {COMMAND}"


@pytest.mark.parametrize("name", ROWS)
def test_the_schema_of_a_row_is_what_the_columns_say(name):
    path = ROOT / "bench" / "schemas" / f"{name}.schema.json"
    assert path.read_text() == row_schema(name), f"{path} is stale; renew it with: {COMMAND}"
