"""Tests that the product imports nothing that Python 3.10, the oldest supported version, lacks."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# What Python 3.11 and 3.12 added to modules of the standard library that the project may use.
TOO_NEW = {
    "typing": {
        "LiteralString", "Never", "NotRequired", "Required", "Self", "TypeVarTuple", "Unpack",
        "assert_never", "assert_type", "clear_overloads", "dataclass_transform", "get_overloads",
        "override", "reveal_type",
    },
    "asyncio": {"Runner", "TaskGroup", "timeout"},
    "contextlib": {"chdir"},
    "datetime": {"UTC"},
    "enum": {"EnumCheck", "ReprEnum", "StrEnum", "member", "nonmember", "verify"},
    "hashlib": {"file_digest"},
    "itertools": {"batched"},
    "operator": {"call"},
}  # fmt: skip


def list_too_new(source):
    """Return the names that a module imports at run time and that Python 3.10 lacks."""
    nodes, found = [ast.parse(source)], []
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            nodes += node.orelse
            continue
        if isinstance(node, ast.ImportFrom):
            found += [a.name for a in node.names if a.name in TOO_NEW.get(node.module or "", ())]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found += [node.attr] if node.attr in TOO_NEW.get(node.value.id, ()) else []
        nodes += ast.iter_child_nodes(node)
    return found


def test_the_product_needs_only_python_3_10():
    files = [path for name in ("bench", "methods", "sims") for path in (ROOT / name).rglob("*.py")]
    wrong = {str(path.relative_to(ROOT)): list_too_new(path.read_text("utf-8")) for path in files}
    assert {path: names for path, names in wrong.items() if names} == {}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("from typing import Any, Self", ["Self"]),
        ("import datetime\nnow = datetime.datetime.now(datetime.UTC)", ["UTC"]),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from typing import Self", []),
        ("from typing_extensions import Self", []),
    ],
)
def test_a_name_that_python_3_10_lacks_is_found(source, expected):
    assert list_too_new(source) == expected
