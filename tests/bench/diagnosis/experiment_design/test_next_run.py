"""Tests that a designed run, simulated with SciPy, separates the competing causes."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import simgap
from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.experiment_design.information_gain import RunValue
from bench.diagnosis.experiment_design.next_run import (
    _iterate_connected_groups,
    _may_longer_run_help,
)
from sims.core.simulator import InputError
from sims.robot.contact_pairs import find_contacts
from tests.bench.diagnosis.simulated_logs import write_log
from tests.command_output import run_command

MASS, LENGTH, INERTIA, NOISE = 0.2, 0.15, 0.006, 4e-3
TIMES = np.arange(0.0, 4.0, 0.02)
PENDULUM = (
    f'system = "pendulum"\n[channels.q]\nunit = "rad"\nnoise = {NOISE}\n[inputs.u]\n'
    f'unit = "N*m"\n[constants]\nmass = {MASS}\nlength = {LENGTH}\ngravity = 9.80665\n'
)


def write(folder, name, runs, lag=0.0, push=0.0, seed=0):
    """Write a pendulum recording with a drive lag and a constant torque; return its path.

    Args:
        runs: for each run its times, torques (held between samples), initial angle and speed.
        lag: time constant of the first-order drive in s.
        push: constant torque in N m.
    """
    rng, columns = np.random.default_rng(seed), []
    for times, torques, q0, v0 in runs:

        def rate(_t, x, held):
            drive = x[2] if lag else held
            pull = drive + push - MASS * 9.80665 * LENGTH * np.sin(x[0])
            return [x[1], pull / INERTIA, (held - x[2]) / lag if lag else 0.0]

        state, q = np.array([q0, v0, torques[0]]), []
        for i, begin in enumerate(times):
            q.append(state[0])
            if i + 1 < times.size:
                end = times[i + 1]
                done = solve_ivp(
                    rate, (begin, end), state, args=(torques[i],), rtol=1e-8, atol=1e-10
                )
                state = done.y[:, -1]
        columns.append((times, torques, np.array(q) + NOISE * rng.standard_normal(len(q))))
    return write_log(folder, PENDULUM, "u,q", columns, name)


def slow(count=3):
    """Return runs whose torques are so slow that a delay and a lag look alike."""
    return [(TIMES, 0.06 * np.sin(2 * TIMES + k), 0.05 * k, 0.0) for k in range(count)]


def drawn(design):
    """Return three copies of the designed run."""
    (torques,) = design.inputs.values()
    one = design.times, torques, design.initial["q"], design.initial["qd"]
    return [one, one, one]


def names_of(explanation):
    (cause,) = explanation.causes
    return {cause.effect, *cause.alternatives}


@pytest.mark.slow
def test_the_proposed_run_splits_the_set(tmp_path):
    before = write(tmp_path, "before", slow(), lag=0.04)
    # With three fitted runs, a delay and a lag would be distinguishable.
    with before.with_suffix(".toml").open("a") as description:
        description.write("[runs.3]\nheld_out = true\n")
    proposed = simgap.design(before)
    ambiguous = names_of(proposed.explanation)
    assert {"input.lag", "input.delay"} <= ambiguous
    design = proposed.design
    assert design.by == "T"
    assert {design.effect, *design.discrimination} == ambiguous
    assert design.distinguished_effects
    assert design.times[-1] <= 4.0
    after = write(tmp_path, "after", drawn(design), lag=0.04, seed=1)
    names = names_of(simgap.explain([before, after]))
    assert "input.lag" in names
    # The run separates the causes that it was predicted to separate.
    kept = "input.lag" in (design.effect, *design.distinguished_effects)
    assert kept
    assert len(names) < len(ambiguous)
    assert "input.delay" not in names


def test_what_no_run_can_split_is_said(tmp_path):
    path = write(tmp_path, "push", slow(), push=0.02)
    out = tmp_path / "next.csv"
    said = run_command("design", path, "--out", out).out
    assert "force.bias" in said
    assert "input.bias" in said
    assert "no run of this kind distinguishes it from" in said


def test_what_is_known_is_narrowed(tmp_path):
    """No cause is open, so the most informative run is proposed, and its prediction is checked."""
    path = write(tmp_path, "clean", slow())
    out = tmp_path / "next.csv"
    said = run_command("design", path, "--out", out, "--seconds", "3").out
    assert "no causes need to be distinguished: it shrinks" in said
    factor = float(said.split("factor of ")[1].split()[0])
    columns = np.genfromtxt(out, delimiter=",", names=True)
    assert columns.dtype.names == ("t", "u")
    assert columns["t"][-1] == pytest.approx(2.98, abs=0.021)
    design = simgap.design(path, seconds=3.0).design
    after = write(tmp_path, "after", drawn(design)[:1] * 3, seed=2)
    # One of three runs is held out, so both logs together give slightly more than one alone.
    one = simgap.explain(path).answer.parameters["inertia"]
    both = simgap.explain([path, after]).answer.parameters["inertia"]
    narrowed = (one.high - one.low) / (both.high - both.low)
    assert factor * 0.6 < narrowed < factor * 2.5


def test_what_is_asked_wrongly_is_one_line(tmp_path):
    path = write(tmp_path, "clean", slow())
    out = tmp_path / "next.csv"
    out.write_text("mine")
    assert "next.csv" in run_command("design", path, "--out", out, code=2).err
    assert out.read_text() == "mine"
    with pytest.raises(InputError, match="seconds: expected a number of seconds above 0, found -1"):
        simgap.design(path, seconds=-1)
    with pytest.raises(InputError, match="seconds: expected 0 to 600, found 601"):
        simgap.design(path, seconds=601)
    with pytest.raises(InputError, match="longest: expected 4 to 600, found 2"):
        simgap.design(path, longest=2)


def test_what_hangs_together_and_what_a_longer_run_would_tell():
    least = np.array([[0, 90, 7, 80.0], [90, 0, 95, 3.0], [7, 95, 0, 60.0], [80, 3, 60, 0]])
    assert list(_iterate_connected_groups(["a", "b", "c", "d"], least)) == [("a", "c"), ("b", "d")]
    run = RunValue(None, least + np.triu(least), 0.0, is_exact=True)
    # With 7 and 3 noise variances, twice the run length may exceed the threshold of 25.
    assert _may_longer_run_help(run, 2.0)
    assert not _may_longer_run_help(run, 1.0)
    run = RunValue(None, np.where(least < 10, 1.0, least), 0.0, is_exact=True)
    assert not _may_longer_run_help(run, 5.0)


def test_parts_that_touch_are_seen(tmp_path):
    path = tmp_path / "two.xml"
    path.write_text(
        '<mujoco><worldbody><geom name="wall" type="box" pos="0.6 0 0" size="0.1 1 1"/>'
        '<body><joint name="hip" axis="0 1 0"/><geom name="leg" type="capsule" size="0.05" '
        'fromto="0 0 0 0 0 -1"/></body></worldbody></mujoco>'
    )
    kind = make_robot_simulator(path)
    angles = np.linspace(0, 1.5, 50)
    assert find_contacts(kind, {"q.hip": 0.2 * angles}) == frozenset()
    assert find_contacts(kind, {"q.hip": -angles}) == {(0, 1)}
