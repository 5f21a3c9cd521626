"""Tests of resource estimates: impossible sizes and invalid numbers are refused with one line."""

import time

import numpy as np
import pandas as pd
import pytest
import tomli_w

import simgap
from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.runner.comparison_resources import (
    check_comparison_size,
    estimate_comparison_need,
)
from bench.core.resource_estimates import (
    FORCE_HINT,
    MachineResources,
    ResourceNeed,
    check_feasible,
    get_machine_resources,
)
from bench.logs.quality.clock_checks import find_anomalies
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.recording_loading import load_recording as recorded
from sims.core.simulator import InputError
from tests.command_output import run_command

BASE = {
    "simulator": "pendulum",
    "observe": ["q"],
    "targets": 1,
    "budget": 3,
    "sampling": {"rate": 20.0, "samples": 30},
    "initial": {"q": [0.8, 1.2]},
    "tuners": {"random": {}},
}
NAN, INF = float("nan"), float("inf")
BALL = {"simulator": "ball", "observe": ["z"], "initial": {}}
LONG = "x" * 10**6


def fixed(value):
    return {"world": {"fixed": value}}


def drag(value):
    return fixed({"drag.linear": value})


def steps(engine, **sampling):
    return {"settings": {"engine": engine, "time_step": 1e-12}, **sampling}


# Changes to the experiment file, and the text that the error line must contain.
EXPERIMENTS = [
    ({"budget": 10**18}, "of memory"), ({"budget": 10**12}, "lower budget"),
    ({"budget": 10**400}, "whole number within"), ({"seeds": 10**9}, "lower seeds"),
    ({"seeds": 10**18}, "of memory"), ({"targets": 10**9}, "lower targets"),
    ({"targets": 10**18}, "of memory"),
    ({"tuners": {"random": {"seeds": 10**9}}}, "lower seeds"),
    ({"tuners": {"random": {"budget": 10**18}}}, "lower budget"),
    ({"sampling": {"rate": 1e9, "samples": 10**12}}, "of memory"),
    ({"sampling": {"samples": 10**18}}, "of memory"),
    ({"sampling": {"samples": 10**400}}, "whole number within"),
    ({"sampling": {"samples": 0}}, "at least 1 of samples"),
    ({"sampling": {"samples": -1}}, "at least 1 of samples"),
    ({"sampling": {"rate": 1e-9, "samples": 30}}, "steps"),
    ({"sampling": {"rate": 1e-300, "samples": 30}}, "steps"),
    ({"sampling": {"rate": 1e300}}, "sampling.rate"), ({"sampling": {"rate": 0.0}}, "above 0 Hz"),
    ({"sampling": {"rate": -5.0}}, "above 0 Hz"), ({"sampling": {"rate": NAN}}, "sampling.rate"),
    ({"sampling": {"rate": INF}}, "sampling.rate"),
    (steps("batch"), "longer time_step"), (steps("mujoco"), "longer time_step"),
    (steps("pybullet"), "longer time_step"),
    ({"world": {"engine": "mujoco", "time_step": 1e-12}}, "longer time_step"),
    ({"simulator": "arm", "observe": ["q1"], "initial": {}, "settings": {"time_step": 1e-12}},
     "longer time_step"),
    ({"settings": {"time_step": 10**400}}, "positive number of seconds"),
    ({"settings": {"engine": "batch", "time_step": 10**400}}, "positive number of seconds"),
    ({"settings": {"engine": "batch", "time_step": "x"}}, "positive number of seconds"),
    ({"settings": {"engine": "batch", "turn": NAN}}, "turn"),
    ({"training_budget": 10**18, "tuners": {"tunenet": {}}}, "lower training_budget"),
    ({"training_budget": -5}, "training_budget: expected at least 0"),
    ({"held_out": {"scenarios": 10**9}}, "lower held_out.scenarios"),
    ({"held_out": {"scenarios": 10**18}}, "of memory"),
    ({"held_out": {"initial": {"q": NAN}}}, "held_out.initial.q"),
    ({"title": LONG}, "at most 300 characters"), ({"says": LONG}, "at most 5000 characters"),
    ({"tags": [LONG]}, "at most 5000"), ({"tags": ["quick"] * 10**4}, "at most 5000"),
    ({"tuners": {LONG: {"tuner": "random"}}}, "at most 120"),
    ({"same_targets_as": LONG}, "at most 300"), ({"error_channel": LONG}, "unknown channel"),
    ({"simulator": LONG}, "unknown simulator"), ({"observe": ["q"] * 10**5}, "different channels"),
    ({"timeout": 1e308}, "timeout of at most"), ({"memory": 10**18}, "memory of at most"),
    ({"sweep": {k: [*range(1, 60)] for k in ("budget", "targets", "seeds")}}, "at most 10,000"),
    ({"sweep": {"budget": [3, 10**18]}}, "lower budget"),
    *(({"noise": {"q": v}}, "noise.q") for v in (NAN, INF, -0.1, 1e308, "x", True)),
    ({"ranges": ["in", "in"]}, "each once"), ({"ranges": []}, "one or more"),
    ({"ranges": [1]}, "ranges"), ({"ranges": "in"}, "ranges"),
    *(({"settings": {"effects": v}}, "effects: expected a list of names")
      for v in ([1], "x", {"drag.linear": 1.0}, [["drag.linear"]], 1, True)),
    *((fixed(v), "fixed: expected a table") for v in ("x", ["drag.linear"], 1)),
    *((drag(v), "finite coefficients") for v in ("x", NAN, 1e308, {"a": 1}, True, ["x"], 10**400)),
    (drag([]), "up to 1 values"), (drag(1e9), "within"),
    *(({"constants": {"gravity": v}}, "gravity") for v in (1e6, 1e308, -1.0, NAN, INF, 10**400)),
    *(({"constants": {"mass": v}}, "mass")
      for v in (1e308, 1e-300, [0.1, 1e308], [0.1, INF], [2.0, 1.0], [-1.0, 1.0], [NAN, 1.0])),
    ({"parameters": {"inertia": {"bounds": [1e-308, 1e308]}}}, "bounds"),
    ({"parameters": {"inertia": {"bounds": [-1e308, 1e308]}}}, "bounds"),
    ({"parameters": {"inertia": {"bounds": [0.0, INF]}}}, "bounds"),
    ({"parameters": {"inertia": {"bounds": [-1.0, 1.0]}}}, "bounds must be more than 0"),
    ({"parameters": {"inertia": {"training": [1.0, 1e308]}}}, "training"),
    ({"parameters": {"inertia": {"nominal": 1e308}}}, "nominal"),
    *(({"initial": {"q": v}}, "initial.q")
      for v in (1e308, INF, NAN, [0.0, INF], [-1e308, 1e308], [2.0, 1.0])),
    *(({"inputs": {"u": v}}, "signal")
      for v in ("sine:1e308:1", "sine:1:1e308", "steps:1:1e-12", "steps:1:1e-308", "nan",
                "chirp:1:1e300:1e308", f"sine:{'1' * 10**6}:1")),
    ({**BALL, "constants": {"gravity": 1e6}}, "0 to 1000 m/s"),
    ({**BALL, "constants": {"radius": 1e300}}, "radius"),
    ({**BALL, "simulator": "ball-filmed", "constants": {"pixels": 1e12}}, "16 to 4096 px"),
    ({**BALL, "shot": {"balls": ["golf"]}, "targets": 10**9}, "lower targets"),
    ({**BALL, "shot": {"heights": [0.3, INF]}}, "heights"),
]  # fmt: skip


def refused(*arguments):
    """Return the one-line error with which a command refuses, and check that it is quick."""
    begun = time.perf_counter()
    out, err = run_command(*arguments, code=2)
    assert not out
    assert err.startswith("simgap: ")
    assert err.count("\n") == 1
    assert err.strip().isprintable()
    assert len(err) < 1000
    assert time.perf_counter() - begun < 20
    return err


@pytest.mark.parametrize("place", range(len(EXPERIMENTS)))
def test_experiments_beyond_all_measure_are_refused(tmp_path, place):
    changes, says = EXPERIMENTS[place]
    path = tmp_path / "e.toml"
    path.write_text(tomli_w.dumps({**BASE, **changes}))
    arguments = ["compare", path, "--jobs", 0, "--out", tmp_path / "out"]
    assert says in refused(*arguments)
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--budget", 10**18], "lower budget"),
        (["--budget", "1" + "0" * 400], "--budget: expected a whole number"),
        (["--budget", "1" + "0" * 5000], "--budget: expected a whole number"),
        (["--seeds", 10**15, "--tuners", "cma_es"], "lower seeds"),
        (["--targets", 10**9], "lower targets"),
        (["--training-budget", 10**18, "--tuners", "tunenet"], "lower training_budget"),
        (["--jobs", 10**6], "lower jobs"),
        (["--jobs", 10**18], "lower jobs"),
        (["--timeout", "nan"], "--timeout"),
        (["--memory", 10**20], "--memory"),
    ],
)
def test_options_of_compare_beyond_all_measure(tmp_path, options, message):
    path = tmp_path / "e.toml"
    path.write_text(tomli_w.dumps(BASE))
    line = refused("compare", path, "--out", tmp_path / "out", *options)
    assert message in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--runs", 10**9], "of memory"),
        (["--runs", 10**18, "--seconds", 0.1], "of memory"),
        (["--rate", 1e-9, "--seconds", 1e10], "of memory"),
        (["--engine", "mujoco", "--seconds", 1e9, "--rate", 0.01], "of memory"),
        (["--rate", 1e-9], "at least 2 samples"),
        (["--rate", 1e9], "at least 2 samples"),
        (["--rate", "inf"], "at least 2 samples"),
        (["--rate", 1e308, "--seconds", 1e-306], "at least 2 samples"),
        (["--seconds", 1e6], "at least 2 samples"),
        (["--seconds", "nan"], "at least 2 samples"),
        (["--held-out", 10**12], "held_out"),
        (["--noise", "nan"], "--noise"),
        (["--noise", "-1"], "noise of q"),
        (["--noise", "1e308"], "noise of q"),
        (["--constant", "gravity=1e6"], "0 to 1000 m/s"),
        (["--constant", "gravity=1e308"], "gravity"),
        (["--constant", "mass=1e-300"], "mass"),
        (["--theta", "inertia=1e308"], "inertia"),
        (["--effect", "drag.linear=1e308"], "drag.linear"),
        (["--effect", "spring.linear=1e9"], "spring.linear"),
        (["--effect", "clock.skew=1e12"], "clock.skew"),
        (["--effect", "sensor.delay=-1e12"], "sensor.delay"),
        (["--effect", "drag.linear=" + ",".join(["1"] * 10**4)], "up to 1 values"),
        (["--initial", "q=1e308"], "initial state q"),
        (["--initial", "q=-1e308:1e308"], "initial state q"),
        (["--input", "u=steps:1:1e-12"], "signal"),
        (["--observe", ",".join(["q"] * 10**5)], "different channels"),
    ],
)
def test_simulations_beyond_all_measure(tmp_path, options, message):
    line = refused("simulate", "pendulum", "--out", tmp_path / "s.csv", *options)
    assert message in line
    assert not list(tmp_path.iterdir())


DESCRIPTION = 'system = "pendulum"\n[channels.q]\nunit = "rad"\n'


def swing(folder, factor=1.0, gap=0.0, start=0.0, toml=DESCRIPTION, name="1"):
    """Write a recording of a swing; stamps are `start + factor * t`, with a gap after t = 0.6 s."""
    t = np.arange(120) * 0.01
    stamps = start + factor * np.where(t > 0.6, t + gap, t)
    path = folder / "swing.csv"
    frame = pd.DataFrame({"run": name, "t": stamps, "q": 0.5 * np.cos(8.2 * t)})
    frame.to_csv(path, index=False)
    path.with_suffix(".toml").write_text(toml)
    return path


MODEL = """format = 1
name = "pendulum_extended"
system = "pendulum"
engine = "batch"
title = "t"
observe = ["q"]
[parameters.inertia]
value = 0.0033
unit = "kg*m^2"
low = 0.0032
high = 0.0034
"""


@pytest.mark.parametrize(
    ("size_options", "message"),
    [
        ({"factor": 1e3}, "are the stamps milliseconds? then divide t by 1000"),
        ({"factor": 1e6}, "are the stamps microseconds? then divide t by 1e+06"),
        ({"factor": 1e9}, "are the stamps nanoseconds?"),
        ({"factor": 1e3, "start": 1.7e12}, "are these milliseconds"),
        ({"factor": 1e9, "start": 1.7e18}, "row "),
        ({"factor": 1e-300}, "a run of"),
        ({"gap": 1e6}, "split it there into two runs"),
        ({"gap": 1e9}, "split it there into two runs"),
        ({"toml": DESCRIPTION + "noise = nan\n"}, "noise"),
        ({"toml": DESCRIPTION + "noise = inf\n"}, "noise"),
        ({"toml": DESCRIPTION + "noise = -1\n"}, "noise"),
        ({"toml": DESCRIPTION + "noise = 1e308\n"}, "noise"),
        ({"toml": DESCRIPTION + "noise = 1e-308\n"}, "noise"),
        ({"toml": DESCRIPTION + "[constants]\ngravity = 1e6\n"}, "0 to 1000 m/s"),
        ({"toml": DESCRIPTION + "[constants]\nmass = 1e308\n"}, "mass"),
        ({"toml": DESCRIPTION + "[constants]\nmass = 1e-300\n"}, "mass"),
        ({"toml": DESCRIPTION + "[runs.1]\ngravity = 1e6\n"}, "0 to 1000 m/s"),
        ({"toml": DESCRIPTION + "[runs.1.initial]\nqd = 1e200\n"}, "initial.qd"),
        ({"toml": f"title = '{LONG}'\n" + DESCRIPTION}, "at most 300 characters"),
        ({"name": "n" * 500}, "a name of at most 120 characters"),
    ],
)
@pytest.mark.parametrize("command", ["explain", "score"])
def test_recordings_beyond_all_measure(tmp_path, size_options, message, command):
    path = swing(tmp_path, **size_options)
    arguments = ["explain", path, "--out", tmp_path / "out"]
    if command == "score":
        (tmp_path / "model.toml").write_text(MODEL)
        arguments = ["score", tmp_path / "model.toml", path]
    assert message in refused(*arguments)
    assert not (tmp_path / "out").exists()


def test_other_commands_refuse_what_is_beyond_all_measure(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    training = ["train", "tunenet", "ball", "--experiment", "ball-drop"]
    for options, says in (
        (["--budget", 10**18], "lower training_budget"),
        (["--seeds", 10**9], "lower seeds"),
        (["--budget", 1], "give a larger --budget"),
    ):
        assert says in refused(*training, *options)
    path = tmp_path / "drop.csv"
    path.write_text("run,t,z\n" + "".join(f"1,{i / 30},{5 - i * i / 200}\n" for i in range(20)))
    path.with_suffix(".toml").write_text('system = "ball"\n[channels.z]\nunit = "m"\n')
    for pixels in (10**6, 10**18):
        line = refused("film", path, "--out", tmp_path / "f.mp4", "--size", pixels)
        assert "lower the size" in line
    for option, value in (("--fps", "1e308"), ("--fps", "nan"), ("--ball-diameter", "1e308")):
        line = refused("track", path, "--out", tmp_path / "t.csv", option, value)
        assert "expected more than 0" in line


@pytest.mark.parametrize(
    ("need", "message"),
    [
        (
            ResourceNeed("it", "less", memory=2e9),
            "it would need 2 GB of memory, where there are 1 GB; less",
        ),
        (ResourceNeed("it", "less", disk=3e12), "3 TB of free disk, where there are 2 TB"),
        (ResourceNeed("it", "less", steps=2e9), "2e+09 steps in one simulation"),
        (ResourceNeed("it", "less", seconds=31 * 86400), "31 days, where 30 are allowed"),
    ],
)
def test_what_is_needed_and_not_there_is_said(need, message):
    there = MachineResources(memory=1e9, disk=2e12)
    with pytest.raises(InputError, match="or insist with --force") as caught:
        check_feasible("x", need, there)
    assert message in str(caught.value)
    check_feasible("x", need, there, force=True)


def test_what_there_is_is_enough():
    there = MachineResources(memory=1e9, disk=2e12)
    check_feasible("x", ResourceNeed("it", "less", 1e9, 2e12, 1e9, 29 * 86400), there)
    check_feasible("x", ResourceNeed("it", "less", memory=1e30, disk=1e30), MachineResources())


def test_this_machine_says_what_it_has(tmp_path):
    here = get_machine_resources(tmp_path / "not" / "yet")
    assert 1e8 < here.memory < 1e14
    assert 0 < here.disk < 1e18


def test_needs_are_made_of_the_experiment(tmp_path):
    """Disk use is proportional to the number of targets and does not depend on this machine."""
    path = tmp_path / "e.toml"
    path.write_text(tomli_w.dumps({**BASE, "budget": 99, "targets": 50}))
    small = estimate_comparison_need(load_experiment(str(path)))
    large = estimate_comparison_need(load_experiment(str(path)).chosen(targets=500))
    assert small.disk == 100 * 100 * 50
    assert large.disk == 10 * small.disk
    assert small.steps == pytest.approx(29 / 20 / (1 / 400))


def test_long_work_is_not_refused():
    """A million runs of 100 simulations, as measured in docs/scale.md, do not need --force."""
    big = estimate_comparison_need(
        load_experiment("ball-drop").chosen(targets=20_000).with_seeds(5), jobs=2
    )
    assert not big.find_excess(MachineResources(memory=64e9, disk=100e9))


def test_who_insists_begins(tmp_path):
    """With force, stamps in milliseconds and an infeasible comparison are accepted."""
    path = swing(tmp_path, factor=1e3)
    recording, kind = recorded(path)
    with pytest.raises(InputError, match=r"milliseconds.*or insist with --force"):
        check_recording_plausible(recording, kind)
    said = check_recording_plausible(recording, kind, force=True)
    assert len(said) == len(recording.runs)
    endless = load_experiment("ball-drop").chosen(budget=10**18)
    with pytest.raises(InputError, match="--force"):
        check_comparison_size(endless)
    check_comparison_size(endless, force=True)


@pytest.mark.parametrize("call", ["compare", "sweep"])
def test_the_same_through_python(tmp_path, call):
    endless = load_experiment("ball-drop").chosen(budget=10**18)
    with pytest.raises(InputError, match=r"lower budget.*force=True"):
        getattr(simgap, call)(endless, jobs=0, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="force=True"):
        simgap.simulate("pendulum", runs=10**12)
    assert FORCE_HINT.endswith("(force=True in Python)")


def test_sound_recordings_are_not_odd(recordings, tmp_path):
    """No shared real recording is anomalous; motion is up to 14 times slower than free motion."""
    tables = sorted(recordings.glob("*/*.csv"))
    assert tables
    for path in tables:
        recording, kind = recorded(path)
        assert list(find_anomalies(recording, kind)) == [], path
    recording, kind = recorded(swing(tmp_path))
    assert list(find_anomalies(recording, kind)) == []


def test_motion_that_is_too_fast_is_said_and_not_refused(tmp_path):
    path = swing(tmp_path, factor=1e-3)
    recording, kind = recorded(path)
    (odd,) = {odd.certain for odd in find_anomalies(recording, kind)}
    assert not odd
    assert "are the stamps seconds?" in run_command("inspect", path, "--out", tmp_path / "out").out
