"""Which effects are tried in place of another one."""

from pathlib import Path

import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.prediction_error.filters_with_effects import list_joint_model_effects
from bench.logs.recording_loading import load_joined

EXAMPLE = Path(__file__).parents[4] / "examples" / "robot" / "log.csv"
JOINT_LAWS = ("drag.linear", "friction.coulomb", "inertia.armature")


@pytest.mark.parametrize(
    ("effect", "joint"),
    [
        ("drag.linear@elbow", "elbow"),
        ("input.gain@m_shoulder", "shoulder"),
        # The inertia of a body and the armature of its joint may be one number.
        ("inertia.scale@forearm", "elbow"),
        ("mass.scale@upper_arm", "shoulder"),
    ],
)
def test_laws_of_the_same_joint_compete_with_an_effect(effect, joint):
    recording, kind = load_joined([EXAMPLE], None, None, ())
    evaluator = RunEvaluator(kind, recording, recording.training()[:1], kind.default_engine)
    assert list_joint_model_effects(evaluator, effect) == {f"{law}@{joint}" for law in JOINT_LAWS}
