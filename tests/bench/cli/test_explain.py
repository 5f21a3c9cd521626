"""Tests of the commands `simgap explain` and `simgap score`."""

import json
import signal

import pytest

from bench.cli.progress_display import ProgressDisplay
from bench.core.plugin_registries import simulators
from sims.extended_simulator import load_extended
from tests.bench.diagnosis import verdict_schema
from tests.command_output import run_command


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with recordings of a pendulum with drag, simulated with MuJoCo, and an explanation."""
    there = tmp_path_factory.mktemp("commands")
    command = [
        "simulate",
        "pendulum",
        "--engine",
        "mujoco",
        "--effect",
        "drag.linear=1e-3",
        "--theta",
        "inertia=4e-3",
    ]
    command += ["--noise", "q=0.003", "qd=0.02", "--runs", "3", "--seconds", "1.5", "--rate", "60"]
    run_command(*command, "--out", there / "swing.csv")
    run_command(*command, "--seed", "9", "--out", there / "other.csv")
    run_command("explain", there / "swing.csv", "--out", there / "out")
    return there


def faulty(*command):
    """Return the single error line of a command that must fail, without progress lines."""
    told = run_command(*command, code=2)
    lines = [line for line in told.err.splitlines() if not line.endswith(" ...")]
    assert len(lines) == 1
    assert lines[0].startswith("simgap: ")
    assert "Traceback" not in told.err
    return lines[0]


def test_explain_writes_verdict_simulator_figures_and_report(folder):
    names = {path.name for path in (folder / "out").iterdir()}
    assert {"verdict.json", "extended.toml", "report.html"} <= names
    assert any(name.endswith(".png") for name in names)
    report = (folder / "out" / "report.html").read_text()
    assert "linear drag" in report
    assert "http://" not in report.replace("http://www.w3.org", "")


def test_the_verdict_is_right_and_has_the_form_of_the_design(folder):
    found = verdict_schema.check((folder / "out" / "verdict.json").read_text())
    assert (found["verdict"], found["system"], found["engine"]) == ("named", "pendulum", "batch")
    (cause,) = found["causes"]
    assert (cause["effect"], cause["alternatives"]) == ("drag.linear", [])
    assert cause["p_value"] < 1e-6
    drag = cause["coefficients"]["coefficient"]
    assert drag["unit"] == "N*m*s/rad"
    assert drag["value"] == pytest.approx(1e-3, rel=0.02)
    assert drag["low"] < 1e-3 < drag["high"]
    inertia = found["parameters"]["inertia"]
    assert inertia["value"] == pytest.approx(4e-3, rel=2e-3)
    held_out = found["heldout"]
    assert held_out["noise_floor"] == pytest.approx(0.003)
    assert held_out["rmse_extended"] == pytest.approx(0.003, rel=0.2)
    assert held_out["rmse_base"] > 0.02
    assert held_out["low"] <= held_out["gap_closed"] <= held_out["high"]
    assert held_out["gap_closed"] > 0.95
    assert found["candidates"][0]["effect"] == "drag.linear"
    assert found["seconds"] < 60


def test_the_account_says_what_was_found_and_nothing_left_over_needs_no_thorough_search(
    folder, monkeypatch
):
    monkeypatch.chdir(folder)
    told = run_command("explain", "swing.csv", "--seed", "0", "--thorough")
    assert "The simulation lacks linear drag" in told.out
    (made,) = (folder / "results").iterdir()
    assert f"report      results/{made.name}/report.html" in told.out
    again, first = (
        json.loads((part / "verdict.json").read_text()) for part in (made, folder / "out")
    )
    assert again.pop("seconds") > 0
    first.pop("seconds")
    assert again == first, "the same seed says the same"
    assert (made / "extended.toml").read_bytes() == (folder / "out" / "extended.toml").read_bytes()
    environment = json.loads((made / "environment.json").read_text())
    assert environment["settings"]["thorough"] is True


def test_score_says_it_to_a_person(folder):
    out = run_command(
        "score", folder / "out" / "extended.toml", folder / "other.csv", "--held-out"
    ).out.splitlines()
    assert out[0].startswith("q: RMSE 0.00")
    assert out[0].endswith(" rad")
    assert out[-1].endswith("times the noise; 1 run, 90 samples") or out[-1].endswith(
        "1 run, 90 samples"
    )


def test_nothing_is_written_over(folder, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    line = faulty("explain", folder / "swing.csv", "--out", tmp_path / "full")
    assert "full: exists and is not empty" in line
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]
    line = faulty("explain", folder / "swing.csv", "--out", tmp_path / "full" / "mine.txt")
    assert "mine.txt: exists and is not empty" in line


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--system", "ball"], "unknown channel"),
        (["--system", "bal"], "unknown simulator 'bal'; there are: "),
        (["--engine", "ode"], "unknown engine 'ode'; there are: batch, mujoco, pybullet"),
        (
            ["--free", "weight"],
            "unknown constant of system pendulum 'weight'; there are: gravity, length, mass",
        ),
        (["--tuner", "magic"], "unknown tuner 'magic'; there are: "),
        (["--tuner", "tunenet"], "tuner tunenet must be trained first"),
        (["--plugin", "none.py"], "no such file"),
        (["--plugin", "none.toml"], "no such file"),
    ],
)
def test_bad_options_are_one_line(folder, tmp_path, options, message):
    assert message in faulty("explain", folder / "swing.csv", "--out", tmp_path / "o", *options)
    assert not (tmp_path / "o").exists()


def test_bad_files_are_one_line(folder, tmp_path):
    model = folder / "out" / "extended.toml"
    assert "none.csv" in faulty("explain", tmp_path / "none.csv").replace("none.toml", "none.csv")
    assert "none.toml: no such file" in faulty(
        "score", tmp_path / "none.toml", folder / "swing.csv"
    )
    assert "format" in faulty("score", folder / "swing.toml", folder / "swing.csv")
    assert "none" in faulty("score", model, tmp_path / "none.csv")


def test_a_tuner_may_find_where_the_fit_begins(folder, tmp_path):
    run_command(
        "explain", folder / "swing.csv", "--tuner", "least_squares", "--out", tmp_path / "o"
    )
    found = verdict_schema.check((tmp_path / "o" / "verdict.json").read_text())
    assert [cause["effect"] for cause in found["causes"]] == ["drag.linear"]


def test_a_budget_that_is_over_leaves_an_answer_that_says_so(folder, tmp_path):
    out = tmp_path / "out"
    told = run_command("explain", folder / "swing.csv", "--budget", "1e-3", "--out", out).out
    found = verdict_schema.check((out / "verdict.json").read_text())
    assert (found["verdict"], found["cut"]["by"]) == ("unknown", "budget")
    assert "The search was stopped by its time budget" in " ".join(told.split())
    assert load_extended(out / "extended.toml", simulators.get).name == "pendulum_extended"


@pytest.mark.parametrize("budget", ["0", "-3", "nan", "soon"])
def test_a_bad_budget_is_one_line(folder, budget):
    line = faulty("explain", folder / "swing.csv", f"--budget={budget}")
    assert f"expected a number of seconds above 0, found '{budget}'" in line


def interrupted(monkeypatch, times):
    """Send Ctrl-C `times` times from `ProgressDisplay.completed`."""
    left = [times]

    def completed(*_):
        while left[0]:
            left[0] -= 1
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(ProgressDisplay, "completed", completed)


def test_ctrl_c_ends_with_what_there_is_and_is_an_interrupt(folder, tmp_path, monkeypatch):
    interrupted(monkeypatch, 1)
    out = tmp_path / "out"
    told = run_command("explain", folder / "swing.csv", "--out", out, code=130)
    found = verdict_schema.check((out / "verdict.json").read_text())
    assert found["cut"]["by"] == "interrupt"
    assert "The search was stopped by an interrupt" in told.out
    assert "simgap: stopping with the results so far; Ctrl-C again stops at once" in told.err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_twice_ends_at_once_and_writes_nothing(folder, tmp_path, monkeypatch):
    interrupted(monkeypatch, 2)
    out = tmp_path / "out"
    told = run_command("explain", folder / "swing.csv", "--out", out, code=130)
    assert not out.exists()
    assert "interrupted before the first result" in told.err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
