"""Tests of a servo and a two-joint arm with independent equations.

They move as simgap's simulators do with each effect and as mechanics requires, and their files do
not reveal the hidden effects.
"""

import functools
from dataclasses import replace

import numpy as np
import pytest

from bench.core.diagnoser import DiagnosisCase, list_observable_effects
from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.case_generation.effect_coefficients import list_coefficient_names
from bench.diagnosis_benchmark.case_generation.recording_conditions import RequestedConditions
from bench.diagnosis_benchmark.case_set import render_recording, write_case
from bench.diagnosis_benchmark.diagnosers.regression_evidence import RegressionEvidence
from bench.diagnosis_benchmark.grading import _count_classes, grade_answer
from bench.diagnosis_benchmark.machine_cases.arm_model_file import (
    MODEL_FILE_NAME,
    render_arm_mjcf,
)
from bench.diagnosis_benchmark.machine_cases.machine_case_sampling import (
    draw_case,
    restore_conditions,
)
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import (
    MACHINES,
    ArmDynamics,
    ServoDynamics,
)
from bench.diagnosis_benchmark.machine_cases.machine_effect_coefficients import (
    EFFECTS_BY_MACHINE,
    list_effect_places,
)
from bench.diagnosis_benchmark.machine_cases.machine_simulation import (
    MachineRuns,
    read_encoders,
    simulate_machine,
)
from bench.logs.recording_loading import load_recording
from sims.core.simulator import Scenario
from sims.systems.servo import Servo as ServoSimulator

ARM = {
    "mass1": 1.2, "centre1": 0.18, "inertia1": 0.018, "damping1": 0.3, "armature1": 0.01,
    "length": 0.4, "mass2": 0.8, "centre2": 0.15, "inertia2": 0.009, "damping2": 0.1,
    "armature2": 0.005,
}  # fmt: skip
SERVO = {"torque_constant": 0.5, "resistance": 4.0, "armature": 2e-3}
CONSTANTS = {c.name: c.value for c in ServoSimulator.constants}
TIMES = np.arange(40) / 50
SOMEWHERE = {
    "drag.linear": (0.1,), "drag.quadratic": (0.1,), "force.bias": (0.06,),
    "force.ripple": (0.08, 0.08, 0.3), "friction.coulomb": (0.05,),
    "friction.stribeck": (0.03, 0.05, 0.5), "spring.linear": (0.2,), "input.bias": (0.2,),
    "input.deadband": (0.1,), "input.delay": (0.031,), "input.gain": (0.2,),
    "input.lag": (0.05,), "input.saturation": (0.35,), "sensor.bias": (0.1,),
    "sensor.delay": (0.021,), "sensor.drift": (0.05,), "sensor.gain": (0.2,),
    "gravity.scale": (0.1,), "gravity.tilt": (0.1, 0.0), "inertia.armature": (0.01,),
    "mass.scale": (0.2,), "servo.deadband": (0.05,),
}  # fmt: skip
SOFT = 1e-3
"""Tolerance in rad: MuJoCo smooths dry friction and drives over its step; see docs/engines.md."""


def commands(plant):
    rng = np.random.default_rng(4)
    sizes = (0.7,) if len(plant.joints) == 1 else (3.0, 0.8)
    return np.stack([s * np.repeat(rng.uniform(-1, 1, 4), 10) for s in sizes], axis=1)


def seen(system, effects):
    plant = MACHINES[system](ARM if system == "arm2" else CONSTANTS | SERVO, effects)
    count = len(plant.joints)
    begun = np.array([[0.3, -0.2][:count]])
    runs = MachineRuns(TIMES, commands(plant)[None], begun, 0.5 * begun)
    return read_encoders(simulate_machine(plant, runs), plant, TIMES)[0]


@functools.cache
def seen_without_effects(system):
    return seen(system, {})


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / MODEL_FILE_NAME
    path.write_text(render_arm_mjcf(ARM))
    return make_robot_simulator(path)


def by_simgap(system, effects, arm):
    fixed = {name: list(c) for name, c in effects.items()}
    u = commands(MACHINES[system])
    if system == "servo":
        made = ServoSimulator(CONSTANTS, ["q"], engine="batch", fixed=fixed)
        inputs = {"goal": u[:, 0], "torque_enable": np.ones(len(TIMES))}
        theta, begun = np.array([[*SERVO.values()]]), {"q": 0.3, "qd": 0.15}
    else:
        made = arm({}, ["q.shoulder", "q.elbow"], fixed=fixed)
        inputs = {"u.m_shoulder": u[:, 0], "u.m_elbow": u[:, 1]}
        begun = {"q.shoulder": 0.3, "q.elbow": -0.2, "qd.shoulder": 0.15, "qd.elbow": -0.1}
        theta = np.zeros((1, 0))
    return made.simulate(theta, Scenario(TIMES, begun, inputs))[0]


DRAWN_CASES = [
    (system, name)
    for system, effects in EFFECTS_BY_MACHINE.items()
    for effect in effects
    for name in list_effect_places(system, effect)
]


@pytest.mark.long
@pytest.mark.parametrize(("system", "name"), DRAWN_CASES)
def test_each_effect_agrees_with_the_library(system, name, arm):
    c = SOMEWHERE[name.partition("@")[0]]
    if name == "gravity.tilt" and system == "servo":
        c = c[:1]
    own, other = seen(system, {name: c}), by_simgap(system, {name: c}, arm)
    change = np.abs(own - seen_without_effects(system)).max()
    tolerance = SOFT if system == "arm2" else 2e-4
    assert np.abs(own - other).max() < tolerance
    assert change > 10 * tolerance  # otherwise the agreement is meaningless
    assert len(list_coefficient_names(system, name)) == len(c)


def test_a_different_coefficient_does_not_agree(arm):
    own = seen("arm2", {"mass.scale@forearm": (0.22,)})
    other = by_simgap("arm2", {"mass.scale@forearm": (0.2,)}, arm)
    assert np.abs(own - other).max() > SOFT


def test_a_wheel_with_dry_friction_stops_where_mechanics_says():
    free = CONSTANTS | SERVO | {"kp": 0.0, "gravity": 0.0, "torque_constant": 0.0}
    plant = ServoDynamics(free, {"friction.coulomb": (0.02,)})
    inertia = float(plant.compute_mass_matrix(np.zeros((1, 1)))[0, 0, 0])
    speed, slows = 1.5, 0.02 / inertia
    runs = MachineRuns(TIMES, np.zeros((1, 40, 1)), np.zeros((1, 1)), np.array([[speed]]))
    motion = simulate_machine(plant, runs)
    assert TIMES[-1] > speed / slows
    assert motion.q[-1, 0, 0] == pytest.approx(speed**2 / (2 * slows), rel=1e-4)
    assert motion.v[-1, 0, 0] == 0.0


def test_an_arm_is_held_until_a_motor_exceeds_its_friction():
    plant = ArmDynamics(
        ARM, {"friction.coulomb@shoulder": (1.0,), "friction.coulomb@elbow": (9.0,)}
    )
    told = np.zeros((1, 40, 2))
    told[0, 20:, 0] = 1.05
    motion = simulate_machine(plant, MachineRuns(TIMES, told, np.zeros((1, 2)), np.zeros((1, 2))))
    before = motion.times <= TIMES[20]
    assert np.abs(motion.q[before]).max() == 0.0
    assert motion.q[-1, 0, 0] > 1e-3
    assert np.abs(motion.q[:, 0, 1]).max() == 0.0


def test_foreign_causes_push_where_and_when_they_say():
    bare = seen_without_effects("arm2")
    gust = seen("arm2", {"gust@elbow": (0.5, 0.61, 0.2)})
    assert np.abs(gust - bare)[TIMES <= 0.6].max() == 0.0
    assert np.abs(gust - bare).max() > 0.01
    patch = seen("arm2", {"patch@shoulder": (0.5, 5.0, 0.1)})
    assert np.abs(patch - bare).max() < 1e-6  # the arm never reaches the patch


def case_of(item, folder):
    path = write_case(item, folder)
    recording, kind = load_recording(path)
    rng = np.random.default_rng(0)
    return DiagnosisCase(
        path, recording, kind, list_observable_effects(kind, recording), rng, 10**6, 60.0
    )


@pytest.mark.parametrize(
    ("system", "effect"),
    [
        pytest.param("servo", "friction.coulomb", marks=pytest.mark.long),
        ("arm2", "input.delay"),
    ],
)
def test_residuals_have_the_size_of_the_hidden_effect(system, effect, tmp_path):
    item = draw_case("single", system, 11, effect, 6.0, RequestedConditions(50, 3))
    case = case_of(item, tmp_path)
    assert item.size == 6.0
    fitted_runs = replace(case.recording, runs=case.recording.training())
    evidence = RegressionEvidence.collect(replace(case, recording=fitted_runs))
    sigma = restore_conditions(item.name, system, item.asked).noise_sigmas
    left = np.sqrt(np.mean(np.square(evidence.residual[evidence.observed_mask] / sigma)))
    evidence.close()
    assert left == pytest.approx(np.sqrt(1 + 6.0**2), rel=0.08)


def test_files_do_not_reveal_the_hidden_effect():
    clean = draw_case("clean", "arm2", 3)
    item = replace(clean, kind="single", effects={"mass.scale@forearm": (0.1,)})
    texts = render_recording(item)
    assert set(texts.extra_files) == {MODEL_FILE_NAME}
    stated = restore_conditions(item.name, "arm2", item.asked).numbers
    assert f'mass="{stated["mass1"]!r}"' in texts.extra_files[MODEL_FILE_NAME]
    whole = "".join([texts.description, *texts.extra_files.values()])
    assert "scale" not in whole
    assert item.name not in whole


def test_a_case_is_restored_from_its_json():
    item = draw_case("clean", "servo", 5)
    assert BenchmarkCase.from_document(item.to_document()) == item
    assert render_recording(item) == render_recording(
        BenchmarkCase.from_document(item.to_document())
    )
    assert render_recording(item) != render_recording(draw_case("clean", "servo", 6))


def test_a_family_with_one_of_its_places_is_one_answer():
    item = draw_case("clean", "arm2", 5)
    names = ["friction.coulomb@*", "friction.coulomb@elbow", "friction.stribeck@elbow"]

    def equivalents(name):
        return frozenset({name})

    assert _count_classes(names, equivalents) == 2
    assert _count_classes(["friction.coulomb@*", "friction.stribeck@elbow"], equivalents) == 2
    hidden = replace(item, kind="single", effects={"friction.coulomb@elbow": (1.0,)})
    cause = {"effect": "friction.coulomb@*", "alternatives": [], "coefficients": {}}
    verdict = {"verdict": "named", "causes": [cause], "parameters": {}}
    assert grade_answer(hidden, verdict).outcome == "wrong"  # the shoulder has no friction
    cause["alternatives"] = ["friction.coulomb@elbow"]
    assert grade_answer(hidden, verdict).class_size == 1
