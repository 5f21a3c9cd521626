"""Tests that the comparison of page numbers detects wrong, new and missing numbers."""

import pytest

from tests.docs.page_numbers.number_sources import Account, agrees

TEXT = """# A page of 3 things

It takes 1,600 runs, and two of them in
0.0043 s (95 % interval 384 to 423). See `x = 7` and [this](a/9.md).

| tuner | in | wide |
|---|---|---|
| a | 0.13 / 2e-4 | – |
| b | 0.5 | 7 |
"""
VALUES = {("a", "in"): [0.1285, 2.4e-4], ("b", "in"): [0.46], ("b", "wide"): [7]}


def account(text=TEXT):
    """Return the checked numbers of a page on which all agree."""
    page = Account("README.md", text)
    page.says("It takes {} runs, and {} of them in {} s", 1600.4, 2, 0.00426)
    page.says("interval {} to {})", 384, 423)
    page.known("A page of 3 things", "a heading, which needs no reason")
    page.written("| b | 0.5 | 7 |")
    page.table("tuner | in | wide", lambda row, name: VALUES.get((row["tuner"], name)))
    return page


def test_a_page_that_is_right_has_nothing_left():
    assert account().wrong == []
    assert account().left() == []


@pytest.mark.parametrize(
    ("is_now", "was"),
    [
        ("1,601", "1,600"),
        ("three of", "two of"),
        ("0.0044", "0.0043"),
        ("383", "384"),
        ("0.14", "0.13"),
        ("3e-4", "2e-4"),
        ("| 8 |", "| 7 |"),
        ("12 runs", "runs"),
        ("0.1 / 0.13", "0.13"),
    ],
)
def test_a_number_that_is_wrong_is_found(is_now, was):
    assert account(TEXT.replace(was, is_now, 1)).wrong


def test_a_sentence_that_is_gone_is_found():
    (fault,) = account(TEXT.replace("interval", "range")).wrong
    assert "0 times" in fault


def test_a_reason_without_a_number_is_found():
    page = Account("README.md", TEXT)
    page.known("A page of", "it has none")
    page.known("It takes 1,600", "")
    page.written("| b | 0.5 | 8 |")
    assert len(page.wrong) == 3


def test_a_number_that_is_new_is_left_over():
    ((number, about),) = account(f"{TEXT}\nIt takes 5 s.\n").left()
    assert number == "5"
    assert "It takes 5 s." in about


@pytest.mark.parametrize(
    ("text", "value", "holds"),
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
        ("0/315", "0/315", True),
    ],
)
def test_a_number_agrees_with_what_rounds_to_it(text, value, holds):
    assert agrees(text, value) is holds
