"""Tests of the tables and the page of the robot exam."""

import csv
import json

import pytest

from tests.robot_exam import robot_exam_report
from tests.robot_exam.robot_exam_score import marked
from tests.robot_exam.test_robot_exam_score import ITEM, OTHER, TRUE, verdict


def row(number, item, answer, effect="friction.coulomb"):
    made = {"kind": item.kind, "robot": item.robot, "effect": effect, "item": item.json()}
    made |= {"question": f"{item.kind}/{item.robot}/{effect}/{number}", "error": ""}
    heldout = {"heldout": {"gap_closed": 0.9}}
    made |= {"verdict": answer and answer | heldout, "seconds": 2.0 * number, "processor": 1.0}
    return made | {"mark": marked(item, answer).json()}


@pytest.fixture
def rows():
    said = {"value": 0.3, "low": 0.29, "high": 0.31}
    return [
        row(1, ITEM, verdict((TRUE,), coefficient=said)),
        row(2, ITEM, verdict((TRUE, OTHER))),
        row(3, ITEM, verdict((OTHER,))),
        row(4, ITEM, None),
        {"question": "single/ur5-servo/mass.scale/0", "kind": "single", "item": {}},
    ]


def test_shares_count_what_was_asked(rows):
    summary = robot_exam_report.summarised(rows)
    shares = summary["named"]["single"]
    counts = {how: (shares[how]["count"], shares[how]["of"]) for how in robot_exam_report.HOWS}
    assert counts == {"strict": (1, 4), "few": (2, 4), "fair": (1, 4), "any": (2, 4)}
    assert summary["coverage"]["count"] == summary["coverage"]["of"] == 1
    assert summary["cannot show"] == ["single/ur5-servo/mass.scale/0"]
    assert summary["failed"] == ["single/arm2-motor/friction.coulomb/4"]
    assert ["friction.coulomb", "drag.linear", 1] in summary["confusion"]
    assert summary["by"]["effect"]["friction.coulomb motor"]["any"]["count"] == 2
    assert summary["seconds"] == pytest.approx({"median": 5.0, "p95": 7.7, "max": 8.0})
    assert summary["processor"] == {"median": 1.0, "p95": 1.0, "max": 1.0}


def test_what_is_written_can_be_read_again(rows, tmp_path):
    (tmp_path / robot_exam_report.ABOUT).write_text("Asked <in part>.\n")
    robot_exam_report.write(tmp_path, [rows[0] | {"code": "0123"}, *rows[1:]])
    with (tmp_path / "items.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["outcome"] for line in lines] == ["right", "set", "wrong", "failed"]
    assert lines[0]["hidden"] == "friction.coulomb@elbow=0.3"
    assert json.loads((tmp_path / "summary.json").read_text())["items"] == 4
    page = (tmp_path / "README.md").read_text()
    assert "2/4 = 50.0%" in page
    assert "\n\nAsked <in part>.\n\n| mark |" in page
    assert "1 by `0123`, 3 by `unknown`" in page
    assert (tmp_path / "figures" / "confusion.png").stat().st_size > 0
