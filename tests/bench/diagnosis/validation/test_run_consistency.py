"""Tests of parameters that change between logs, on sliders simulated with SciPy."""

import csv

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.diagnosis.explain import explain
from bench.diagnosis.report.consistency_section import (
    MISSING_PHYSICS_NAMES,
    format_consistency,
    name_missing_physics,
)
from bench.logs.recording_joining import load_joined
from sims import effects
from sims.core.simulator import InputError
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.simulated_logs import write_log
from tests.command_output import run_command

NOISE = 1e-3
TIMES = np.arange(0.0, 3.0, 0.02)
SLIDER = f'system = "slider"\n[channels.x]\nunit = "m"\nnoise = {NOISE}\n[inputs.u]\nunit = "N"\n'


def slide(state, force, mass, coulomb):
    """Return position and speed 0.02 s later, with dry friction."""

    def rate(_, x):
        return [x[1], (force - coulomb * np.tanh(x[1] / 1e-3)) / mass]

    return solve_ivp(rate, (0.0, 0.02), state, rtol=1e-8, atol=1e-10, max_step=0.01).y[:, -1]


def write(folder, name, mass=2.0, coulomb=0.0, seed=0, runs=3, sizes=(2.0,)):
    """Write runs of a moving slider with held forces and dry friction; return the path.

    Without friction the motion has a closed form; with it, SciPy integrates.
    """
    rng, columns = np.random.default_rng(seed), []
    for run in range(runs):
        size = sizes[run % len(sizes)]
        u = size * np.sin(3 * TIMES + run + 0.3)
        x, state = np.empty(TIMES.size), np.array([0.0, 0.5])
        for i, force in enumerate(u):
            x[i] = state[0]
            if coulomb:
                state = slide(state, force, mass, coulomb)
            else:
                gain = 0.02 * force / mass
                state = np.add(state, [0.02 * (state[1] + gain / 2), gain])
        columns.append((TIMES, u, x + NOISE * rng.standard_normal(x.size)))
    return write_log(folder, SLIDER, "u,x", columns, name)


def by(spreads, number, group):
    (one,) = [s for s in spreads if (s.number, s.by) == (number, group)]
    return one


def test_logs_of_one_world_agree(tmp_path):
    paths = [write(tmp_path, f"log{i}", seed=i) for i in range(3)]
    found = explain(paths)
    assert found.verdict == "adequate"
    mass = by(found.story.consistency.after, "mass", "log")
    assert mass.is_consistent
    assert [part.group for part in mass.group_estimates] == ["log0", "log1", "log2"]
    assert all(abs(part.value - 2.0) < 4 * part.error for part in mass.group_estimates)
    assert mass.value == pytest.approx(2.0, abs=3 * mass.error)
    # Each of three equal logs has sqrt(3) times the standard error of all logs together.
    assert np.mean([part.error for part in mass.group_estimates]) == pytest.approx(
        mass.error * 3**0.5, rel=0.1
    )


def test_what_each_log_says_is_what_it_says_alone(tmp_path):
    paths = [write(tmp_path, f"log{i}", mass=m, seed=i) for i, m in enumerate((2.0, 2.05))]
    found = explain(paths)
    parts = by(found.story.consistency.before, "mass", "log").group_estimates
    for path, part in zip(paths, parts, strict=True):
        alone = explain(path).answer.parameters["mass"]
        assert part.value == pytest.approx(alone.value, abs=0.5 * part.error + 0.002)


def test_a_mass_that_grows_from_day_to_day(tmp_path):
    masses = [2.0, 2.01, 2.02, 2.03]
    paths = [write(tmp_path, f"day{i}", mass=m, seed=i) for i, m in enumerate(masses)]
    found = explain(paths)
    mass = by(found.story.consistency.before, "mass", "log")
    assert not mass.is_consistent
    assert mass.trend.slope == pytest.approx(0.01, abs=3 * mass.trend.error)
    assert mass.trend.p_value < 1e-3
    assert mass.trend_covariate.kind == "time"
    assert (
        name_missing_physics("mass", "time", mass.trend_covariate.name, True, ())
        == "a load that changes with time"
    )
    assert mass.scatter == pytest.approx(np.std(masses, ddof=1), rel=0.3)
    # The prediction error for a new day covers 2.03 kg; the standard error does not.
    assert abs(mass.value - 2.03) < 2.5 * mass.prediction_sigma
    assert abs(mass.value - 2.03) > 3 * mass.error


@pytest.mark.slow
def test_the_p_value_of_disagreeing_groups_is_calibrated(tmp_path):
    chances = []
    for seed in range(12):
        found = explain(write(tmp_path, "log", seed=100 + seed, runs=4))
        if found.verdict == "adequate":
            chances.append(by(found.story.consistency.after, "mass", "run").p_value)
    assert len(chances) >= 11
    assert np.mean(np.array(chances) < 0.05) <= 0.25
    assert 0.2 < np.median(chances) < 0.85


def test_what_is_missing_makes_a_number_move(tmp_path):
    """Dry friction fitted as drag looks larger in small motions than in large ones."""
    sizes = {"small": 1.5, "middle": 4.0, "large": 10.0}
    paths = [
        write(tmp_path, name, coulomb=0.3, seed=i, sizes=(size,))
        for i, (name, size) in enumerate(sizes.items())
    ]
    out = tmp_path / "out"
    said = " ".join(run_command("explain", *paths, "--out", out).out.split())
    assert "lacks Coulomb friction" in said
    assert "instead of friction.coulomb, its value would differ between logs" in said
    assert "no number changes steadily over the 3 logs, in the order given" in said.lower()
    with (out / "apart.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    friction = [r for r in rows if r["number"] == "friction.coulomb" and r["by"] == "log"]
    assert [r["group"] for r in friction] == ["all", "small", "middle", "large", "another"]
    assert {r["model"] for r in friction} == {"extended"}
    for row in friction[1:-1]:
        assert float(row["low"]) - 0.01 < 0.3 < float(row["high"]) + 0.01
    page = (out / "report.html").read_text()
    assert "Agreement between runs" in page
    assert 'class="intervals"' in page


def test_logs_that_are_not_of_one_system_are_refused(tmp_path):
    one, other = write(tmp_path, "one"), write(tmp_path, "other", seed=1)
    other.with_suffix(".toml").write_text(
        'system = "pendulum"\n[channels.q]\nunit = "rad"\n[inputs.u]\nunit = "N*m"\n'
    )
    other.write_text(other.read_text().replace("run,t,u,x", "run,t,u,q"))
    said = (
        run_command("explain", one, other, "--out", tmp_path / "out", code=2)
        .err.strip()
        .splitlines()[-1]
    )
    assert said.endswith(
        f"{other}: expected a log of slider as {one}, found one of pendulum; explain it by itself"
    )
    assert not (tmp_path / "out").exists()


def test_logs_of_other_channels_are_refused(tmp_path):
    one, other = write(tmp_path, "one"), write(tmp_path, "other", seed=1)
    text = other.with_suffix(".toml").read_text()
    other.with_suffix(".toml").write_text(
        text.replace("channels.x", "channels.v").replace('"m"', '"m/s"')
    )
    other.write_text(other.read_text().replace("run,t,u,x", "run,t,u,v"))
    with pytest.raises(InputError, match=r"expected the channels of .*one.csv, x, found v"):
        explain([one, other])


def test_a_constant_that_logs_state_differently_is_one_of_their_runs(tmp_path):
    def log(name, mass):
        description = f'[channels.q]\nunit = "rad"\n[constants]\nmass = {mass}\ngravity = 9.8\n'
        run = (0.1 * np.arange(9), 0.1 * np.cos(np.arange(9)))
        return write_log(tmp_path, f'system = "pendulum"\n{description}', "q", [run, run], name)

    joined, _ = load_joined([log("one", 0.2), log("other", 0.3)])
    assert joined.constants == {"gravity": 9.8}
    assert [run.constants["mass"] for run in joined.runs] == [0.2, 0.2, 0.3, 0.3]
    assert [run.name for run in joined.runs] == ["one: 1", "one: 2", "other: 1", "other: 2"]
    assert [run.held_out for run in joined.runs] == [False, True, False, True]


def warm(folder, drags, temperatures):
    """Write runs of a slider with another viscous friction in each; return the path.

    It uses the closed form for a held force: the speed goes to u / drag as exp(-drag t / mass).
    """
    rng, runs, mass = np.random.default_rng(0), [], 2.0
    for run, (drag, heat) in enumerate(zip(drags, temperatures, strict=True)):
        x, v, fading = 0.0, 0.5, np.exp(-drag * 0.02 / mass)
        rows = []
        for t, u in zip(TIMES, 4.0 * np.sin(3 * TIMES + run + 0.3), strict=True):
            seen = x + NOISE * rng.standard_normal()
            rows.append((t, u, seen, heat + rng.standard_normal()))
            last = u / drag
            x += last * 0.02 + (v - last) * (1 - fading) * mass / drag
            v = last + (v - last) * fading
        runs.append([np.array(rows)])
    extra = '[extra.temperature]\nunit = "degC"\n'
    columns, name = "u,x,temperature", f"warm{temperatures[1]:g}"
    return write_log(folder, SLIDER + extra, columns, runs, name)


@pytest.mark.slow
def test_what_a_number_moves_with_says_what_is_missing(tmp_path):
    """Friction decreases with temperature, and the runs are in no order of temperature."""
    heat = np.array([3, 0, 7, 5, 1, 8, 2, 6, 4])
    found = explain(warm(tmp_path, 2.0 - 0.08 * heat, 20.0 + 5.0 * heat))
    drag = by(found.story.consistency.after, "drag.linear", "run")
    assert (drag.trend_covariate.kind, drag.trend_covariate.name) == ("other", "temperature")
    assert drag.trend_covariate.trend.slope == pytest.approx(-0.08 / 5.0, rel=0.1)
    said = " ".join(format_consistency(found.story))
    assert "it decreases with temperature: friction that depends on temp" in said


def test_the_missing_effect_by_what_a_number_moves_with():
    def name(number, kind, grows=True, known=()):
        return name_missing_physics(number, kind, "x", grows, known)

    assert name("drag.linear@elbow", "load") == "friction that depends on the load (friction.load)"
    assert name("friction.coulomb", "direction").endswith("(friction.direction)")
    assert name("friction.coulomb", "speed").endswith("(drag.linear)")
    assert name("friction.coulomb", "speed", grows=False).endswith("(friction.stribeck)")
    assert name("spring.linear", "amplitude").endswith("(spring.cubic)")
    # An effect of the model is not proposed again; for other parameters no effect is known.
    known = ("friction.load@elbow",)
    assert name("drag.linear@elbow", "load", known=known) == "friction that depends on x"
    assert name("lift.magnus", "speed") == "something that depends on x"


def test_effects_that_may_be_missing_are_in_the_library():
    texts = [text for found in MISSING_PHYSICS_NAMES.values() for text in np.atleast_1d(found)]
    named = {text.partition("(")[2].rstrip(")") for text in texts if "(" in text}
    there = {*effects.list_effects_for(Pendulum.system), *effects.list_effects_for(Ball.system)}
    assert named <= there
    assert len(named) >= 9
