"""Tests of recordings of a robot with a floating base."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from bench.diagnosis.conventions.convention_comparison import (
    ConventionComparison,
    ConventionDifference,
)
from bench.diagnosis.conventions.convention_hypotheses import ConventionHypothesis
from bench.diagnosis.explain import explain
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError, Scenario
from sims.recording.recording import read_recording
from tests.bench.diagnosis.simulated_logs import write_log
from tests.command_output import run_command
from tests.sims.robot.test_floating_joints import SATELLITE
from tests.sims.robot.test_robot_motion import kind_of

MODEL = SATELLITE.replace('axis="0 0.6 0.8"', 'axis="0 0 1"')
HULL, PANEL = (5.0, 0.3, 0.3), (1.0, 0.03, 0.25)
"""Mass (kg), inertia about the centre of mass (kg m^2), and its distance from the hinge (m)."""
TRUE = 0.05
"""Drag in N m s/rad that the model file lacks."""
SPINS = (0.8, -0.5, 0.3)
"""Initial angular velocity of the hull in rad/s, by run."""
TOML = """model = "satellite.xml"
[channels."q.boom"]
unit = "rad"
noise = 0.001
[inputs."u.m_boom"]
unit = "N*m"
[runs.3]
held_out = true
"""


TIMES = np.arange(0.0, 3.0, 0.02)


def commands(run):
    """Return (T,) torques in N m, each held until the next sample."""
    return 0.12 * np.sin((2.0 + run) * TIMES) + 0.05 * np.cos(5.0 * TIMES)


def motion(run):
    """Return (T,) angles of the boom from Lagrange's equations.

    The two bodies move in a plane and their common centre of mass rests. With turns a of the hull
    and b of the panel, m = m1 m2 / (m1 + m2) and e the unit vectors along the bodies, the kinetic
    energy is I1 a'^2 / 2 + I2 b'^2 / 2 + m |r1 a' e1 + r2 b' e2|^2 / 2.
    """
    (m1, i1, r1), (m2, i2, r2) = HULL, PANEL
    m = m1 * m2 / (m1 + m2)

    def rates(_, state, command):
        a, b, va, vb = state
        cross = m * r1 * r2 * np.cos(a - b)
        inertia = np.array([[i1 + m * r1**2, cross], [cross, i2 + m * r2**2]])
        turning = m * r1 * r2 * np.sin(a - b) * np.array([-(vb**2), va**2])
        torque = command - (0.02 + TRUE) * (vb - va)
        return [va, vb, *np.linalg.solve(inertia, turning + torque * np.array([-1.0, 1.0]))]

    states = [np.array([0.0, 0.0, SPINS[run], SPINS[run]])]
    for span, command in zip(pairwise(TIMES), commands(run), strict=False):
        made = solve_ivp(rates, span, states[-1], "DOP853", args=(command,), rtol=1e-9, atol=1e-10)
        states.append(made.y[:, -1])
    return np.array([b - a for a, b, *_ in states])


STATED = "".join(f'[runs.{k}.initial]\n"qd.base.wz" = {spin}\n' for k, spin in enumerate(SPINS, 1))
TURNING = '[extra."qd.base.wz"]\nunit = "deg/s"\n'
"""Description of a log column with the spin of the hull."""


def recorded(tmp_path, toml=TOML + STATED, runs=3, spins=False):
    rng, columns = np.random.default_rng(4), []
    for run in range(runs):
        seen = motion(run) + rng.normal(0.0, 1e-3, TIMES.size)
        spin = np.full((TIMES.size, int(spins)), np.rad2deg(SPINS[run]))
        columns.append((TIMES, commands(run), seen, spin))
    names = "u.m_boom,q.boom" + ",qd.base.wz" * spins
    return write_log(tmp_path, toml, names, columns, satellite=MODEL)


@pytest.mark.parametrize("run", range(len(SPINS)))
def test_a_hull_that_spins_swings_its_boom_as_two_bodies_in_a_plane(run):
    simulator = kind_of(MODEL, free=("damping@boom",))(observe=["q.boom"])
    scenario = Scenario(TIMES, {"qd.base.wz": SPINS[run]}, {"u.m_boom": commands(run)})
    seen = simulator.simulate(np.array([[TRUE]]), scenario)[0, :, 0]
    np.testing.assert_allclose(seen, motion(run), atol=1e-6)


def test_pieces_of_what_floats_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"log\.csv: expected no --pieces: .* leave it out"):
        explain(recorded(tmp_path), pieces=1.0)


def test_a_column_says_where_a_run_begins(tmp_path):
    path = recorded(tmp_path, TOML + TURNING.replace('"', "", 2), spins=True)
    recording, kind = load_recording(path)
    found = [run.initial["qd.base.wz"] for run in recording.runs]
    np.testing.assert_allclose(found, SPINS, rtol=1e-6)
    assert check_recording_plausible(recording, kind) == []
    path.with_suffix(".toml").write_text(TOML + TURNING + '[runs.1.initial]\n"qd.base.wz" = 7.0\n')
    assert read_recording(path, kind).runs[0].initial == {"qd.base.wz": 7.0}, "stated in its place"


SINGLE = TOML.partition("[runs")[0]
BAD = {
    "nothing said": (
        TOML, 3, False,
        r"run 1: the log does not state where base begins; state \[runs\.1\.initial\], of "
        r"q\.base\.x, .*, "
        r"qd\.base\.wz \(states that are left out are as in the model file, at rest\), or insist",
    ),
    "one run without": (
        TOML + STATED.partition("[runs.3")[0], 3, False,
        r"run 3: the log does not state where base begins; state \[runs\.3\.initial\]",
    ),
    "a single run": (
        SINGLE + STATED.partition("[runs.2")[0], 1, False,
        r"run 1: the log does not state where base is when the last third of a single run "
        "begins; record",
    ),
    "a channel": (
        TOML + STATED + TURNING.replace("extra", "channels"), 3, True,
        r'channel qd\.base\.wz: expected a joint or a sensor, .*; as \[extra\."qd\.base\.wz"\]',
    ),
    "a unit": (
        TOML + TURNING.replace("deg/s", "m/s"), 3, True,
        r"extra qd\.base\.wz: expected a unit that converts to rad/s, found 'm/s'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_where_it_begins_is_asked_for_in_one_line(name, tmp_path):
    toml, runs, spins, message = BAD[name]
    path = recorded(tmp_path, toml, runs, spins)
    with pytest.raises(InputError, match=rf"log\.(csv|toml): {message}") as raised:
        check_recording_plausible(*load_recording(path))
    assert "\n" not in str(raised.value)


def test_conventions_are_compared_once_a_pose_is_stated(tmp_path, monkeypatch):
    difference = ConventionDifference(ConventionHypothesis("the boom looks reversed"), 30.0)
    monkeypatch.setattr(ConventionComparison, "differences", lambda _: [difference])
    path = recorded(tmp_path, TOML)
    output = run_command("inspect", path, "--out", tmp_path / "out").out
    assert "run 1: the log does not state where base begins" in output
    assert "conventions of the log are not compared" in output
    assert "convention:" not in output
    error = run_command("inspect", path, "--fix", tmp_path / "fixed.toml", code=2).err
    assert "state [runs.1.initial]" in error
    assert not (tmp_path / "fixed.toml").exists()
    path.with_suffix(".toml").write_text(TOML + STATED)
    output = run_command("inspect", path, "--out", tmp_path / "out").out
    assert "conventions of the log are not compared" not in output
    assert "convention: the boom looks reversed" in output


def test_a_simulated_log_says_where_its_runs_began(tmp_path):
    (tmp_path / "satellite.xml").write_text(MODEL)
    given = ["simulate", "--model", str(tmp_path / "satellite.xml"), "--runs", "2"]
    given += ["--seconds", "0.5", "--initial", "qd.base.wz=-1:1", "--out"]
    run_command(*given, tmp_path / "made.csv")
    recording, kind = load_recording(tmp_path / "made.csv")
    one, other = (run.initial["qd.base.wz"] for run in recording.runs)
    assert one != other
    assert check_recording_plausible(recording, kind) == []


def compared(tmp_path, *given):
    """Run a comparison with least squares; return the last row of each run by target."""
    free = ["--free", "damping@boom", "--tuners", "least_squares", "--targets", "1", "--seeds", "1"]
    size = ["--budget", "12", "--jobs", "0", "--trust", "--out", str(tmp_path / "out")]
    run_command("compare", *given, *free, *size)
    rows = pd.read_parquet(tmp_path / "out" / "runs.parquet").sort_values("k")
    return rows.groupby("target").last()


@pytest.mark.usefixtures("undrawn")
def test_a_log_of_what_floats_is_tuned_to(tmp_path):
    last = compared(tmp_path, "--recording", str(recorded(tmp_path)))
    found = last["recommendation_drag.linear@boom"].to_numpy()
    assert found == pytest.approx(TRUE, rel=0.02), "from the spins that the log states"
    assert last["heldout_error_q.boom"].to_numpy() < 2e-3


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_what_floats_is_tuned_to_simulations_of_itself(tmp_path):
    (tmp_path / "satellite.xml").write_text(MODEL)
    last = compared(tmp_path, "--model", str(tmp_path / "satellite.xml"))
    truth = last["true_drag.linear@boom"].to_numpy()
    assert len(set(truth.tolist())) > 1
    found = last["recommendation_drag.linear@boom"].to_numpy()
    np.testing.assert_allclose(found, truth, atol=1e-3)
