"""Quick decisions come before slow searches."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis.prediction_error import prediction_error_search
from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch
from tests.bench.diagnosis.simulated_logs import SERVO_ARM, record_servo_arm

RIPPLE = 0.35
"""Amplitude of the ripple, N m."""
PERIOD = 0.4
"""Period of the ripple, rad."""


def write_recording(folder):
    """Record runs with a torque that varies with the angle."""
    return record_servo_arm(
        folder,
        mujoco.MjModel.from_xml_string(SERVO_ARM),
        push=lambda data: RIPPLE * np.sin(2.0 * np.pi * data.qpos[0] / PERIOD),
    )


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
    model = mujoco.MjModel.from_xml_string(SERVO_ARM)
    answer = explain(record_servo_arm(tmp_path, model, lead=LEAD)).answer
    assert answer.verdict == "named"
    (cause,) = answer.causes
    assert (cause.effect, cause.alternatives) == ("servo.derivative@servo", ())
    assert cause.coefficients["coefficient"].value == pytest.approx(LEAD, rel=0.01)


def test_damping_of_a_joint_and_of_its_servo_are_one_set(tmp_path):
    """The first selection is wrong, and with it its share of the integrator's errors."""
    model = mujoco.MjModel.from_xml_string(SERVO_ARM)
    model.dof_damping[0] = 0.35
    (cause,) = explain(record_servo_arm(tmp_path, model, seed=0)).answer.causes
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
