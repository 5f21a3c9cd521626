"""Tests that logs which contradict their description give a one-line error and no cause."""

import numpy as np
import pytest

from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.explain import explain
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError, Scenario
from tests.bench.diagnosis.arm_model import ARM
from tests.bench.diagnosis.simulated_logs import describe, write_log

COLUMNS = ("u.m_shoulder", "u.m_elbow", "q.shoulder", "q.elbow")
TOML = describe(dict.fromkeys(COLUMNS, "rad"))
TIMES = np.arange(120) / 40.0


def table_of(folder, change=lambda v: v, toml=TOML, columns=COLUMNS, model=ARM, second=1.0):
    """Write a log of the arm following its commands, with changes; return its path."""
    path = folder / "arm.xml"
    path.write_text(ARM)
    simulator = make_robot_simulator(path)(observe=["q.shoulder", "q.elbow"])
    commands = np.stack([np.sin(4 * TIMES), 0.8 * np.cos(2.6 * TIMES)], axis=1)
    inputs = dict(zip(COLUMNS[:2], commands.T, strict=True))
    run = Scenario(TIMES, {"q.elbow": 0.8}, inputs)
    values = np.column_stack([commands, simulator.simulate(np.empty((1, 0)), run)[0]])
    values += 1e-3 * np.random.default_rng(2).standard_normal(values.shape) * [0, 0, 1, 1]
    runs = [(second * TIMES, change(values))]
    return write_log(folder, toml, ",".join(columns), runs, arm=model)


def scaled(*factors):
    return lambda values: values * np.array(factors)


def test_a_sound_log_is_not_odd(tmp_path):
    assert check_recording_plausible(*load_recording(table_of(tmp_path))) == []


def test_a_link_without_inertia_does_not_make_the_stamps_milliseconds(tmp_path):
    light = ARM.replace(
        'mass="0.8" diaginertia="0.01 0.01 0.001"', 'mass="1e-7" diaginertia="1e-9 1e-9 1e-9"'
    )
    # Its servo is unstable at the step of the model file, which is no fault of the stamps.
    (warning,) = check_recording_plausible(*load_recording(table_of(tmp_path, model=light)))
    assert warning.startswith("servo m_elbow: gains too large for Euler steps of 4 ms")


ERROR_MESSAGES = {
    "degrees": (
        scaled(1, 1, 57.3, 57.3),
        r"column q.shoulder: expected within -2.6 to 2.6 rad, the joint's range, found "
        r"-?\d\d\.\d+; is the unit degrees\?",
    ),
    "degrees of one": (
        scaled(1, 1, 1, 57.3),
        r"column q.elbow: moves \d\d(\.\d)? times as far as u.m_elbow commands; "
        r"is its unit degrees\?",
    ),
    "gears": (scaled(1, 1, 4000, 1), r"column q.shoulder: .* found -?\d+; is the unit right\?"),
}


@pytest.mark.parametrize("name", ERROR_MESSAGES)
def test_positions_that_cannot_be_are_refused_in_one_line(name, tmp_path):
    change, message = ERROR_MESSAGES[name]
    table = table_of(tmp_path, change)
    with pytest.raises(InputError, match=r"log\.csv: (run 1, )?" + message) as error:
        explain(table)
    assert "--force" in str(error.value)
    assert check_recording_plausible(*load_recording(table), force=True), (
        "--force does not suppress the message"
    )


DOUBTED = {
    "a sign": (
        scaled(1, 1, 1, -1),
        "column q.elbow: moves against u.m_elbow; is a sign wrong?",
    ),
    "commands in degrees": (scaled(57.3, 1, 1, 1), "is the unit of u.m_shoulder degrees?"),
    "swapped": (
        lambda values: values[:, [0, 1, 3, 2]],
        "columns q.shoulder and q.elbow: each follows the other's command; are they swapped?",
    ),
    "beyond": (
        scaled(1, 1, 3.2, 1),
        "and joint shoulder of the model stops at 2.6; is its range right?",
    ),
    "turns": (
        lambda values: values + np.array([0, 0, 0, 100.0]),
        "found 100.8 rad, 16 turns; is the unit degrees?",
    ),
}


@pytest.mark.parametrize("name", DOUBTED)
def test_positions_that_are_odd_are_said(name, tmp_path):
    change, message = DOUBTED[name]
    (said,) = check_recording_plausible(*load_recording(table_of(tmp_path, change)))
    assert said.endswith(message)


FREE = '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
REFUSED = {
    "another robot": (
        {"toml": TOML.replace("q.elbow", "q.wrist"), "columns": (*COLUMNS[:3], "q.wrist")},
        r"unknown channel in .*log\.toml 'q\.wrist'; there are: q\.elbow, q\.shoulder, qd\.elbow",
    ),
    "another robot's command": (
        {"toml": TOML.replace("u.m_elbow", "u.m_wrist")},
        r"unknown input in .*'u\.m_wrist'; there are: force\.elbow, force\.shoulder, u\.m_elbow",
    ),
    "a column that is not there": (
        {"columns": ("u.m_shoulder", "u.m_elbow", "q.shoulder", "q.wrist")},
        r"log\.csv.*q\.elbow",
    ),
    "no model file": ({"toml": TOML.replace("arm.xml", "leg.xml")}, r"leg\.xml: no such file"),
    "no robot": ({"model": "<mujoco/>"}, r"no movable joint"),
    "a free base alone": ({"model": FREE}, r"expected a hinge or slide joint"),
    "unstable": (
        # Negative damping makes every simulation diverge.
        {"model": ARM.replace('damping="0.1"', 'damping="-500"')},
        r"the simulation fails at every starting point of the fit|damping",
    ),
    "in metres": ({"toml": TOML.replace('unit = "rad"', 'unit = "m"')}, r"expected .*rad"),
}


def test_stamps_in_milliseconds_are_refused_before_a_million_steps(tmp_path):
    message = r"run 1: q\..* takes .* s to move as arm would within .*; are the stamps millisec"
    with pytest.raises(InputError, match=message):
        explain(table_of(tmp_path, second=1000.0))


@pytest.mark.parametrize("name", REFUSED)
def test_a_log_of_something_else_is_one_line(name, tmp_path):
    given, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as error:
        explain(table_of(tmp_path, **given))
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_commands_in_degrees_are_refused_with_the_unit_and_found_again_if_the_user_insists(
    tmp_path,
):
    path = table_of(tmp_path, scaled(57.3, 1, 1, 1))
    with pytest.raises(InputError, match=r'u\.m_shoulder look like degrees.* unit = "deg"'):
        explain(path)
    explained = explain(path, force=True)
    assert explained.causes == ()
    (fault,) = explained.answer.recording_faults
    assert fault.signals == ("u.m_shoulder",)
    assert fault.factor == pytest.approx(np.pi / 180, rel=1e-9)
    assert fault.unit == "deg"


@pytest.mark.slow
def test_an_encoder_that_is_a_quarter_turn_off_is_refused_and_named_if_the_user_insists(tmp_path):
    path = table_of(tmp_path, lambda v: v + np.array([0, 0, 0, 1.57]))
    with pytest.raises(InputError, match=r"q\.elbow looks counted from another zero"):
        explain(path)
    (cause,) = explain(path, force=True).causes
    assert cause.effect == "sensor.bias@q.elbow"
    assert cause.coefficients["coefficient"].value == pytest.approx(1.57, abs=5e-3)


@pytest.mark.long
def test_swapped_joints_are_refused_and_have_no_cause_that_would_explain_them(tmp_path):
    path = table_of(tmp_path, lambda v: v[:, [0, 1, 3, 2]])
    with pytest.raises(InputError, match="channels of shoulder, elbow look exchanged"):
        explain(path)
    explained = explain(path, force=True)
    assert explained.answer.verdict in ("unknown", "partial")
    assert [c.effect for c in explained.causes if not c.effect.startswith("numerics.")] == []
