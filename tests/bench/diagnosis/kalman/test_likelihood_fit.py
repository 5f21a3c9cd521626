"""Tests of free model-file parameters identified by prediction errors on MuJoCo data."""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis.kalman import likelihood_fit
from tests.bench.diagnosis.simulated_logs import write_log

CARRIAGE = """<mujoco><option timestep="0.001" integrator="implicitfast"/>
<worldbody><body name="carriage"><joint name="screw" type="slide" axis="1 0 0" {joint}/>
<geom name="block" type="box" size="0.2 0.2 0.1" mass="{mass}"/></body></worldbody>
<actuator><motor name="drive" joint="screw"/></actuator></mujoco>
"""
STIFF = 'solreffriction="0.001 1" solimpfriction="0.99 0.999 0.001"'
MASS, DAMPING, FRICTION = 80.0, 200.0, 20.0
"""True mass (kg), damping (N s/m) and friction (N); the file has 100 kg and no friction."""
NOISE = 2e-5
"""Standard deviation of the position noise in m."""
STIFFNESS, DERIVATIVE = 40_000.0, 3_000.0
"""Gains of the position controller in N/m and N s/m."""


def rows_of(seed):
    """Return a 100 Hz run of a carriage that follows a command: time, position and force."""
    rng = np.random.default_rng(seed)
    joint = f'damping="{DAMPING}" frictionloss="{FRICTION}" {STIFF}'
    model = mujoco.MjModel.from_xml_string(CARRIAGE.format(joint=joint, mass=MASS))
    data, rows = mujoco.MjData(model), []
    times, phases = 0.01 * np.arange(500), rng.uniform(0, 2 * np.pi, 3)
    waves = np.sin(2 * np.pi * np.outer(times, (0.3, 0.7, 1.3)) + phases)
    for t, wanted in zip(times, 0.03 * waves.sum(axis=1), strict=True):
        force = STIFFNESS * (wanted - data.qpos[0]) - DERIVATIVE * data.qvel[0]
        rows.append((t, data.qpos[0] + NOISE * rng.standard_normal(), force))
        data.ctrl[0] = force
        mujoco.mj_step(model, data, 10)
    return [np.array(rows)]


def write_carriage_log(folder):
    """Write three runs of the carriage and the model file with a wrong mass and no friction."""
    description = (
        'model = "model.xml"\nfree = ["mass@carriage"]\n[time]\ncolumn = "t"\n'
        f'[channels."q.screw"]\ncolumn = "x"\nunit = "m"\nnoise = {NOISE}\n'
        '[inputs."u.drive"]\ncolumn = "u"\nunit = "N"\n[runs.3]\nheld_out = true\n'
    )
    runs = [rows_of(seed) for seed in (1, 2, 3)]
    return write_log(folder, description, "x,u", runs, model=CARRIAGE.format(joint="", mass=100))


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    return explain(write_carriage_log(tmp_path_factory.mktemp("carriage"))).answer


def test_the_identification_ends_with_the_time_of_the_search(tmp_path, monkeypatch):
    filters, respond = [], likelihood_fit.compute_parameter_responses

    def counted(followed, places, sizes):
        filters.append(places)
        return respond(followed, places, sizes)

    monkeypatch.setattr(likelihood_fit, "compute_parameter_responses", counted)
    stopped = explain(write_carriage_log(tmp_path), force=True, stop=lambda: bool(filters)).answer
    assert len(filters) == 1
    assert stopped.cut.reason == "interrupt"
    assert not stopped.causes


@pytest.mark.long
def test_a_mass_is_identified_with_friction_that_the_file_lacks(answer):
    """Without friction in the model, the fitted mass would be ten times too large."""
    assert answer.verdict == "named"
    assert answer.parameters["mass.scale@carriage"].value == pytest.approx(MASS / 100 - 1, abs=0.01)


@pytest.mark.slow
def test_the_friction_is_found_with_it(answer):
    causes = {cause.effect: cause for cause in answer.causes}
    assert set(causes) == {"friction.coulomb@screw", "drag.linear@screw"}
    numbers = {name: cause.coefficients["coefficient"].value for name, cause in causes.items()}
    assert numbers["friction.coulomb@screw"] == pytest.approx(FRICTION, rel=0.03)
    assert numbers["drag.linear@screw"] == pytest.approx(DAMPING, rel=0.03)
