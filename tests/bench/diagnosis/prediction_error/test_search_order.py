"""Quick decisions come before slow searches."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis.prediction_error import prediction_error_search
from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

ARM = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body>
  <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.8"/>
</body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator>
</mujoco>"""
RIPPLE = 0.35
"""Amplitude of the ripple, N m."""
PERIOD = 0.4
"""Period of the ripple, rad."""


def write_recording(folder):
    """Record three runs in plain MuJoCo, with a torque that varies with the angle."""

    def push(data):
        data.qfrc_applied[0] = RIPPLE * np.sin(2.0 * np.pi * data.qpos[0] / PERIOD)

    model = mujoco.MjModel.from_xml_string(ARM)
    rng, times, runs = np.random.default_rng(3), 0.01 * np.arange(300), []
    for _ in range(3):
        phases = rng.uniform(0.0, 6.0, 2)
        commands = 0.9 * np.sin(2.0 * times + phases[0]) + 0.4 * np.sin(5.1 * times + phases[1])
        readings = follow(model, commands, 5, start=commands[0], act=push)
        runs.append((times, commands, readings + rng.normal(0.0, 1e-3, readings.shape)))
    description = describe({"u.servo": "rad", "q.hinge": "rad"}, 0.001)
    return write_log(folder, description, "u.servo,q.hinge", runs, arm=ARM)


def test_a_ripple_is_found_with_few_simulations(tmp_path):
    answer = explain(write_recording(tmp_path)).answer
    (cause,) = answer.causes
    assert cause.effect == "force.ripple@hinge"
    numbers = {name: number.value for name, number in cause.coefficients.items()}
    assert np.hypot(numbers["sine"], numbers["cosine"]) == pytest.approx(RIPPLE, rel=0.03)
    assert numbers["period"] == pytest.approx(PERIOD, rel=0.01)
    assert answer.simulations < 400


LEAD = 0.05
"""Kd / kp of a servo whose D term acts on the error, s."""


def test_a_d_term_on_the_error_is_not_a_command_ahead_of_its_time(tmp_path):
    """A controller of 500 Hz computes the rate of the set point from its last two values."""
    model = mujoco.MjModel.from_xml_string(ARM)
    step, gain = model.opt.timestep, model.actuator_gainprm[0, 0]
    rng, times, runs = np.random.default_rng(3), 0.01 * np.arange(300), []
    for _ in range(3):
        phases = rng.uniform(0.0, 6.0, 2)
        commands = 0.9 * np.sin(2.0 * times + phases[0]) + 0.4 * np.sin(5.1 * times + phases[1])

        def push(data, commands=commands):
            now, before = (
                commands[int(max(data.time - late, 0.0) / 0.01 + 1e-6)] for late in (0.0, step)
            )
            data.qfrc_applied[0] = gain * LEAD * (now - before) / step

        readings = follow(model, commands, 5, start=commands[0], act=push)
        runs.append((times, commands, readings + rng.normal(0.0, 1e-3, readings.shape)))
    description = describe({"u.servo": "rad", "q.hinge": "rad"}, 0.001)
    answer = explain(write_log(tmp_path, description, "u.servo,q.hinge", runs, arm=ARM)).answer
    assert answer.verdict == "named"
    (cause,) = answer.causes
    assert (cause.effect, cause.alternatives) == ("servo.derivative@servo", ())
    assert cause.coefficients["coefficient"].value == pytest.approx(LEAD, rel=0.01)


def test_damping_of_a_joint_and_of_its_servo_are_one_set(tmp_path):
    """The first selection is wrong, and with it its share of the integrator's errors."""
    model = mujoco.MjModel.from_xml_string(ARM.replace('damping="0.1"', 'damping="0.35"'))
    rng, times, runs = np.random.default_rng(0), 0.01 * np.arange(300), []
    for _ in range(3):
        phases = rng.uniform(0.0, 6.0, 2)
        commands = 0.9 * np.sin(2.0 * times + phases[0]) + 0.4 * np.sin(5.1 * times + phases[1])
        readings = follow(model, commands, 5, start=commands[0])
        runs.append((times, commands, readings + rng.normal(0.0, 1e-3, readings.shape)))
    description = describe({"u.servo": "rad", "q.hinge": "rad"}, 0.001)
    answer = explain(write_log(tmp_path, description, "u.servo,q.hinge", runs, arm=ARM)).answer
    (cause,) = answer.causes
    assert {cause.effect, *cause.alternatives} == {"drag.linear@hinge", "actuator.damping@servo"}


class _OtherFormIsLikelierError(Exception):
    pass


class _OtherLawsAreFittedError(Exception):
    pass


@pytest.mark.parametrize(
    ("effects", "is_nearly_explained", "expected"),
    [
        (("friction.coulomb@hinge",), True, _OtherFormIsLikelierError),
        (("friction.coulomb@hinge",), False, _OtherLawsAreFittedError),
        ((), True, _OtherLawsAreFittedError),
    ],
)
def test_friction_that_nearly_explains_is_compared_with_its_soft_form_before_other_laws(
    monkeypatch, effects, is_nearly_explained, expected
):
    def fail_with(error):
        def fail(*_):
            raise error

        return fail

    friction = SimpleNamespace(effects=effects)
    replaced = {
        "fit_dry_friction": lambda *_: friction,
        "list_likely_starts": lambda *_: [],
        "fit_likely_effects": lambda *_: friction,
        "is_explained": lambda *_: False,
        "is_nearly_explained": lambda *_: is_nearly_explained,
        "check_fit": fail_with(_OtherFormIsLikelierError),
        "fit_quick_selection": fail_with(_OtherLawsAreFittedError),
    }
    for name, function in replaced.items():
        monkeypatch.setattr(prediction_error_search, name, function)
    monkeypatch.setattr(PredictionErrorSearch, "_identify_servos", lambda *_: None)
    search = object.__new__(PredictionErrorSearch)
    search.is_form_given, search.models = True, {frozenset(): friction}
    search.__dict__["_search_context"] = SimpleNamespace(
        columns=SimpleNamespace(select=lambda: None),
        filters=SimpleNamespace(
            base=SimpleNamespace(is_on_ground=False, runs=SimpleNamespace(jumps=np.zeros(1)))
        ),
    )
    with pytest.raises(expected):
        search._search_effects()
