"""Tests of a robot from its model file with the public commands: a log is simulated, isolated
tuners are compared on it, and least squares recovers the true parameters.
"""

import pandas as pd
import pytest

from tests.bench.diagnosis.pendulum_recordings import SWINGING, written
from tests.command_output import run_command

TRUE_PARAMETERS = {"drag.linear@elbow": 0.13, "mass.scale@fore": 0.2}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Log of the arm with a damping and a mass that differ from its model file."""
    folder = tmp_path_factory.mktemp("log")
    model = written(folder)
    given = [f"{name}={value}" for name, value in TRUE_PARAMETERS.items()]
    size = ["--runs", "3", "--seconds", "1.6", "--rate", "50"]
    arguments = ["simulate", "--model", str(model), "--effect", *given, "--noise", "1e-4", *size]
    run_command(*arguments, "--out", folder / "log.csv")
    return folder / "log.csv"


@pytest.fixture(scope="module")
def compared(log, tmp_path_factory):
    """Folder of a comparison on the log, made with the command."""
    out = tmp_path_factory.mktemp("compared") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMGAP_CACHE", str(out.parent / "cache"))
        arguments = ["compare", "--recording", str(log), "--free", "damping@elbow,mass@fore"]
        arguments += ["--tuners", "random,least_squares,tunenet", "--training-budget", "32"]
        arguments += ["--targets", "1", "--budget", "30", "--jobs", "1", "--salt", "public"]
        run_command(*arguments, "--out", out)
    return out


@pytest.mark.slow
def test_the_true_parameters_are_recovered_from_the_log(compared):
    runs = pd.read_parquet(compared / "runs.parquet")
    ends = runs.sort_values("k").groupby("tuner").last()
    for name, value in TRUE_PARAMETERS.items():
        found = ends.loc["least_squares", f"recommendation_{name}"]
        assert found == pytest.approx(value, rel=0.01)
    held_out = ends["heldout_error_q.elbow"]
    assert held_out["least_squares"] < 1e-3 < held_out["random"]
    statuses = pd.read_csv(compared / "status.csv")
    assert set(statuses["status"]) <= {"done", "converged"}
    assert set(statuses["simulator"]) == {"swinging"}
    assert not statuses["trusted"].any()
    trained = pd.read_csv(compared / "training.csv")
    assert list(trained["simulations"]) == [32]


@pytest.mark.slow
def test_identifiable_numbers_are_next_to_the_errors(compared):
    table = pd.read_csv(compared / "identifiability.csv")
    assert list(table["target"]) == ["real-000"] * 2, "all starts have one log"
    assert table["stiff"].all()
    assert (compared / "figures" / "identifiability.png").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_finished_comparison_is_taken_up_and_one_of_another_file_is_not(compared, log):
    run_command("compare", "--resume", compared, "--jobs", "1")
    written(log.parent, SWINGING.replace('mass="0.8"', 'mass="0.81"'))
    assert (
        "its model file changed since it was started"
        in run_command("compare", "--resume", compared, code=2).err
    )
    written(log.parent)


def test_options_that_contradict_each_other_are_one_line(tmp_path):
    model = str(written(tmp_path))
    for arguments, message in (
        (["ball-drop", "--model", model], "states what it tunes: leave out model"),
        (["--model", model], "found none"),
        (["--model", str(tmp_path / "no.xml"), "--free", "x"], "no.xml: no such file"),
        (["--resume", "x", "--free", "damping@*"], "leave out free"),
    ):
        error = run_command("compare", *arguments, code=2).err
        assert message in error
        assert error.count("\n") == 1
