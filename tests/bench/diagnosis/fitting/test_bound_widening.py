"""Tests that a base parameter beyond its declared range is fitted and not replaced by a cause."""

import pytest

from bench.diagnosis.evaluation.parameter_bounds import widen_range
from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.base_fit import fit_base_model, fit_wider
from bench.diagnosis.report.summary_text import format_headline
from bench.diagnosis.search.verdict_rules import BORDERING
from sims.core.simulator import Parameter
from tests.bench.diagnosis.explained_samples import evaluator, recording, white
from tests.bench.diagnosis.sample_report_data import summary_text
from tests.command_output import run_command

HEAVIER = 1.025


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    """Write a free swing whose inertia fits 2.5 % above the declared bound; return its path.

    The motion depends on mass / inertia only, and the description states a larger mass than the
    simulation had.
    """
    path = tmp_path_factory.mktemp("heavy") / "swing.csv"
    words = ["--theta", "inertia=0.01", "--constant", f"mass={0.15 / HEAVIER}"]
    words += ["--noise", "q=0.002", "--observe", "q", "--seconds", "2"]
    run_command("simulate", "pendulum", "--out", path, *words)
    about = path.with_suffix(".toml")
    lines = ["mass = 0.15" if li.startswith("mass") else li for li in about.read_text().split("\n")]
    about.write_text("\n".join(lines))
    return path


def test_an_inertia_beyond_its_range_is_fitted_and_no_cause_is_named(heavy):
    found = explain(heavy)
    answer = found.answer
    inertia = answer.parameters["inertia"]
    assert (answer.verdict, answer.causes) == ("adequate", ())
    assert inertia.value == pytest.approx(0.01 * HEAVIER, rel=2e-3)
    assert inertia.low < inertia.value < inertia.high
    said = summary_text(found.story)
    assert "lies outside its usual range, 0.001 to 0.01 kg*m^2" in said


def test_a_parameter_at_a_bound_that_physics_sets_keeps_a_cause_from_being_named(tmp_path):
    # Without losses the restitution is 1, and the drag is found in addition.
    path = tmp_path / "ball.csv"
    words = ["--theta", "restitution=1.0", "--noise", "0.002", "--effect", "drag.linear=0.1"]
    run_command("simulate", "ball", "--out", path, "--seconds", "1", *words)
    found = explain(path)
    answer = found.answer
    assert answer.verdict == "partial"
    assert [cause.effect for cause in answer.causes] == ["drag.linear"]
    assert answer.parameters["restitution"].at_bound == "high"
    assert answer.meaning == BORDERING
    assert "parameter restitution ends at the upper bound of its range, 1:" in format_headline(
        found.story
    )


def test_within_its_range_nothing_is_widened():
    there = evaluator(recording(runs=2, seconds=1, rate=50), candidates=[])
    noise = white(there, 0.002)
    base = fit_base_model(there, noise)
    declared = [parameter.bounds for parameter in there.parameters]
    assert fit_wider(there, noise, base) is base
    assert [parameter.bounds for parameter in there.parameters] == declared


@pytest.mark.parametrize(
    ("unit", "bounds", "limits", "expected"),
    [
        ("kg*m^2", (1e-3, 1e-2), (0.0, float("inf")), (2.5e-4, 4e-2)),
        ("1", (0.0, 1.0), (0.0, 1.0), (0.0, 1.0)),
        # Damping that the file states as 0.3 can be reduced by 0.3 at most.
        ("N*m*s/rad", (-0.3, 2.4), (-0.3, 600.0), (-0.3, 10.5)),
        ("N*m", (-1.0, 1.0), (float("-inf"), float("inf")), (-7.0, 7.0)),
    ],
)
def test_a_range_is_widened_as_far_as_physics_allows(unit, bounds, limits, expected):
    nominal = max(bounds[0], 0.0)
    made = widen_range(Parameter("p", unit, nominal, bounds), limits)
    assert made == pytest.approx(expected)
