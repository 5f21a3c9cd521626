"""Tests that the pages below docs/ agree with the tables, and that every number has a source."""

import copy

import pytest

from tests.benchmarks.identified_robots import identified
from tests.docs.page_numbers import expected_sentences
from tests.docs.page_numbers.number_sources import Account
from tests.docs.page_numbers.source_tables import rows
from tests.docs.page_numbers.stated_once import REGISTER, faults, found, registered, text


@pytest.fixture(scope="module")
def pages():
    return found()


@pytest.mark.parametrize("name", expected_sentences.PAGES)
def test_every_number_that_a_table_has_is_that_of_the_table(name):
    assert expected_sentences.PAGES[name]().wrong == []


def test_of_every_other_number_the_register_says_where_it_is_from(pages):
    told_how = (
        "a table and a sentence in told.py, or `python -m tests.docs.page_numbers.stated_once`"
    )
    assert faults(pages, registered()) == [], told_how
    assert {"tunenet.md", "engines.md", "performance.md", "scale.md", "sysid.md"} <= set(pages)


def test_the_register_is_as_its_program_writes_it(pages):
    assert REGISTER.read_text(encoding="utf-8") == text(pages, registered())


def test_a_number_that_is_new_changed_or_gone_is_a_fault(pages):
    page, (name, numbers) = "scale.md", next(iter(pages["scale.md"].items()))
    for changed in ([*numbers, "7"], ["8", *numbers[1:]], numbers[:-1]):
        (fault,) = faults({**pages, page: {name: changed}}, registered())
        assert fault.startswith(f"{page}, {name!r}: number ")
    (fault,) = faults({**pages, "new.md": {"Speed": ["3"]}}, registered())
    assert fault == "new.md, 'Speed': number 1 was 'nothing', and is '3'"
    gone = {key: value for key, value in pages.items() if key != page}
    assert faults(gone, registered()) != []


def test_an_entry_without_an_origin_or_with_a_program_that_is_gone_is_a_fault(pages):
    register = copy.deepcopy(registered())
    (entry,) = register["scale.md"].values()
    entry["from"] = ""
    assert "where its numbers are from is not said" in faults(pages, register)[0]
    entry["from"] = "measured once, by `python -m tests.benchmarks.gone`"
    assert faults(pages, register) == [
        "scale.md, 'How far a comparison scales': there is no tests.benchmarks.gone"
    ]


def test_numbers_stand_below_their_heading_and_code_has_none():
    page = Account("README.md", "1 a\n\n# One\n\n2\n\n```sh\n# Three\n4\n```\n5\n\n## Six\n\n7 8\n")
    page.known("7", "of the test")
    assert page.left_by_section() == {"": ["1"], "One": ["2", "5"], "Six": ["8"]}


def test_what_data_identify_comes_out_again():
    for row in identified("pendulum-swing", 20):
        kept = rows("multi/identified.csv", experiment="pendulum-swing", range=row["range"])
        for column in ("stiffest", "sloppiest"):
            assert kept[column].item() == pytest.approx(row[column], rel=1e-3)
        assert kept["stiff"].item() == row["stiff"]
        assert kept["made_of"].item() == row["made_of"]
