"""Tests of the check before a fit: identifiable and confounded parameters."""

import re

import numpy as np
import pytest

from bench.diagnosis import identifiability
from bench.diagnosis.explain import explain
from bench.diagnosis.identifiability import _IdentifiabilityAssessment, check_identifiability
from bench.diagnosis.report import identifiability_section
from bench.diagnosis.report.identifiability_section import format_identifiability
from sims.core.simulator import InputError
from tests.bench.diagnosis.explained_samples import write_slider_log
from tests.command_output import run_command


def recorded(folder, moved=True, mass=2.0, seed=0, damping=0.0):
    """Write runs of a slider, driven or at rest, with encoder noise; return the path."""
    times = np.arange(150) / 50.0
    forces = [2 * np.sin(3 * times + k) if moved else np.zeros(150) for k in range(3)]
    return write_slider_log(folder / "log.csv", "drag.linear", [mass, damping], forces, seed)


def test_the_width_is_that_of_the_fit(tmp_path):
    path = recorded(tmp_path, damping=0.5)
    by_name = {number.name: number for number in check_identifiability(path)}
    explained = explain(path)
    (cause,) = explained.causes
    (number,) = cause.coefficients.values()
    assert cause.effect == "drag.linear"
    half = 0.5 * (number.high - number.low)
    assert by_name["drag.linear"].half == pytest.approx(half, rel=0.3)
    assert by_name["drag.linear"].word == "identifiable"


@pytest.mark.long
def test_what_is_called_identifiable_has_intervals_that_hold(tmp_path):
    held = []
    for seed in range(18):
        folder = tmp_path / str(seed)
        folder.mkdir()
        mass = 1.0 + 0.1 * seed
        path = recorded(folder, mass=mass, seed=seed)
        (number,) = [n for n in check_identifiability(path) if n.free]
        assert number.name == "mass"
        assert number.word == "identifiable"
        estimate = explain(path).answer.parameters["mass"].value
        held.append(abs(estimate - mass) < number.half)
    assert 0.88 <= np.mean(held) <= 1.0  # 16 of 18


def test_a_motion_that_does_not_happen_fixes_nothing(tmp_path):
    path = recorded(tmp_path, moved=False)
    (mass,) = [n for n in check_identifiability(path) if n.free]
    assert mass.word == "not identifiable"
    out = tmp_path / "out"
    said = run_command("inspect", path, "--check", "--out", out, code=1).out
    assert "  not identifiable mass: " in said


def test_confounded_numbers_are_named(tmp_path):
    path = recorded(tmp_path)
    by_name = {number.name: dict(number.mixed) for number in check_identifiability(path)}
    assert by_name["input.delay"]["input.hold"] > 0.99
    assert by_name["force.bias"]["input.bias"] > 0.999
    # The gain of the input is confounded with the free mass, so it is not identifiable.
    (gain,) = [n for n in check_identifiability(path) if n.name == "input.gain"]
    assert gain.word == "not identifiable"
    said = run_command("inspect", path, "--check", "--out", tmp_path / "out").out
    assert "confounded with" in said
    assert re.search(r"\n  not identifiable: .*input\.gain", said)


def test_free_numbers_are_asked_about_with_the_check_alone(tmp_path):
    path = recorded(tmp_path)
    assert (
        "add --check, or leave out --free"
        in run_command("inspect", path, "--free", "mass", "--out", tmp_path / "out", code=2).err
    )
    with pytest.raises(InputError, match="no such file"):
        check_identifiability(tmp_path / "none.csv")


def test_of_many_causes_the_surest_are_listed_and_the_others_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(identifiability_section, "MAX_LISTED_CAUSES", 3)
    numbers = check_identifiability(recorded(tmp_path))
    causes = [n for n in numbers if not n.free]
    lines = format_identifiability(numbers)
    sure = [n.name for n in causes if n.word == "identifiable"]
    assert len(sure) > 6
    assert f"{len(sure)} identifiable" in lines[2]
    # Each line has an interval, and they are sorted by width.
    assert all("identifiable     " in line and "±" in line for line in lines[3:6])
    assert lines[6].startswith("  also identifiable: ")
    assert lines[6].endswith(" more")
    assert lines[-1].endswith("the same command with --json")
    assert len("\n".join(lines)) < 1500


def test_parallel_derivatives_of_an_unstable_motion_are_projected_out(monkeypatch):
    """Each unstable motion of a run is nearly the same, whatever state was changed."""
    rng = np.random.default_rng(5)
    growth = np.exp(np.linspace(0.0, 40.0, 60))[:, None]
    states = np.repeat(growth, 2, axis=1)[None] * np.array([1.0, 1.0 + 1e-15])
    assessment = object.__new__(_IdentifiabilityAssessment)
    assessment.states, assessment.evaluator = states, None
    monkeypatch.setattr(identifiability, "compute_state_prior", lambda _: np.ones(2))
    columns = rng.normal(size=(1, 60, 3))
    projected = assessment._project_out_states(columns)
    unit = growth[:, 0] / np.linalg.norm(growth)
    expected = columns[0] - np.outer(unit, unit @ columns[0])
    np.testing.assert_allclose(projected, expected, atol=1e-3)
