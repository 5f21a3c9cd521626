"""Tests of extended.toml for a robot: it names its model file, and loads as the identical
simulator.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from bench.benchmark.runner.run_fingerprint import hash_class_source
from bench.conformance import SIMULATOR_CHECKS
from bench.core.plugin_registries import load_plugins, make_robot_simulator, simulators
from bench.diagnosis.score_extended import score_model
from sims.core.simulator import InputError, Scenario
from sims.extended_simulator import (
    ExtendedSimulator,
    FittedValue,
    get_robot_reference,
    load_extended,
    make_extended_name,
    open_extended,
    read_extended,
    write_extended,
)
from sims.robot.fitted_causes import collect_causes
from sims.robot.integrator_settings import IntegratorSettings
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator as robot_simulator
from tests.sims.robot.sample_arms import ARM

pytestmark = pytest.mark.usefixtures("fresh_registries")

TABLE = {"m_more": {"joint": "elbow", "kind": "position", "kp": 3, "kv": 0.1}}
TIMES = np.arange(60) / 97.0
SCENARIO = Scenario(
    TIMES,
    {"q.elbow": 0.4, "qd.shoulder": -0.5},
    {"u.m_elbow": np.sin(9 * TIMES), "u.m_spin": 3 * TIMES, "u.m_more": 0.3 * np.cos(5 * TIMES)},
)
EFFECTS = {
    "friction.coulomb@*": {
        "coefficient@shoulder": FittedValue(0.1, "N*m", 0.08, 0.12),
        "coefficient@elbow": FittedValue(0.03, "N*m", None, None),
    },
    "mass.offset@fore": {
        "x": FittedValue(0.01, "m", 0.0, 0.02),
        "z": FittedValue(-0.02, "m", None, None),
    },
    "input.delay@m_elbow": {"coefficient": FittedValue(-0.004, "s", None, None)},
    "sensor.bias@q.elbow": {"coefficient": FittedValue(0.02, "rad", None, None)},
    "gravity.tilt": {"x": FittedValue(0.03, "1", None, None)},
}
NUMERICS = IntegratorSettings(0.0005, "RK4")


@pytest.fixture
def kind(tmp_path):
    """Return the arm with an additional servo, a smaller step, and free damping and mass."""
    path = tmp_path / "robots" / "arm.xml"
    path.parent.mkdir()
    path.write_text(ARM)
    arm = read_robot(path, actuators=TABLE, engine={"integrator": "implicit"})
    return robot_simulator(arm, ["damping@*", "mass@fore"], NUMERICS)


@pytest.fixture
def model(kind):
    names = [p.name for p in kind.parameters]
    own = {
        name: FittedValue(0.01 * (i + 1), "N*m*s/rad", None, None) for i, name in enumerate(names)
    }
    observe = ["q.elbow", "q.shoulder", "q.spin", "tau.elbow"]
    return ExtendedSimulator(
        "arm_extended", "arm", None, "The arm, measured", own, EFFECTS, {}, observe, kind,
        get_robot_reference(kind),
    )  # fmt: skip


@pytest.fixture
def path(model, tmp_path):
    path = tmp_path / "found" / "extended.toml"
    path.parent.mkdir()
    write_extended(model, path)
    return path


def test_what_is_written_is_read_and_names_the_model_from_where_it_lies(model, path):
    text = path.read_text()
    assert 'model = "../robots/arm.xml"' in text
    assert "system" not in text
    found = read_extended(path)
    assert found.robot.path.resolve() == model.robot.path
    assert replace(found, robot=replace(found.robot, path=model.robot.path)) == model


def test_it_loads_as_the_very_simulator(model, path, kind):
    fitted = kind(observe=model.observe, effects=list(EFFECTS))
    values = {f"{n}.{c}": v.value for n, own in EFFECTS.items() for c, v in own.items()}
    values |= {n: own["coefficient"].value for n, own in EFFECTS.items() if "coefficient" in own}
    values |= {name: number.value for name, number in model.parameters.items()}
    theta = np.array([[values.get(p.name, 0.0) for p in fitted.parameters]])
    made = load_extended(path, simulators.get)
    loaded = made()
    np.testing.assert_array_equal([[p.nominal for p in loaded.parameters]], theta)
    seen = loaded.simulate(theta, SCENARIO)
    np.testing.assert_allclose(seen, fitted.simulate(theta, SCENARIO), rtol=0, atol=1e-12)
    ready = model.simulator()
    np.testing.assert_array_equal(ready.simulate(theta, SCENARIO), seen)
    assert [c.name for c in loaded.channels] == model.observe
    for number in range(theta.size):
        off = theta.copy()
        off[0, number] = 0.0
        shows = (loaded.simulate(off, SCENARIO) != seen).any()
        assert shows == (theta[0, number] != 0), loaded.parameters[number].name
    assert made.numerics == NUMERICS
    assert made.robot.compiled.opt.integrator == 2, "as the recording stated"
    assert loaded.robot.digest == model.robot.digest


def test_moved_together_they_find_each_other_and_apart_it_says_where(model, path, tmp_path):
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    (tmp_path / "robots").rename(moved / "robots")
    with pytest.raises(InputError, match=r"extended\.toml: .*robots/arm\.xml: no such file"):
        open_extended(path, simulators.get)
    path.parent.rename(moved / "found")
    extended, found, made = open_extended(moved / "found" / "extended.toml", simulators.get)
    assert found.robot.digest == model.robot.digest
    assert extended.kind is found
    assert made.name == "arm_extended"
    again = open_extended(moved / "found" / "extended.toml", simulators.get)[2]
    assert hash_class_source(made) == hash_class_source(again), (
        "what is trained in the one is trained in the other"
    )


def test_without_a_tree_in_common_the_model_file_is_named_as_it_is(model):
    document = model.robot.to_document(
        model.robot.path.parents[-2].parent / "nowhere" / "at" / "all"
    )
    assert document["model"] == str(model.robot.path)
    assert model.robot.to_document(None)["model"] == "arm.xml"


def test_a_model_file_that_has_changed_is_one_line(model, path):
    model.robot.path.write_text(ARM.replace('mass="1.5"', 'mass="1.6"'))
    with pytest.raises(InputError, match=r"extended\.toml: model file .*arm\.xml is not the one"):
        open_extended(path, simulators.get)
    path.write_text("\n".join(x for x in path.read_text().splitlines() if "digest" not in x))
    assert open_extended(path, simulators.get)[0].robot.digest is None, "who takes it out may"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "arm_extended"', 'name = "a"\nsystem = "pendulum"', "expected system or model"),
        ("model = ", "# model = ", "digest is for a robot; expected model too"),
        (
            "friction.coulomb@*",
            "friction.coulomb@wrist",
            "unknown place of effect friction.coulomb",
        ),
        ("coefficient@elbow", "coefficient@wrist", r"unknown coefficient .* coefficient@shoulder"),
        ("q.shoulder", "q.wrist", "unknown channel .* q.elbow"),
        ("damping@*", "damping@wrist", "unknown place of effect drag.linear"),
        ('integrator = "RK4"', 'integrator = "leapfrog"', r"numerics.integrator: .* found 'leapf"),
        ("timestep = 0.0005", "timestep = -1", r"numerics.timestep: expected more than 0 s"),
        ("timestep = 0.0005", 'cone = "round"', r"numerics.cone: expected pyramidal | elliptic"),
        ("timestep = 0.0005", "iterations = -1", r"numerics.iterations: expected at least 0"),
        ("timestep = 0.0005", "gravity = 1", r"numerics.gravity: expected one of timestep"),
        ("timestep = 0.0005", "timestep = nan", r"numerics.timestep: expected a number"),
        ('joint = "elbow"', 'joint = "wrist"', r"unknown joint 'wrist'; there are: elbow"),
    ],
)
def test_a_malformed_file_is_one_line(path, old, new, message):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=re.escape(str(path)) + ".*" + message) as error:
        open_extended(path, simulators.get)
    assert "\n" not in str(error.value)


def test_it_conforms_as_a_plugin_does(model, path):
    # Effects on inputs are left out: the scenario of the checks has no commands.
    shown = {name: own for name, own in EFFECTS.items() if not name.startswith("input.")}
    quick = replace(model.robot, numerics={"timestep": 0.005})
    write_extended(replace(model, effects=shown, robot=quick), path)
    load_plugins([path])
    made = simulators.get("arm_extended")
    for check in SIMULATOR_CHECKS:
        check(made)


def test_a_step_that_was_found_is_kept(model, path, kind, tmp_path):
    """As explain passes it: the robot reference is that of the file, only the time step differs."""
    finer = IntegratorSettings(0.002, "implicitfast", (("cone", 1), ("impratio", 10.0)))
    found = kind.with_integrator_settings(finer)
    fitted = replace(model, engine="mujoco", kind=found, robot=get_robot_reference(found))
    assert fitted.robot.digest == model.robot.digest
    write_extended(fitted, path)
    loaded = load_extended(path, simulators.get)
    assert loaded.numerics == finer
    theta = np.array([[p.nominal for p in loaded().parameters]])
    seen = loaded().simulate(theta, SCENARIO)
    np.testing.assert_array_equal(seen, fitted.simulator().simulate(theta, SCENARIO))
    assert np.abs(seen - model.simulator().simulate(theta, SCENARIO)).max() > 1e-6
    changed = collect_causes(fitted)
    assert changed["numerics.step"]["step"].value == 0.002
    assert changed["numerics.integrator"]["integrator"].value == 3
    assert (
        changed["numerics.cone"]["cone"].stated,
        changed["numerics.impratio"]["impratio"].value,
    ) == (0, 10)


def test_two_models_are_distinguished(model, path, kind, tmp_path):
    first = load_extended(path, simulators.get)
    write_extended(replace(model, robot=replace(model.robot, numerics={"timestep": 0.001})), path)
    assert load_extended(path, simulators.get).source_digest != first.source_digest
    (tmp_path / "other.xml").write_text(ARM.replace('mass="1.5"', 'mass="1.6"'))
    other = make_robot_simulator(tmp_path / "other.xml", free=["mass@fore"])
    assert hash_class_source(other) != hash_class_source(
        make_robot_simulator(model.robot.path, free=["mass@fore"])
    )


@pytest.mark.parametrize(
    ("system", "name"), [("arm2", "arm2_extended"), ("2 of us!", "robot_2_of_us__extended")]
)
def test_a_file_of_any_name_gives_one_that_registers(system, name):
    assert make_extended_name(system) == name


def recorded(folder, simulator, theta, name="log"):
    """Write a recording of the arm and its description."""
    seen = simulator.simulate(theta, SCENARIO)[0]
    names = [c.name for c in simulator.channels]
    inputs = list(SCENARIO.inputs)
    rows = [["run", "t", *inputs, *names]]
    for i, t in enumerate(TIMES):
        put = [SCENARIO.inputs[one][i] for one in inputs]
        rows.append([1, *map(repr, (float(t), *map(float, put), *map(float, seen[i])))])
    table = folder / f"{name}.csv"
    table.write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")
    lines = ['model = "robots/arm.xml"']
    lines += [f'[channels."{c.name}"]\nunit = "{c.unit}"\nnoise = 1e-3' for c in simulator.channels]
    lines += [
        f'[inputs."{one}"]\nunit = "{unit}"'
        for one, unit in zip(inputs, ("N*m", "rad/s", "rad"), strict=True)
    ]
    lines += ['[actuators.m_more]\njoint = "elbow"\nkind = "position"\nkp = 3\nkv = 0.1']
    table.with_suffix(".toml").write_text("\n".join(lines) + "\n")
    return table


@pytest.mark.slow
def test_its_score_on_its_own_motion_is_nothing(path, tmp_path):
    made = load_extended(path, simulators.get)
    simulator = made()
    theta = np.array([[p.nominal for p in simulator.parameters]])
    table = recorded(tmp_path, simulator, theta)
    assert score_model(path, table)["normalised_rmse"] < 0.01
    wrong = theta.copy()
    wrong[0, [p.name for p in simulator.parameters].index("gravity.tilt.x")] = 0.2
    assert score_model(path, recorded(tmp_path, simulator, wrong, "other"))["normalised_rmse"] > 3
    text = table.with_suffix(".toml").read_text()
    table.with_suffix(".toml").write_text(
        text.replace('model = "robots/arm.xml"', 'system = "ball"')
    )
    with pytest.raises(InputError, match=r"expected a recording of arm, .* found one of ball"):
        score_model(path, table)


def test_one_that_is_extended_is_not_explained_again(path, tmp_path):
    from bench.diagnosis.explain import explain

    load_plugins([path])
    simulator = simulators.get("arm_extended")()
    theta = np.array([[p.nominal for p in simulator.parameters]])
    table = recorded(tmp_path, simulator, theta)
    with pytest.raises(
        InputError, match=r"arm_extended is extended already; name the model file .*arm\.xml"
    ):
        explain(table, system="arm_extended")
