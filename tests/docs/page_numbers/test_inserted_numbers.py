"""Tests that pages have the present numbers, and that every other number has a source."""

import copy

import pytest

from tests.benchmarks.identified_robots import identified
from tests.docs.documentation_pages import ROOT, pages
from tests.docs.page_numbers import page_values, stated_once
from tests.docs.page_numbers.inserted_numbers import agrees, format_like, insert_numbers
from tests.docs.page_numbers.stated_once import find_differences, numbers_by_section

TEXT = """# A page of 3 things

It takes <!--= 1600.4 -->1,600<!--/--> runs, <!--= 2 -->two<!--/--> of 4 in <!--= 0.00426 -->0.0043<!--/--> s. See `x = 7` and [this](a/9.md).

<!-- cells: lambda row, heading: {("a", "in"): [0.13, 2e-4], ("a", "wide"): [7]}.get((row["tuner"], heading)) -->

| tuner | in | wide |
|---|---|---|
| a | 0.13 / 2e-4 | – |
| | 0.13 | 7 |
| b | 5 | |

<!-- lines: ["| 1 |", "| 2 |"] -->

| 1 |
| 2 |

<!-- /lines -->
"""  # noqa: E501 - a mark is in one line


@pytest.fixture(scope="module")
def numbers():
    return stated_once.find_numbers()


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_have_the_present_numbers(page):
    text = page.read_text(encoding="utf-8")
    command = "python -m tests.docs.page_numbers.inserted_numbers"
    assert insert_numbers(text) == text, f"run {command}"


def test_other_numbers_have_a_registered_source(numbers):
    register = stated_once.read_register()
    assert find_differences(numbers, register) == [], (
        "run python -m tests.docs.page_numbers.stated_once"
    )
    assert stated_once.REGISTER.read_text("utf-8") == stated_once.format_register(numbers, register)
    assert {"tunenet.md", "engines.md", "performance.md", "README.md"} <= set(numbers)


def test_a_page_that_agrees_does_not_change():
    assert insert_numbers(TEXT) == TEXT
    assert numbers_by_section(TEXT) == {"A page of 3 things": ["4", "5"]}


@pytest.mark.parametrize(
    ("was", "is_now"),
    [
        ("-->1,600<", "-->1,601<"),
        ("-->two<", "-->three<"),
        ("-->0.0043<", "-->0.0044<"),
        ("| a | 0.13 ", "| a | 0.14 "),
        ("/ 2e-4", "/ 3e-4"),
        ("| | 0.13 | 7 |", "| | 0.13 | 8 |"),
        ("| 1 |\n| 2 |", "| 1 |\n| 3 |"),
    ],
)
def test_a_wrong_number_is_replaced(was, is_now):
    assert TEXT.count(was) == 1
    assert insert_numbers(TEXT.replace(was, is_now)) == TEXT


def test_a_cell_with_more_numbers_than_values_is_an_error():
    with pytest.raises(ValueError, match="has more numbers than the tables"):
        insert_numbers(TEXT.replace("| | 0.13 | 7 |", "| | 0.13 | 7 (8) |"))


@pytest.mark.parametrize(
    ("text", "value", "is_equal"),
    [
        ("0.0043", 0.00434, True),
        ("0.0043", 0.00436, False),
        ("9e-11", 9.4e-11, True),
        ("9e-11", 9.6e-11, False),
        ("2,800", 2800, True),
        ("2,800", 2801, False),
        ("−0.17", -0.1667, True),
        ("twelve", 12, True),
        ("1.0", 0.96, True),
        ("1.0", float("nan"), False),
    ],
)
def test_a_number_agrees_with_what_rounds_to_it(text, value, is_equal):
    assert agrees(text, value) is is_equal


@pytest.mark.parametrize(
    ("text", "value", "formatted"),
    [
        ("0.50", 0.126, "0.13"),
        ("9e-11", 0.00036, "4e-4"),
        ("1.2e-5", 3.456e7, "3.5e7"),
        ("900", 1234.4, "1,234"),
        ("−0.17", -0.3, "−0.30"),
        ("Two", 3, "Three"),
        ("a", "b", "b"),
    ],
)
def test_a_number_keeps_its_form(text, value, formatted):
    assert format_like(text, value) == formatted


def test_a_new_changed_or_lost_number_is_a_fault(numbers):
    page, (name, found) = "scale.md", next(iter(numbers["scale.md"].items()))
    register = stated_once.read_register()
    for changed in ([*found, "7"], ["8", *found[1:]], found[:-1]):
        (fault,) = find_differences({**numbers, page: {name: changed}}, register)
        assert fault.startswith(f"{page}, {name!r}: number ")
    (fault,) = find_differences({**numbers, "new.md": {"Speed": ["3"]}}, register)
    assert fault == "new.md, 'Speed': number 1 was 'nothing', and is '3'"
    assert (
        find_differences({key: value for key, value in numbers.items() if key != page}, register)
        != []
    )


def test_a_missing_source_or_program_is_a_fault(numbers):
    register = copy.deepcopy(stated_once.read_register())
    (entry,) = register["scale.md"].values()
    entry["from"] = ""
    assert "the source of its numbers is missing" in find_differences(numbers, register)[0]
    entry["from"] = "measured once, by `python -m tests.benchmarks.gone`"
    (fault,) = find_differences(numbers, register)
    assert fault.endswith("there is no tests.benchmarks.gone")


def test_numbers_are_counted_below_their_heading_and_not_in_code():
    text = "1 a\n\n# One\n\n2\n\n```sh\n# Three\n4\n```\n5\n\n## Six\n\n<!--= 7 -->7<!--/--> 8\n"
    assert numbers_by_section(text) == {"": ["1"], "One": ["2", "5"], "Six": ["8"]}


def test_identified_combinations_are_reproduced():
    for row in identified("pendulum-swing", 20):
        where = {"experiment": "pendulum-swing", "range": row["range"]}
        (stored,) = page_values.rows("multi/identified.csv", **where).to_dict("records")
        for column in ("stiffest", "sloppiest"):
            assert stored[column] == pytest.approx(row[column], rel=1e-3)
        assert (stored["stiff"], stored["made_of"]) == (row["stiff"], row["made_of"])
