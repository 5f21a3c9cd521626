from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.score_extended import score_model
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator, FittedValue, write_extended
from tests.command_output import run_command
from tests.simulation_arguments import simulation_spec
from tests.simulation_arguments import write as simulate

MODEL = ExtendedSimulator(
    "swing", "pendulum", "batch", "", {"inertia": FittedValue(4e-3, "kg*m^2", None, None)},
    {"drag.linear": {"coefficient": FittedValue(6e-4, "N*m*s/rad", None, None)}},
    {"mass": 0.15, "length": 0.15, "gravity": 9.81}, ["q", "qd"],
)  # fmt: skip
SIMULATION = simulation_spec(
    "pendulum",
    ["4e-3"],
    ["drag.linear=6e-4"],
    [],
    ["q=0.003", "qd=0.02"],
    [],
    ["q=-1.5:1.5"],
    [],
    3,
    1.5,
    60.0,
    "mujoco",
    5,
)


@pytest.fixture
def files(tmp_path):
    simulate(SIMULATION, tmp_path / "swing.csv")
    write_extended(MODEL, tmp_path / "extended.toml")
    return tmp_path / "extended.toml", tmp_path / "swing.csv"


def test_a_true_model_errs_by_the_noise(files):
    found = score_model(*files)
    assert found["rmse"]["q"] == pytest.approx(0.003, rel=0.1)
    assert found["rmse"]["qd"] == pytest.approx(0.02, rel=0.1)
    assert found["normalised_rmse"] == pytest.approx(1.0, abs=0.06)
    assert (found["runs"], found["samples"]) == (3, 270)
    assert found["units"] == {"q": "rad", "qd": "rad/s"}


def test_a_wrong_model_errs_by_more(files):
    model, recording = files
    write_extended(replace(MODEL, effects={}), model)
    without = score_model(model, recording)
    assert without["rmse"]["q"] > 0.015
    assert without["normalised_rmse"] == pytest.approx(
        np.sqrt(
            np.mean([(without["rmse"]["q"] / 0.003) ** 2, (without["rmse"]["qd"] / 0.02) ** 2])
        ),
        rel=1e-9,
    )
    write_extended(replace(MODEL, constants={**MODEL.constants, "gravity": 1.6}), model)
    stated = score_model(model, recording)
    assert stated["normalised_rmse"] == pytest.approx(1.0, abs=0.06), (
        "the recording states its own gravity"
    )


def test_held_out_runs_alone(files):
    model, recording = files
    found = score_model(model, recording, held_out=True)
    assert (found["runs"], found["samples"]) == (1, 90)
    text = recording.with_suffix(".toml").read_text()
    recording.with_suffix(".toml").write_text(text.replace("held_out = true", "held_out = false"))
    with pytest.raises(InputError, match=r"swing.csv: no run is marked held_out"):
        score_model(model, recording, held_out=True)


def test_missing_samples_do_not_count(files):
    model, recording = files
    lines = recording.read_text().splitlines()
    for i in range(5, 25):
        run, t, q, _ = lines[i].split(",")
        lines[i] = f"{run},{t},{q},"
    lines[30] = ",".join([*lines[30].split(",")[:2], "", ""])
    recording.write_text("\n".join(lines) + "\n")
    found = score_model(model, recording)
    assert found["samples"] == 269
    assert found["normalised_rmse"] == pytest.approx(1.0, abs=0.06)


def test_the_error_of_a_channel_is_that_of_its_samples(files):
    model, recording = files
    lines = recording.read_text().splitlines()
    half = [line if i % 2 else line.rpartition(",")[0] + "," for i, line in enumerate(lines[1:])]
    recording.write_text("\n".join([lines[0], *half]) + "\n")
    found = score_model(model, recording)
    assert found["rmse"]["q"] == pytest.approx(0.003, rel=0.1)
    assert found["rmse"]["qd"] == pytest.approx(0.02, rel=0.15), "and not 0.02 by the root of two"
    q, qd = found["rmse"]["q"] / 0.003, found["rmse"]["qd"] / 0.02
    assert found["normalised_rmse"] == pytest.approx(np.sqrt((2 * q**2 + qd**2) / 3), rel=1e-9)


def test_what_cannot_be_scored_is_one_line(files, tmp_path):
    model, recording = files
    simulate(simulation_spec("slider", runs=1, seconds=0.5), tmp_path / "other.csv")
    simulate(replace(SIMULATION, observe=["q"], noise=0.003), tmp_path / "angle.csv")
    for other, message in [
        ("other.csv", "other.csv|other.toml"),
        ("angle.csv", "unknown channel of .*angle.csv 'qd'; there are: q"),
        ("none.csv", "none.csv|none.toml"),
    ]:
        with pytest.raises(InputError, match=message) as caught:
            score_model(model, tmp_path / other)
        assert str(caught.value).isprintable()
    write_extended(
        replace(
            MODEL,
            effects={"drag.linear": {"coefficient": FittedValue(1e6, "N*m*s/rad", None, None)}},
        ),
        model,
    )
    with pytest.raises(InputError, match="the simulation failed with the parameters of"):
        score_model(model, recording)


def test_another_system_is_refused(files, tmp_path):
    model, _ = files
    simulate(simulation_spec("servo", runs=1, seconds=0.5), tmp_path / "arm.csv")
    with pytest.raises(
        InputError, match=r"arm.csv: expected a recording of pendulum, as .* is; found one of servo"
    ):
        score_model(model, tmp_path / "arm.csv")


@pytest.mark.parametrize(
    ("settings", "option"),
    [
        ('{"plugin": ["mine/cart.py"]}', "--plugin mine/cart.py"),
        ("{}", "--plugin FILE.py"),
        ("[]", "--plugin FILE.py"),
    ],
)
def test_a_file_of_an_own_simulator_names_the_option_that_it_needs(tmp_path, settings, option):
    file = tmp_path / "extended.toml"
    file.write_text('format = 1\nname = "cart_extended"\nsystem = "cart"\nobserve = ["x"]\n')
    (tmp_path / "environment.json").write_text(f'{{"settings": {settings}}}')
    log = tmp_path / "log.csv"
    log.write_text("run,t,x\n1,0,0\n")
    error = run_command("score", file, log, code=2).err
    assert error.startswith(f"simgap: {file}: extends simulator 'cart', which is not one of arm, ")
    assert error.endswith(f"; add the file that defines it: {option}\n")
