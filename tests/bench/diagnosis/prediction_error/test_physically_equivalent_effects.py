"""Tests of payloads that are moved to the bodies at the joints of their body."""

import numpy as np
import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.prediction_error.physically_equivalent_effects import list_moved_payloads
from bench.logs.recording_loading import load_recording
from tests.bench.diagnosis.arm_model import ARM
from tests.bench.diagnosis.simulated_logs import describe, write_log

ELBOW = 0.7
"""Angle of the elbow at the beginning of each run in rad."""


@pytest.fixture
def evaluator(tmp_path):
    still = [np.tile([0.2, ELBOW], (50, 2))]
    units = dict.fromkeys(("q.shoulder", "q.elbow", "u.m_shoulder", "u.m_elbow"), "rad")
    runs = [(0.01 * np.arange(50), *still)] * 2
    path = write_log(tmp_path, describe(units), ",".join(units), runs, arm=ARM)
    recording, kind = load_recording(path)
    return RunEvaluator(kind, recording, recording.runs, None)


def test_a_moved_payload_stays_where_it_is_in_space(evaluator):
    """The elbow is 0.4 m below the shoulder and turns about y; centres of mass are on z."""
    place = np.array([0.05, 0.0, -0.1])
    ((name, c),) = list_moved_payloads(evaluator, "payload@upper", np.array([0.3, *place]))
    assert name == "payload@fore"
    x, z = place[0], place[2] - 0.2 + 0.4
    turned = [
        np.cos(ELBOW) * x - np.sin(ELBOW) * z,
        np.cos(ELBOW) * z + np.sin(ELBOW) * x,
    ]
    np.testing.assert_allclose(c, [0.3, turned[0], 0.0, turned[1] + 0.1], atol=1e-9)
    ((back, same),) = list_moved_payloads(evaluator, "payload@fore", c)
    assert back == "payload@upper"
    np.testing.assert_allclose(same, [0.3, *place], atol=1e-9)


def test_other_effects_are_not_moved(evaluator):
    assert list_moved_payloads(evaluator, "mass.scale@upper", np.array([0.3])) == []
