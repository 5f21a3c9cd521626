"""Tests of recordings on which the simulation search failed, against their correct answers."""

import os
from pathlib import Path

import pytest

from bench.diagnosis.explain import explain


def answer(name, **options):
    folder = Path(os.environ.get("SIMGAP_DATA", "")).parent / "cases"
    if not folder.is_dir():
        pytest.skip(f"no cases: {folder} is missing (set SIMGAP_DATA)")
    return explain(folder / name / "log.csv", **options).answer


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
def test_damping_with_a_stiff_servo_that_saturates():
    verdict = answer("drag_stiff_servo_saturates")
    (cause,) = verdict.causes
    assert (verdict.verdict, cause.effect) == ("named", "drag.linear@elbow")
    assert cause.coefficients["coefficient"].value == pytest.approx(60.0, rel=0.01)


@pytest.mark.slow
def test_a_four_bar_without_a_cause_is_adequate():
    assert answer("fourbar_clean").verdict == "adequate"


@pytest.mark.slow
def test_joints_of_one_loop_are_a_set():
    """All joints of the parallelogram turn alike; only the give of the constraint differs."""
    verdict = answer("fourbar_damping")
    (cause,) = verdict.causes
    assert verdict.verdict == "ambiguous"
    assert {cause.effect, *cause.alternatives} == {
        "drag.linear@rocker",
        "drag.linear@crank",
        "drag.linear@knee",
        "actuator.damping@m_crank",
    }
    assert cause.coefficients["coefficient"].value == pytest.approx(0.18, rel=0.02)


@pytest.mark.slow
def test_equivalent_effects_are_reported_after_a_rejected_cause_is_removed():
    """The servo's damping is equivalent to the joint's, since its force limit is not reached."""
    verdict = answer("friction_and_drag_one_joint")
    assert verdict.verdict == "ambiguous"
    sets = [{cause.effect, *cause.alternatives} for cause in verdict.causes]
    assert {"actuator.damping@m_shoulder", "drag.linear@shoulder"} in sets
    assert {"friction.coulomb@shoulder"} in sets
    assert len(sets) == 2


@pytest.mark.slow
def test_a_free_number_far_from_the_file_is_identified_by_prediction_errors():
    verdict = answer("drag_stiff_servo_saturates", free=["damping@elbow"])
    assert verdict.verdict == "adequate"
    assert verdict.parameters["drag.linear@elbow"].value == pytest.approx(60.0, rel=0.01)
