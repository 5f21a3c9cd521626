"""Causes that look like another convention of a log: explain must search for them, not refuse."""

import mujoco
import pytest

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import SERVO_ARM, record_servo_arm

OFFSET = 0.03
"""Offset of the encoder, rad."""
LEAD = 0.04
"""Kd / kp of a servo whose D term acts on the error, s."""
SIDEWAYS = 0.03
"""Distance of the centre of mass from the link, m."""


def explain_log(folder, model, **changes):
    """Record a changed arm with small motions, and explain it."""
    return explain(record_servo_arm(folder, model, 5, (0.6, 0.25), **changes)).answer


@pytest.mark.parametrize(
    ("change", "effect", "value"),
    [
        # It looked like another zero of position and command, 0.57 rad away.
        ({"offset": OFFSET}, "sensor.bias@q.hinge", OFFSET),
        # It looked like commands with late time stamps.
        ({"lead": LEAD}, "servo.derivative@servo", LEAD),
    ],
)
def test_an_encoder_offset_and_a_d_term_are_causes(tmp_path, change, effect, value):
    (cause,) = explain_log(tmp_path, mujoco.MjModel.from_xml_string(SERVO_ARM), **change).causes
    assert cause.effect == effect
    assert cause.coefficients["coefficient"].value == pytest.approx(value, rel=0.02)


def test_a_centre_of_mass_off_the_link_is_not_another_zero_of_the_joint(tmp_path):
    """A link that hangs askew looks like one whose joint is counted from another angle."""
    model = mujoco.MjModel.from_xml_string(SERVO_ARM)
    model.body_ipos[1, 0] += SIDEWAYS
    (cause,) = explain_log(tmp_path, model).causes
    assert "mass.offset@link" in (cause.effect, *cause.alternatives)
