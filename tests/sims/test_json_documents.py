"""Tests of dataclasses that are converted to JSON documents and back."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import pytest

from sims.core.json_documents import OPTIONAL, Document, to_plain_values


class Range(NamedTuple):
    low: float
    high: float


@dataclass(frozen=True)
class Value:
    number: float
    note: str = field(default="", metadata=OPTIONAL)


@dataclass(frozen=True)
class Entry(Document):
    title: str = field(metadata={"key": "says"})
    span: Range
    values: Mapping[str, Value]
    sizes: dict[str, tuple[float, ...]]
    best: Value | None = None
    others: tuple[Value, ...] = field(default=(), metadata=OPTIONAL)


SPAN = Range(0.0, 1.0)
FULL = Entry("a", SPAN, {"x": Value(2.0, "b")}, {"y": (1.0, 2.0)}, Value(3.0), (Value(4.0),))
PLAIN = Entry("a", SPAN, {}, {})


def test_a_document_has_the_keys_and_order_of_the_fields():
    assert json.dumps(FULL.to_document()) == (
        '{"says": "a", "span": [0.0, 1.0], "values": {"x": {"number": 2.0, "note": "b"}}, "sizes":'
        ' {"y": [1.0, 2.0]}, "best": {"number": 3.0}, "others": [{"number": 4.0}]}'
    )


def test_optional_fields_are_left_out_at_their_default_and_others_are_not():
    assert list(PLAIN.to_document()) == ["says", "span", "values", "sizes", "best"]


@pytest.mark.parametrize("entry", [FULL, PLAIN])
def test_an_entry_is_restored_from_its_document(entry):
    assert Entry.from_document(json.loads(json.dumps(entry.to_document()))) == entry
    assert isinstance(Entry.from_document(entry.to_document()).span, Range)


def test_a_missing_key_gives_the_default_or_an_error():
    document = PLAIN.to_document()
    del document["best"]
    assert Entry.from_document(document) == PLAIN
    del document["span"]
    with pytest.raises(TypeError, match="span"):
        Entry.from_document(document)


def test_other_values_are_copied():
    assert to_plain_values({"a": (1, [Value(2.0)]), "b": None}) == {
        "a": [1, [{"number": 2.0}]],
        "b": None,
    }
