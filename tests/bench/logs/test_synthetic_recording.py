import math

import numpy as np
import pytest

from bench.core.input_signals import evaluate_signal
from bench.core.plugin_registries import load_plugins, simulators
from bench.logs.synthetic_recording import simulate_recording
from sims.core.simulator import InputError
from sims.core.toml_validation import read_toml
from sims.recording.recording import read_recording
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.simulation_arguments import simulation_spec, write

RNG = np.random.default_rng(0)
TIMES = np.arange(400) / 100


def read(path):
    return read_recording(path, simulators.get(read_toml(path.with_suffix(".toml"))["system"]))


def test_the_command_of_the_readme_just_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = [
        "simulate",
        "ball",
        "--effect",
        "drag.quadratic=0.05",
        "--noise",
        "0.005",
        "--runs",
        "4",
    ]
    said = run_command(*command, "--out", "drop.csv").out
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "drop.csv",
        "drop.toml",
        "drop.truth.toml",
    ]
    assert "drop.csv: 4 runs of 4 s at 100 Hz, channels x, y, z" in said
    recording = read(tmp_path / "drop.csv")
    assert [run.held_out for run in recording.runs] == [False, False, False, True]
    assert all(run.times.size == 400 for run in recording.runs)
    assert recording.noise == {"x": 0.005, "y": 0.005, "z": 0.005}
    assert recording.constants == {"mass": 1.0, "radius": 0.5, "gravity": 9.81}
    truth = read_toml(tmp_path / "drop.truth.toml")
    assert truth["effects"] == {"drag.quadratic": [0.05]}
    assert truth["parameters"] == {"restitution": 0.5}
    for run in recording.runs:
        began = truth["runs"][run.name]["initial"]
        assert 3 <= began["z"] <= 5
        assert -1 <= began["vx"] <= 1
        assert run.channels["z"][0] == pytest.approx(began["z"], abs=0.025)
        resting = run.channels["z"][300:]
        assert resting.mean() == pytest.approx(0.5, abs=0.002)
        assert resting.std() == pytest.approx(0.005, rel=0.2)


def test_the_recording_does_not_contain_its_parameters(tmp_path):
    write(
        simulation_spec("ball", ["restitution=0.7654"], ["drag.quadratic=0.0123"]),
        tmp_path / "a.csv",
    )
    description = (tmp_path / "a.toml").read_text()
    assert not any(
        secret in description
        for secret in ("0.7654", "0.0123", "drag", "restitution", "initial", "seed")
    )
    assert (tmp_path / "a.csv").read_text().startswith("run,t,x,y,z\n1,0,0,0,3.")


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path):
    wish = {"system": "servo", "noise": ["0.01"], "runs": 2, "seconds": 0.5}
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write(simulation_spec(**wish, seed=seed), tmp_path / f"{name}.csv")
    read = {name: (tmp_path / f"{name}.csv").read_bytes() for name in "abc"}
    assert read["a"] == read["b"] != read["c"]


def test_draws_do_not_depend_on_further_requests():
    few = simulate_recording(simulation_spec("ball", runs=2, noise=["0.01"], seconds=0.3)).recording
    many = simulate_recording(
        simulation_spec("ball", runs=3, noise=["0.01"], seconds=0.3, effects=["drag.linear=0"])
    ).recording
    for a, b in zip(few.runs, many.runs[:2], strict=True):
        np.testing.assert_array_equal(a.channels["z"], b.channels["z"])
    louder = simulate_recording(
        simulation_spec("ball", runs=2, noise=["z=0.02"], seconds=0.3)
    ).recording
    quiet = simulate_recording(simulation_spec("ball", runs=2, seconds=0.3)).recording
    noise = few.runs[0].channels["z"] - quiet.runs[0].channels["z"]
    np.testing.assert_allclose(
        louder.runs[0].channels["z"] - quiet.runs[0].channels["z"], 2 * noise, atol=1e-12
    )
    assert louder.noise == {"z": 0.02}


def test_what_is_recorded_is_what_the_closed_form_says():
    made = simulate_recording(
        simulation_spec(
            "ball",
            initial=["z=100", "vx=2"],
            constants=["gravity=1.62"],
            runs=1,
            seconds=2,
            rate=50,
        )
    )
    (run,) = made.recording.runs
    np.testing.assert_allclose(run.channels["z"], 100 - 0.81 * run.times**2, rtol=1e-9)
    np.testing.assert_allclose(run.channels["x"], 2 * run.times, rtol=1e-9)
    assert made.recording.constants["gravity"] == 1.62
    assert not made.recording.held_out()
    made = simulate_recording(
        simulation_spec("slider", ["2"], inputs=["u=3"], observe=["v"], runs=1, seconds=1)
    )
    np.testing.assert_allclose(
        made.recording.runs[0].channels["v"], 1.5 * made.recording.runs[0].times, atol=1e-9
    )
    assert list(made.recording.runs[0].channels) == ["v"]


@pytest.mark.parametrize("system", ["ball", "pendulum", "slider", "servo"])
def test_every_system_has_defaults_under_which_it_moves(system, tmp_path):
    write(simulation_spec(system, runs=2), tmp_path / "a.csv")
    recording = read(tmp_path / "a.csv")
    first = next(iter(recording.runs[0].channels.values()))
    assert np.ptp(first) > 0.05
    assert not np.array_equal(first, next(iter(recording.runs[1].channels.values()))), "runs differ"


def test_a_simulator_without_engines_is_a_system_too(tmp_path, spring):
    load_plugins([PLUGINS / "spring.py"])
    made = simulate_recording(
        simulation_spec("spring", ["3.5,0.2"], runs=1, seconds=1, observe=["x"])
    )
    t = made.recording.runs[0].times
    np.testing.assert_allclose(
        made.recording.runs[0].channels["x"], np.exp(-0.2 * t) * np.cos(3.5 * t), rtol=1e-12
    )
    with pytest.raises(InputError, match="simulator spring supports neither effects nor engines"):
        simulate_recording(simulation_spec("spring", effects=["drag.linear=1"]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": "bal"}, "unknown simulator 'bal'; there are: "),
        ({"theta": ["restitution=2"]}, "parameter restitution = 2: expected 0 to 1$"),
        ({"theta": ["restituton=0.5"]}, "unknown parameter 'restituton'; there are: restitution"),
        ({"theta": ["0.5,0.6"]}, r"expected 1 values \(restitution\), found 2"),
        ({"theta": ["restitution=high"]}, "--theta restitution=high: expected a number"),
        ({"theta": ["restitution=1", "restitution=1"]}, "restitution is given twice"),
        ({"effects": ["drag.cubic=1"]}, "unknown effect 'drag.cubic'; did you mean "),
        (
            {"effects": ["input.delay=1"]},
            "system ball cannot have effect input.delay: it has no input",
        ),
        ({"effects": ["drag.linear=1,2"]}, "effect drag.linear: expected up to 1 values"),
        ({"effects": ["drag.linear"]}, "--effect drag.linear: expected NAME=VALUE"),
        ({"effects": ["drag.linear=nan"]}, "--effect drag.linear=nan: expected a number"),
        ({"constants": ["grav=1"]}, "unknown constant 'grav'; there are: gravity, mass, radius"),
        ({"constants": ["mass=-1"]}, "'mass' of simulator ball must be > 0, found -1"),
        ({"noise": ["accel_z=1"]}, "unknown recorded channel 'accel_z'; there are: x, y, z"),
        ({"noise": ["1", "2"]}, "--noise 1 2: expected one number for all channels"),
        ({"noise": ["-1"]}, "noise of x = -1: expected at least 0"),
        ({"inputs": ["u=1"]}, "unknown input 'u'; there are: none"),
        ({"initial": ["q=1"]}, "unknown initial state 'q'; there are: vx"),
        ({"initial": ["z=3:1"]}, "--initial z=3:1: expected LOW:HIGH"),
        ({"observe": ["w"]}, "unknown channel of simulator ball 'w'"),
        ({"seconds": 0.001}, "expected at least 2 samples"),
        ({"seconds": math.inf}, "expected at least 2 samples"),
        ({"rate": math.nan}, "expected at least 2 samples"),
        ({"held_out": 4}, "held_out = 4: expected fewer than the 4 runs"),
        ({"engine": "ode"}, "unknown engine 'ode'; there are: batch, mujoco, pybullet"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(changes, message, tmp_path):
    with pytest.raises(InputError, match=message) as caught:
        write(simulation_spec(**{"system": "ball", **changes}), tmp_path / "a.csv")
    assert str(caught.value).isprintable()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_over(tmp_path):
    for name in ("a.csv", "a.toml", "a.truth.toml"):
        (tmp_path / name).write_text("mine")
        with pytest.raises(InputError, match=f"{name}: exists already"):
            write(simulation_spec("ball"), tmp_path / "a.csv")
        assert [p.name for p in tmp_path.iterdir()] == [name]
        (tmp_path / name).unlink()
    with pytest.raises(InputError, match=r"expected a name that ends in \.csv"):
        write(simulation_spec("ball"), tmp_path / "a.txt")


def test_signals():
    np.testing.assert_array_equal(evaluate_signal("2.5", TIMES, RNG), 2.5)
    np.testing.assert_array_equal(evaluate_signal("constant:-1", TIMES, RNG), -1.0)
    np.testing.assert_allclose(evaluate_signal("sine:2:0.5", TIMES, RNG), 2 * np.sin(np.pi * TIMES))
    square = evaluate_signal("square:3:1", TIMES, RNG)
    assert (square[:50] == 3).all()
    assert (square[50:100] == -3).all()
    steps = evaluate_signal("steps:2:0.5", TIMES, np.random.default_rng(1))
    assert len(set(steps.tolist())) == 8
    assert (steps.reshape(8, 50) == steps[::50, None]).all()
    assert np.abs(steps).max() <= 2
    chirp = evaluate_signal("chirp:1:1:9", TIMES, RNG)
    crossings = TIMES[1:][np.diff(np.signbit(chirp))]
    frequency = 1 + 8 * (crossings[1:] + crossings[:-1]) / 2 / TIMES[-1]
    np.testing.assert_allclose(np.diff(crossings), 1 / (2 * frequency), atol=0.011)  # one sample
    assert len(crossings) == pytest.approx(2 * 5 * 4, abs=1)
    for text, message in [
        ("noise:1", "unknown signal 'noise'; there are: chirp, constant, multisine, sine"),
        ("sine:1", r"signal 'sine:1': expected sine:AMPLITUDE:HERTZ"),
        ("steps:1:0", "all but the first > 0"),
        ("x", "signal 'x': expected constant:VALUE"),
        ("sine:nan:1", "expected sine"),
    ]:
        with pytest.raises(InputError, match=message):
            evaluate_signal(text, TIMES, RNG)
