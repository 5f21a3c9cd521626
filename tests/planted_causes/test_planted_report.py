"""Tests of the shares and targets of the planted-cause test."""

import pytest

from tests.planted_causes.planted_report import groups, text, verdict


def row(number, is_fair=True, cpu=2.0, version="one"):
    mark = {
        "outcome": "right" if is_fair else "none", "strict": is_fair, "fair": is_fair,
        "causes": ["drag.linear@elbow"], "number": 1.0, "ratios": {},
    }  # fmt: skip
    item = {"place": "elbow", "size": 1.0, "gap": 5.0, "force_limits": {"elbow": 9.0}}
    return {
        "item": f"ur5/damping/{number}", "robot": "ur5", "kind": "damping", "version": version,
        "drawn": item, "digest": "a", "mark": mark, "verdict": None, "message": "", "cpu": cpu,
        "wall": cpu, "memory": 200.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("rows", "is_reached"),
    [
        ([row(i, i >= 10) for i in range(100)], True),
        ([row(i, i >= 11) for i in range(100)], False),
        ([row(i) for i in range(99)], False),
        ([row(i, cpu=5.2) for i in range(100)], False),
        ([row(i, cpu=60.0 if i < 40 else 4.0) for i in range(100)], True),
    ],
)
def test_marks(rows, is_reached):
    total = groups(rows)[0]
    assert verdict(total).endswith("s: reached") is is_reached


def test_versions_are_compared_on_equal_recordings():
    rows = [row(0), row(1), row(0, is_fair=False, version="two")]
    counts = {(g["version"], g["group"]): (g["items"], g["fair"]) for g in groups(rows)}
    assert counts["one", "all"] == (2, 2)
    assert counts["two", "damping"] == (1, 0)
    assert counts["two", "force limits reached"] == (1, 0)
    assert "recordings differ" not in text(rows)
    assert "recordings differ between versions (use --fresh): ur5/damping/0" in text(
        [*rows, row(0) | {"digest": "b"}]
    )
    assert "no place shows such a change: ur5/mass/1" in text(
        [*rows, {"item": "ur5/mass/1", "version": "one", "drawn": None}]
    )
