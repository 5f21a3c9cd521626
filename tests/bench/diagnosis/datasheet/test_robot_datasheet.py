"""Tests of the data sheet of a robot joint: values of the file are added, other joints excluded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.datasheet.datasheet import build_datasheet
from bench.diagnosis.datasheet.datasheet_content import (
    SheetContent,
    SheetRow,
    format_name,
    format_short_name,
)
from bench.diagnosis.datasheet.datasheet_joint import make_subject
from bench.logs.recording_joining import load_joined
from sims.core.simulator import InputError
from sims.extended_simulator import FittedValue
from tests.bench.diagnosis.sample_report_data import make_report
from tests.bench.diagnosis.test_extended_robot_files import EXAMPLE, extended_of

FOUND = {
    "friction.coulomb@*": {
        "coefficient@shoulder": FittedValue(0.001, "N*m", -0.002, 0.004),
        "coefficient@elbow": FittedValue(0.03, "N*m", 0.029, 0.031),
    },
    "drag.linear@elbow": {"coefficient": FittedValue(0.02, "N*m*s/rad", 0.015, 0.025)},
    "gravity.scale": {"coefficient": FittedValue(0.01, "1", 0.0, 0.02)},
}


def build_sheet(log: Path, joint: str) -> SheetContent:
    recording, kind = load_joined([log])
    return build_datasheet(
        recording, extended_of(kind, effects=FOUND), make_report().verdict, joint
    )


def row(sheet: SheetContent, name: str) -> SheetRow:
    return next(row for row in sheet.rows if row.name == name)


def test_what_was_found_is_added_to_what_the_file_states(arm_log: Path) -> None:
    sheet = build_sheet(arm_log, "elbow")
    drag = row(sheet, "drag.linear@elbow")
    assert drag.stated == pytest.approx(0.1)
    assert drag.number is not None
    assert (drag.number.value, drag.number.low) == pytest.approx((0.12, 0.115))
    assert format_name(drag) == "linear drag"
    armature = row(sheet, "inertia.armature@elbow")
    assert format_name(armature) == "armature"
    assert format_short_name(row(sheet, "sensor.bias@q.elbow")) == "sensor.bias q"
    assert format_short_name(row(sheet, "force.ripple@elbow sine")) == "force.ripple sine"
    assert armature.state == "not shown"
    assert armature.stated == pytest.approx(0.005)
    assert row(sheet, "friction.coulomb@elbow").state == "found"
    assert sheet.diagram.breakaway == pytest.approx(0.03)
    places = {row.name.partition("@")[2].partition(" ")[0] for row in sheet.rows}
    assert {"elbow", "q.elbow"} <= places
    assert not any("shoulder" in place for place in places)
    assert list(sheet.elsewhere()) == ["gravity.scale"]


def test_what_may_be_nothing_at_a_joint_of_a_family_is_not_shown_there(arm_log: Path) -> None:
    friction = row(build_sheet(arm_log, "shoulder"), "friction.coulomb@shoulder")
    assert friction.state == "not shown"
    assert friction.detection_limit is not None
    assert friction.detection_limit.size == pytest.approx(0.004)


def test_backlash_of_a_joint_shows_below_the_sizes_that_the_search_tries() -> None:
    """The smallest backlash of the search is 1 % of the travel, and half of it is detectable."""
    log = EXAMPLE / "log.csv"
    recording, _ = load_joined([log])
    travel = max(np.ptp(run.channels["q.elbow"]) for run in recording.training())
    limit = row(build_sheet(log, "elbow"), "joint.backlash@elbow").detection_limit
    assert limit is not None
    assert limit.limit == "above"
    assert limit.size == pytest.approx(0.01 * travel / 2.0, rel=1e-6)


def test_a_joint_has_to_be_named_where_there_are_several() -> None:
    kind = make_robot_simulator(EXAMPLE / "arm2.xml")
    with pytest.raises(InputError, match="expected --joint, one of shoulder, elbow"):
        make_subject(kind, None)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="wrist"):
        make_subject(kind, "wrist")  # type: ignore[arg-type]
