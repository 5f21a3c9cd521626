"""Conversion of dataclasses to JSON documents and back, by their fields and type hints.

A document is a dict with one key for each field, in the order of the fields. Tuples become lists,
and nested dataclasses become documents. The metadata of a field change this:

* `OPTIONAL`: the key is left out where the field has its default.
* ``{"key": name}``: the key has another name than the field.

`to_plain_values` resolves the dataclasses of a value. `to_json_value` converts everything else that
JSON cannot represent, such as paths, NumPy arrays and NaN.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import Field, fields, is_dataclass
from pathlib import PurePath
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from typing import Self


OPTIONAL: Mapping[str, Any] = {"optional": True}
"""Metadata of a field whose key is left out where the field has its default."""


class Document:
    """Base class of dataclasses that are entries of a JSON file."""

    def to_document(self) -> dict[str, Any]:
        """Convert to plain values for JSON."""
        document: dict[str, Any] = to_plain_values(self)
        return document

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Self:
        """Restore an instance from its document; a missing key gives the default of its field."""
        restored: Self = _restore_dataclass(cls, document)
        return restored


def to_plain_values(value: Any) -> Any:
    """Convert dataclasses, mappings and sequences to dicts and lists; copy other values.

    The key of a field is left out where the field is marked `OPTIONAL` and has its default.
    """
    if is_dataclass(value):
        named_values = [(field, getattr(value, field.name)) for field in fields(value)]
        return {
            _get_key(field): to_plain_values(part)
            for field, part in named_values
            if "optional" not in field.metadata or part != field.default
        }
    if isinstance(value, Mapping):
        return {key: to_plain_values(part) for key, part in value.items()}
    return [to_plain_values(part) for part in value] if isinstance(value, tuple | list) else value


def to_json_value(value: Any) -> Any:
    """Convert a value to JSON types: paths to text, tuples to lists, NaN and infinity to None."""
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, tuple | list | set | frozenset):
        return [to_json_value(item) for item in value]
    if isinstance(value, PurePath):
        return str(value)
    # NumPy numbers and arrays have this method.
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    # Text from files or system calls may contain lone surrogates, which cannot be encoded.
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value


def _get_key(field: Field[Any]) -> str:
    """Return the key of a field in a document."""
    return str(field.metadata.get("key", field.name))


def _restore(kind: Any, value: Any) -> Any:
    """Restore a value from plain values, as JSON gives them.

    Dataclasses, tuples and named tuples are made again, also inside of dicts and optional values;
    a value of another type is returned unchanged.

    Args:
        kind: type annotation of the value.
        value: plain value: number, text, list, dict or None.
    """
    if value is None:
        return None
    if is_dataclass(kind):
        return _restore_dataclass(kind, value)
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):  # one type or None; the value is not None here
        return _restore(next(part for part in parts if part is not NoneType), value)
    if origin is tuple:  # of any length, with entries of one type
        return tuple(_restore(parts[0], part) for part in value)
    if origin in (dict, Mapping):
        _, value_kind = parts
        return {key: _restore(value_kind, part) for key, part in value.items()}
    # A plain tuple has an origin, which is treated above.
    is_named_tuple = isinstance(kind, type) and issubclass(kind, tuple)
    return kind(*value) if is_named_tuple else value


def _restore_dataclass(kind: Any, document: Mapping[str, Any]) -> Any:
    """Restore a dataclass from its document."""
    hints = get_type_hints(kind)
    values = {}
    for field in fields(kind):
        if (key := _get_key(field)) in document:
            values[field.name] = _restore(hints[field.name], document[key])
    return kind(**values)
