"""The pages that are written from the code are what the code says now."""

import pytest

from tests.docs.generate import COMMAND, PAGES
from tests.docs.pages import text_of


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_what_the_code_says(name):
    assert text_of(name) == PAGES[name](), f"docs/{name} is stale; renew it with: {COMMAND}"
