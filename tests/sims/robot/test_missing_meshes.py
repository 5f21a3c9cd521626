"""Tests of candidates whose model MuJoCo does not compile: they are left out and named, and the
search continues.
"""

import numpy as np
import pytest

import simgap
from bench.core.plugin_registries import make_robot_simulator
from sims import effects
from sims.core.simulator import InputError, Scenario
from sims.robot.dynamics.mujoco_batch import RefusedModelError, get_batch_cache
from tests.sims.robot.sample_arms import ARM

TAKEN = ARM.replace('name="spin"', 'name="elbow_flexibility"').replace(
    'joint="spin"', 'joint="elbow_flexibility"'
)
"""An arm in which the name for the second joint of a candidate already exists."""
WHY = "MuJoCo does not compile the model with it: repeated name 'elbow_flexibility' in joint"


@pytest.fixture
def kind(tmp_path):
    (tmp_path / "arm.xml").write_text(TAKEN)
    return make_robot_simulator(tmp_path / "arm.xml")


def test_it_is_left_out_of_the_library_with_mujocos_reason(kind):
    found = effects.list_effects_for(kind.system)
    assert "joint.flexibility@elbow" not in found
    assert {"joint.flexibility@shoulder", "joint.backlash@elbow"} <= set(found)
    assert kind.system.left_out == {"joint.flexibility@elbow": WHY}


def test_asked_for_by_name_it_is_refused_with_mujocos_reason(kind):
    with pytest.raises(InputError, match="repeated name 'elbow_flexibility'"):
        kind(effects=["joint.flexibility@elbow"])


def test_nothing_is_left_out_of_a_sound_robot(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    kind = make_robot_simulator(tmp_path / "arm.xml")
    assert "joint.flexibility@elbow" in effects.list_effects_for(kind.system)
    assert kind.system.left_out == {}


def test_a_broken_effect_of_a_user_is_left_out_alone(tmp_path, fresh_registries):
    class Slack(effects.get_effect("joint.flexibility")):
        name = "joint.slack"

    effects.register_effect(Slack)
    (tmp_path / "arm.xml").write_text(ARM.replace('"spin"', '"shoulder_slack"'))
    kind = make_robot_simulator(tmp_path / "arm.xml")
    found = effects.list_effects_for(kind.system)
    assert set(kind.system.left_out) == {"joint.slack@shoulder"}
    assert "joint.slack@elbow" in found
    assert "joint.slack@*" not in found or "shoulder" not in found["joint.slack@*"].places


def test_elements_of_a_model_that_does_not_compile_are_nan_and_the_others_are_simulated(
    kind, capsys, monkeypatch
):
    # The single check is disabled, since combinations of elements in series may fail to compile.
    monkeypatch.setattr(kind.system, "_compiles_with", lambda _: True)
    names = ["joint.flexibility@elbow", "drag.linear@shoulder"]
    simulator = kind(observe=["q.elbow"], effects=names)
    theta = np.zeros((2, len(simulator.parameters)))
    theta[0] = [0.1 * p.bounds[1] for p in simulator.parameters]
    times = np.arange(20) / 100.0
    seen = simulator.simulate(theta, Scenario(times, {}, {}))
    assert np.isnan(seen[0]).all()
    assert np.isfinite(seen[1]).all()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("simgap: not simulated: joint.flexibility@elbow: MuJoCo does not")
    added = (("elbow", "joint.flexibility"),)
    with pytest.raises(RefusedModelError, match="repeated name"):
        get_batch_cache(kind.robot).get_batch(added, False, 1, {"timestep": 0.001, "integrator": 0})


def test_explain_says_what_it_leaves_out_and_goes_on(tmp_path):
    (tmp_path / "arm.xml").write_text(TAKEN)
    kind = make_robot_simulator(tmp_path / "arm.xml")
    times = np.arange(150) / 100.0
    u = np.sin(7.0 * times)
    simulator = kind(observe=["q.shoulder", "q.elbow"], effects=["drag.linear@elbow"])
    theta = np.array([[0.4]])
    seen = simulator.simulate(theta, Scenario(times, {}, {"u.m_elbow": u}))[0]
    seen = seen + 1e-4 * np.random.default_rng(0).normal(size=seen.shape)
    rows = np.column_stack([np.zeros_like(times), times, u, seen])
    head = "run,t,u.m_elbow,q.shoulder,q.elbow"
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=head, comments="")
    channels = "".join(
        f'[channels."q.{joint}"]\nunit = "rad"\nnoise = 1e-4\n' for joint in ("shoulder", "elbow")
    )
    (tmp_path / "log.toml").write_text(
        f'model = "arm.xml"\n[inputs."u.m_elbow"]\nunit = "N*m"\n{channels}'
    )
    said = []
    found = simgap.explain(tmp_path / "log.csv", jobs=1, budget=3.0, say=said.append)
    assert f"joint.flexibility@elbow is not tested: {WHY}" in said
    assert found.answer.cut is None or "last step" in str(found)
