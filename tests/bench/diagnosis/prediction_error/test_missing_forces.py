"""The joints at which forces are missing decide which effects are fitted."""

import re

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis.prediction_error.effects_at_joints import get_only_joint
from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch
from tests.bench.diagnosis.arm_model import ARM
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

DAMPING = {"shoulder": 0.3, "elbow": 0.1}
"""Damping of the joints in the model file, N m s/rad."""
RATES = (2.0, 2.7), (5.1, 4.3)
"""Angular frequencies of the slow and of the fast part of each command, rad/s."""


def make_model_text(**damping):
    """Return the model file with servos that have no damping of their own."""
    text = re.sub(r' kv="\d+"', "", ARM)
    for joint, value in damping.items():
        before = f'damping="{DAMPING[joint]}"'
        assert before in text
        text = text.replace(before, f'damping="{value}"')
    return text


def write_recording(folder, **damping):
    """Record three runs in plain MuJoCo, with another damping than that of the model file."""
    model = mujoco.MjModel.from_xml_string(make_model_text(**damping))
    rng, times, runs = np.random.default_rng(8), 0.008 * np.arange(200), []
    for _ in range(3):
        phases = rng.uniform(0.0, 6.0, (2, 2))
        slow, fast = (np.sin(np.outer(times, r) + phases[:, k]) for k, r in enumerate(RATES))
        commands = np.array([0.7, 0.8]) * slow + 0.2 * fast
        readings = follow(model, commands, 2, start=commands[0])
        runs.append((times, commands, readings + rng.normal(0.0, 1e-3, readings.shape)))
    units = dict.fromkeys(("u.m_shoulder", "u.m_elbow", "q.shoulder", "q.elbow"), "rad")
    known = make_model_text()
    return write_log(folder, describe(units, 0.001), ",".join(units), runs, arm=known)


class _FiltersError(Exception):
    """Carries the filters of a search out of `explain`."""


def make_filters(monkeypatch, path):
    """Return the filters of the search of a recording."""

    def fail(search):
        raise _FiltersError(search._search_context.filters)

    monkeypatch.setattr(PredictionErrorSearch, "_search_effects", fail)
    with pytest.raises(_FiltersError) as raised:
        explain(path)
    return raised.value.args[0]


def test_effects_at_one_of_two_joints_do_not_act_where_forces_are_missing(monkeypatch, tmp_path):
    filters = make_filters(monkeypatch, write_recording(tmp_path, shoulder=3.0, elbow=0.5))
    act = filters.act_where_forces_are_missing
    assert not act(["drag.linear@shoulder"])
    assert not act(["drag.linear@elbow"])
    assert not act(["friction.coulomb@elbow", "actuator.stiffness@m_elbow"])
    assert act(["drag.linear@elbow", "actuator.stiffness@m_shoulder"])
    assert act(["drag.linear@*"])
    assert act(["mass.scale@fore"])


def test_an_effect_at_the_joint_of_the_only_missing_force_acts_there(monkeypatch, tmp_path):
    filters = make_filters(monkeypatch, write_recording(tmp_path, elbow=0.5))
    assert filters.act_where_forces_are_missing(["drag.linear@elbow"])
    assert not filters.act_where_forces_are_missing(["drag.linear@shoulder"])


def test_wrong_dampings_of_two_joints_are_found(tmp_path):
    path = write_recording(tmp_path, shoulder=3.0, elbow=0.5)
    (cause,) = explain(path).answer.causes
    assert cause.effect == "drag.linear@*"
    numbers = {name: number.value for name, number in cause.coefficients.items()}
    assert numbers["coefficient@shoulder"] == pytest.approx(2.7, rel=0.02)
    assert numbers["coefficient@elbow"] == pytest.approx(0.4, rel=0.02)


@pytest.mark.parametrize(
    ("effect", "joint"),
    [
        ("drag.linear@elbow", 1),
        ("input.gain@m_shoulder", 0),
        ("friction.hysteresis@shoulder", 0),
        # They change the force at the other joint as well.
        ("drag.linear@*", None),
        ("joint.zero@elbow", None),
        ("joint.flexibility@elbow", None),
        ("mass.scale@forearm", None),
        ("sensor.bias@q.elbow", None),
        ("gravity.scale", None),
    ],
)
def test_most_effects_at_a_joint_act_there_alone(example_arm, effect, joint):
    assert get_only_joint(example_arm, effect) == joint
