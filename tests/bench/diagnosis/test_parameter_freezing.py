"""Tests that unidentified parameters of a robot are fixed, on a pendulum simulated with SciPy."""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import write_log

MASS, LENGTH, INERTIA, DAMPING, NOISE = 1.2, 0.5, 0.02, 0.15, 1e-3
MODEL = f"""<mujoco model="swing"><compiler angle="radian"/>
<option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/><worldbody><body>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
<joint name="hinge" axis="0 1 0" damping="0.1"/></body></worldbody></mujoco>"""
LOG = 'model = "swing.xml"\nfree = {free}\n[channels."q.hinge"]\nunit = "rad"\nnoise = {noise}\n'


@pytest.fixture
def log(tmp_path):
    """Write a free swing, which determines only one ratio of mass and inertia."""
    rng, times, runs = np.random.default_rng(5), np.arange(0.0, 4.0, 0.02), []
    for angle in (0.4, -0.7, 1.0):

        def rate(_t, x):
            torque = -MASS * 9.81 * LENGTH * np.sin(x[0]) - DAMPING * x[1]
            return [x[1], torque / (INERTIA + MASS * LENGTH**2)]

        q = solve_ivp(rate, (0, 4), [angle, 0.0], t_eval=times, rtol=1e-9, atol=1e-9).y[0]
        runs.append((times, q + NOISE * rng.standard_normal(times.size)))

    def stated(*free):
        names = "[" + ", ".join(f'"{name}"' for name in free) + "]"
        description = LOG.format(free=names, noise=NOISE)
        return write_log(tmp_path, description, "q.hinge", runs, "swing", swing=MODEL)

    return stated


def test_what_is_free_in_the_description_is_fitted(log):
    found = explain(log("damping@hinge"))
    assert found.verdict == "adequate"
    number = found.answer.parameters["drag.linear@hinge"]
    assert number.value == pytest.approx(DAMPING - 0.1, abs=1e-3)
    assert number.low < DAMPING - 0.1 < number.high


@pytest.mark.slow
def test_a_confounded_number_is_fixed_and_reported(log):
    said = []
    found = explain(log("damping@*", "mass@*", "inertia.armature@*"), say=said.append)
    assert found.verdict == "adequate"
    (frozen,) = [text for text in said if text.startswith("kept at the nominal value")]
    (name,) = re.findall(r"\S+@\S+", frozen)
    assert name in ("mass.scale@body1", "inertia.armature@hinge")
    assert any(
        f"do not identify {name} together with the other parameters" in text
        for text in found.story.lack_of_fit
    )
    numbers = found.answer.parameters
    assert numbers[name].value == 0
    assert numbers[name].low is None
    # The other parameters are then identifiable and have their true values.
    others = numbers.keys() - {name, "drag.linear@hinge"}
    assert all(abs(numbers[other].value) < 0.01 for other in others)
    assert numbers["drag.linear@hinge"].value == pytest.approx(DAMPING - 0.1, abs=1e-3)
    (row,) = [one for one in found.story.identifiability if one.name == name]
    assert row.word == "not identifiable"


def test_free_stands_with_a_model_alone(tmp_path, log):
    path = log("damping@*")
    text = path.with_suffix(".toml").read_text()
    path.with_suffix(".toml").write_text(text.replace('model = "swing.xml"', 'system = "pendulum"'))
    with pytest.raises(Exception, match="free: expected it with model = FILE alone"):
        explain(path)
