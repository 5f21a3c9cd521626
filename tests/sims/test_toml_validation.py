from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypedDict

import pytest

from sims.core.simulator import InputError
from sims.core.toml_validation import (
    check_annotation,
    check_finite,
    check_name_list,
    check_number,
    check_number_list,
    check_number_pair,
    check_range,
    format_value,
    list_nested_names,
)


class Change(TypedDict, total=False):
    nominal: float
    bounds: tuple[float, float]


@dataclass(frozen=True)
class Part:
    rate: float = 1.0
    count: int = 1
    label: str | None = None


@dataclass(frozen=True)
class Whole:
    parts: Mapping[str, Part] = field(default_factory=dict)
    sizes: tuple[int, ...] = ()
    drawn: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    changes: Mapping[str, Change] = field(default_factory=dict)
    free: Mapping[str, Any] = field(default_factory=dict)
    on: bool = False


def test_values_are_read_as_their_fields_are_declared():
    given = {
        "parts": {"a": {"rate": 60, "label": "x"}},
        "sizes": [1, 2],
        "drawn": {"x": 1, "y": [0, 2]},
        "changes": {"k": {"nominal": 1, "bounds": [0, 3]}},
        "free": {"engine": "batch", "on": [1, {}]},
        "on": True,
    }
    read = check_annotation("f.toml", "", given, Whole)
    assert read.parts == {"a": Part(60, 1, "x")}
    assert isinstance(read.parts["a"].rate, int), "as written: it is hashed"
    assert read.sizes == (1, 2)
    assert read.drawn == {"x": 1.0, "y": (0.0, 2.0)}
    assert isinstance(read.drawn["x"], float)
    assert read.changes == {"k": {"nominal": 1, "bounds": (0.0, 3.0)}}
    assert read.free == given["free"]
    assert read.on is True


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"parts": {"a": {"rat": 1}}}, "unknown entry of [parts.a] in f.toml 'rat'; there are: c"),
        ({"parts": {"a": {"count": 1.5}}}, "parts.a.count: expected a whole number, found 1.5"),
        ({"parts": {"a": {"rate": True}}}, "parts.a.rate: expected a number, found True"),
        ({"parts": {"a": 3}}, "f.toml: parts.a: expected a table, found 3"),
        ({"parts": []}, "f.toml: parts: expected a table, found []"),
        ({"sizes": [1, "x"]}, "f.toml: sizes: expected a whole number, found 'x'"),
        ({"sizes": 3}, "f.toml: sizes: expected a list, found 3"),
        ({"drawn": {"x": [2, 1]}}, "f.toml: drawn.x: expected low < high, found [2, 1]"),
        ({"drawn": {"x": [2]}}, "f.toml: drawn.x: expected [low, high], found [2]"),
        ({"drawn": {"x": "far"}}, "f.toml: drawn.x: expected a number, found 'far'"),
        ({"drawn": {"x": 10**400}}, "f.toml: drawn.x: expected a number, found 1000"),
        ({"changes": {"k": {"bounds": 3}}}, "changes.k.bounds: expected [low, high], found 3"),
        ({"changes": {"k": {"bound": 3}}}, "unknown entry of [changes.k] in f.toml 'bound'"),
        ({"on": 1}, "f.toml: on: expected a bool, found 1"),
    ],
)
def test_a_fault_names_file_entry_expected_and_found(given, message):
    with pytest.raises(InputError) as caught:
        check_annotation("f.toml", "", given, Whole)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 160


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 10**400, "1", True, None])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(InputError, match=r"^f: x: expected a finite number, found "):
        check_finite("f", "x", value, "a finite number")


def test_numbers_pairs_and_names():
    assert check_number("f", "x", float("inf")) == float("inf")
    assert check_number_list("f", "x", [1, 2.5, 3], 3) == (1.0, 2.5, 3.0)
    assert check_number_pair("f", "x", [2, 1]) == (2.0, 1.0)
    assert check_range("f", "x", (1, 2)) == (1.0, 2.0)
    assert check_name_list("f", "x", ["a"]) == ("a",)
    for value in ("a", ["a", 1], {"a": 1}):
        with pytest.raises(InputError, match="f: x: expected a list of names, found"):
            check_name_list("f", "x", value)
    with pytest.raises(InputError, match=r"f: x: expected 3 numbers, found \[1\]"):
        check_number_list("f", "x", [1], 3)


def test_a_long_value_is_quoted_in_part():
    assert len(format_value("x" * 10_000)) == 41


def test_names_of_nested_tables_are_joined():
    tables = {"q": {"hull": {"x": {"unit": "m"}}}, "q.arm": {"unit": "rad"}, "tau.arm": {}}
    assert list_nested_names(tables) == ["q.hull.x", "q.arm", "tau.arm"]
