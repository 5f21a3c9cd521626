from dataclasses import replace

import numpy as np
import pytest

from bench.cli.main import main
from bench.conformance import SIMULATOR_CHECKS
from bench.core.plugin_registries import load_plugins, simulators
from bench.logs.synthetic_recording import simulate_recording
from sims.core.simulator import InputError, Scenario
from sims.extended_simulator import (
    MIN_TRAINING_RANGE_SHARE,
    ExtendedSimulator,
    FittedValue,
    load_extended,
    make_simulator_class,
    open_extended,
    read_extended,
    write_extended,
)
from sims.systems.pendulum import Pendulum
from tests.simulation_arguments import simulation_spec

MODEL = ExtendedSimulator(
    "pendulum_extended", "pendulum", "batch", "A swing, measured",
    {"inertia": FittedValue(3.1e-3, "kg*m^2", 3.0e-3, 3.2e-3)},
    {
        "drag.linear": {"coefficient": FittedValue(7e-4, "N*m*s/rad", None, None)},
        "sensor.delay": {"coefficient": FittedValue(0.013, "s", 0.012, 0.014)},
    },
    {"mass": 0.2, "length": 0.15, "gravity": 9.7}, ["qd", "q"],
)  # fmt: skip


pytestmark = pytest.mark.usefixtures("fresh_registries")


@pytest.fixture
def path(tmp_path):
    write_extended(MODEL, tmp_path / "extended.toml")
    return tmp_path / "extended.toml"


def test_what_is_written_is_read(path):
    assert read_extended(path) == replace(MODEL, observe=["qd", "q"])


def test_the_loaded_simulator_is_the_fitted_one_to_the_last_bit(path):
    kind = load_extended(path, simulators.get)
    simulator = kind()
    assert [p.name for p in simulator.parameters] == ["inertia", "drag.linear", "sensor.delay"]
    fitted = Pendulum(
        MODEL.constants, ["qd", "q"], engine="batch", effects=["drag.linear", "sensor.delay"]
    )
    theta = np.array([[3.1e-3, 7e-4, 0.013]])
    assert [p.nominal for p in simulator.parameters] == theta[0].tolist()
    scenario = Scenario(
        np.arange(90) / 60, {"q": 1.1, "qd": -0.4}, {"u": np.sin(np.arange(90) / 9)}
    )
    np.testing.assert_array_equal(
        simulator.simulate(theta, scenario), fitted.simulate(theta, scenario)
    )
    assert [c.name for c in simulator.channels] == ["qd", "q"]
    assert simulator.constant_values["mass"] == 0.2
    assert kind.says == "pendulum with drag.linear, sensor.delay, fitted to: A swing, measured"
    assert kind({"mass": 0.3}, ["q"]).constant_values == {
        "mass": 0.3,
        "length": 0.15,
        "gravity": 9.7,
    }


def test_what_was_opened_gives_its_simulator_ready(path):
    extended, kind, _ = open_extended(path, simulators.get)
    theta = np.array([[3.1e-3, 7e-4, 0.013]])
    scenario = Scenario(np.arange(90) / 60, {"q": 1.1})
    ready, loaded = extended.simulator(), load_extended(path, simulators.get)()
    assert [p.nominal for p in ready.parameters] == theta[0].tolist()
    np.testing.assert_array_equal(ready.simulate(theta, scenario), loaded.simulate(theta, scenario))
    assert extended.kind is kind is Pendulum
    assert extended == read_extended(path), "the class is no part of what was fitted"


def test_what_was_read_alone_does_not_know_its_simulator(path):
    with pytest.raises(InputError, match="the class of system pendulum is unknown; open its file"):
        read_extended(path).simulator()


def test_a_class_is_described_by_its_fit(path):
    kind = load_extended(path, simulators.get)
    assert kind.source_digest == load_extended(path, simulators.get).source_digest
    drag = {"drag.linear": {"coefficient": FittedValue(8e-4, "N*m*s/rad", None, None)}}
    for change in (
        {"system": "other"},
        {"parameters": {"inertia": FittedValue(3.1e-3, "kg*m^2", None, None)}},
        {"effects": drag},
        {"effects": dict(reversed(MODEL.effects.items()))},
        {"constants": {**MODEL.constants, "mass": 0.3}},
        {"observe": ["q", "qd"]},
    ):
        other = make_simulator_class(replace(MODEL, **change), Pendulum)
        assert other.source_digest != kind.source_digest, change
        assert len(other.source_digest) == 64


def test_the_training_range_is_about_the_interval(path):
    inertia, drag, delay = load_extended(path, simulators.get).parameters
    assert inertia.training == pytest.approx(
        (3.1e-3 * (1 - MIN_TRAINING_RANGE_SHARE), 3.1e-3 * (1 + MIN_TRAINING_RANGE_SHARE))
    )
    assert inertia.bounds == (1e-3, 1e-2)
    assert drag.training == pytest.approx((5.6e-4, 8.4e-4))
    assert delay.training == pytest.approx((0.010, 0.016)), "three half widths of the interval"
    odd = replace(MODEL, parameters={"inertia": FittedValue(0.05, "kg*m^2", None, None)})
    write_extended(odd, path)
    assert load_extended(path, simulators.get).parameters[0].bounds == (1e-3, 0.05)
    assert load_extended(path, simulators.get).parameters[0].nominal == 0.05


def test_another_engine_may_step_it(path):
    kind = load_extended(path, simulators.get)
    theta, scenario = np.array([[3.1e-3, 7e-4, 0.013]]), Scenario(np.arange(60) / 60, {"q": 1.0})
    one, two = (kind(engine=engine).simulate(theta, scenario) for engine in ("batch", "mujoco"))
    assert np.abs(one - two).max() < 0.05
    assert not np.array_equal(one, two)


@pytest.mark.parametrize("check", SIMULATOR_CHECKS, ids=lambda check: check.__name__)
def test_a_loaded_simulator_conforms(path, check):
    check(load_extended(path, simulators.get))


def test_one_without_effects_is_a_simulator_too(path):
    write_extended(replace(MODEL, effects={}, engine=None), path)
    kind = load_extended(path, simulators.get)
    assert len(kind.parameters) == 1
    assert kind.says.startswith("pendulum with nothing added")
    for check in SIMULATOR_CHECKS:
        check(kind)


GOOD = """format = 1
name = "swing"
system = "pendulum"
observe = ["q"]
[parameters.inertia]
value = 3.3e-3
unit = "kg*m^2"
[effects."drag.linear".coefficient]
value = 1e-4
unit = "N*m*s/rad"
"""


def test_engine_title_and_constants_may_be_left_out(path):
    path.write_text(GOOD)
    extended, kind, made = open_extended(path, simulators.get)
    assert (extended.engine, extended.title, dict(extended.constants)) == (None, "", {})
    assert kind is Pendulum
    assert made.parameters[1].nominal == 1e-4


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("drag.linear", "drag.cubic", "unknown effect 'drag.cubic'; did you mean "),
        (
            "drag.linear",
            "wind",
            "system pendulum cannot have effect wind|unknown coefficient of effect wind",
        ),
        (
            "coefficient",
            "strength",
            "unknown coefficient of effect drag.linear 'strength'; there are: coefficient",
        ),
        ("inertia", "mass", "unknown parameter of system pendulum 'mass'; there are: inertia"),
        ('"pendulum"', '"pendulums"', "unknown simulator 'pendulums'; there are: .*pendulum"),
        ("3.3e-3", '"large"', "parameters.inertia.value: expected a finite number, found 'large'"),
        ("3.3e-3", "nan", "parameters.inertia.value: expected a finite number, found nan"),
        ("3.3e-3", "true", "parameters.inertia.value: expected a finite number, found True"),
        (
            "value = 1e-4",
            "low = 1e-4",
            "effects.drag.linear.coefficient.value: expected a finite number, found None",
        ),
        (
            "value = 1e-4",
            "value = 1\nlow = inf",
            "coefficient.low: expected a finite number, found inf",
        ),
        ('unit = "kg*m^2"', "", "unit: expected a text, found None"),
        ("format = 1", "format = 2", "expected an extended simulator with format = 1, found 2"),
        ("format = 1", "", "expected an extended simulator with format = 1, found None"),
        ('name = "swing"', "", "name: expected a text, found None"),
        ('name = "swing"', 'name = "../swing"', "name: expected letters"),
        ('system = "pendulum"', "system = 3", "system: expected a text, found 3"),
        ('observe = ["q"]', "", r"observe: expected a list of channel names, found \[\]"),
        ('["q"]', '["z"]', "unknown channel of simulator pendulum 'z'; there are: q, qd"),
        ('["q"]', '["q", "q"]', "observe needs one or more different channels"),
        (
            "format = 1",
            "format = 1\nspeed = 3",
            "unknown key of .*extended.toml 'speed'; there are: ",
        ),
        (
            "format = 1",
            'format = 1\nengine = "ode"',
            "unknown engine 'ode'; there are: batch, mujoco, pybullet",
        ),
        (
            "format = 1",
            "format = 1\nconstants = {weight = 2}",
            "unknown constant of simulator pendulum 'weight'",
        ),
        (
            "format = 1",
            "format = 1\nconstants = {mass = -2}",
            "constant 'mass' of simulator pendulum must be > 0",
        ),
        (
            "format = 1",
            'format = 1\nconstants = {mass = "a"}',
            "constants.mass: expected a finite number, found 'a'",
        ),
        ("format = 1", "format = 1\nconstants = 3", "constants: expected a table, found 3"),
        (
            '[effects."drag.linear".coefficient]',
            '[effects."drag.linear"]',
            "expected a table with value and unit",
        ),
        (
            '[effects."drag.linear".coefficient]',
            "[effects]",
            "value: expected a table, found 0.0001",
        ),
        (
            "[parameters.inertia]",
            "[parameters]",
            "parameters.value: expected a table with value and unit",
        ),
        (GOOD, "", "expected an extended simulator with format = 1, found None"),
        (GOOD, "not = = toml", "not valid TOML"),
    ],
)
def test_a_malformed_file_is_one_line_that_names_it(path, old, new, message):
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        load_extended(path, simulators.get)
    assert "extended.toml" in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_missing_file_and_one_that_is_not_text(path, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_extended(tmp_path / "none.toml", simulators.get)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="expected UTF-8 text"):
        load_extended(path, simulators.get)


def test_as_a_plugin_it_is_registered_once_by_its_name(path, tmp_path):
    load_plugins([path, path])
    assert simulators.get("pendulum_extended").parameters[1].nominal == 7e-4
    other = tmp_path / "other.toml"
    other.write_bytes(path.read_bytes())
    with pytest.raises(
        InputError,
        match=r"other.toml: simulator 'pendulum_extended' exists already; give it another",
    ):
        load_plugins([other])
    with pytest.raises(InputError, match="no such file"):
        load_plugins([tmp_path / "none.toml"])


def test_it_makes_recordings_as_its_system_does(path):
    load_plugins([path])
    made = simulate_recording(
        simulation_spec(
            "pendulum_extended", runs=2, seconds=0.5, engine="mujoco", effects=["force.bias=1e-3"]
        )
    )
    assert made.truth["parameters"] == {
        "inertia": 3.1e-3,
        "drag.linear": 7e-4,
        "sensor.delay": 0.013,
    }
    assert 0.5 <= made.truth["runs"]["1"]["initial"]["q"] <= 1.5, "drawn as for any pendulum"
    assert made.recording.constants["mass"] == 0.2
    assert list(made.recording.runs[0].channels) == ["qd", "q"]
    with pytest.raises(InputError, match=r"effect drag.linear is named twice"):
        simulate_recording(simulation_spec("pendulum_extended", runs=1, effects=["drag.linear=1"]))


def test_an_extended_simulator_is_not_extended_again(path, tmp_path):
    load_plugins([path])
    twice = tmp_path / "twice.toml"
    write_extended(replace(MODEL, name="twice", system="pendulum_extended", effects={}), twice)
    with pytest.raises(
        InputError,
        match=r"twice.toml: simulator pendulum_extended is extended already; name .* pendulum",
    ):
        load_plugins([twice])


EXPERIMENT = """simulator = "pendulum_extended"
observe = ["q"]
targets = 1
budget = 4
ranges = ["in"]
initial = {q = [0.3, 1.0]}
[sampling]
rate = 50.0
samples = 30
[tuners.random]
"""


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_compare_tunes_it_in_worker_processes(path, tmp_path, capsys):
    (tmp_path / "swing.toml").write_text(EXPERIMENT)
    out = tmp_path / "out"
    command = [
        "compare",
        str(tmp_path / "swing.toml"),
        "--plugin",
        str(path),
        "--jobs",
        "2",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    rows = (out / "status.csv").read_text().splitlines()
    assert len(rows) == 2
    assert "done" in rows[1]
    import pandas as pd

    runs = pd.read_parquet(out / "runs.parquet")
    assert list(runs.k) == [0, 1, 2, 3, 4]
    assert {"proposal_drag.linear", "true_drag.linear", "recommendation_sensor.delay"} <= set(
        runs.columns
    )
    assert runs["true_drag.linear"].between(5.6e-4, 8.4e-4).all()
