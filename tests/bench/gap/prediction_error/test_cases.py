"""Recordings on which the search by simulation failed, with their right answers."""

import os
from pathlib import Path

import pytest

from bench.gap.explain import explain


def answer(name):
    folder = Path(os.environ.get("SIMGAP_DATA", "")).parent / "cases"
    if not folder.is_dir():
        pytest.skip(f"no cases: {folder} is missing (set SIMGAP_DATA)")
    return explain(folder / name / "log.csv").answer


@pytest.mark.slow
def test_soft_friction_is_named_alone_in_its_form():
    verdict = answer("soft_friction")
    (cause,) = verdict.causes
    assert (verdict.verdict, cause.effect, cause.form) == (
        "named",
        "friction.coulomb@elbow",
        "soft",
    )
    assert cause.coefficients["coefficient"].value == pytest.approx(0.06, rel=0.03)


@pytest.mark.slow
def test_damping_beside_a_stiff_servo_that_saturates():
    verdict = answer("drag_stiff_servo_saturates")
    (cause,) = verdict.causes
    assert (verdict.verdict, cause.effect) == ("named", "drag.linear@elbow")
    assert cause.coefficients["coefficient"].value == pytest.approx(60.0, rel=0.01)


@pytest.mark.slow
def test_a_four_bar_without_a_cause_is_adequate():
    assert answer("fourbar_clean").verdict == "adequate"
