"""Tests that options of MuJoCo's solver are causes if the recorded simulator has other ones."""

from contextlib import closing
from types import SimpleNamespace

import mujoco
import pytest

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.explain import explain
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.pipeline.recording_preparation import prepare_runs
from bench.diagnosis.pipeline.simulated_runs import DiagnosisContext
from bench.diagnosis.pipeline.solver_option_choice import RatedOptions, rank_option_alternatives
from bench.diagnosis.report.cause_and_value_text import format_effect
from sims.robot.integrator_settings import OPTION_EFFECTS, IntegratorSettings
from tests.bench.diagnosis.block_recordings import BLOCK, OPTIONS, write_block_recording


def rank(path):
    """Return the ranked alternatives of a recording from its stated initial states."""
    with closing(DiagnosisContext(ExplainOptions(), ForkedWorkerPool(1))) as context:
        runs = prepare_runs([path], context)
        evaluator = runs.fitting
        return rank_option_alternatives(
            evaluator, runs.noise, evaluator.get_nominal_theta(), evaluator.initial_state_guesses
        )


@pytest.mark.parametrize(
    ("planted", "options"),
    [
        ('cone="elliptic"', {"cone": 1}),
        ('iterations="1"', {"iterations": 1}),
        ('impratio="20"', {"impratio": 20.0}),
        ('noslip_iterations="5"', {"noslip_iterations": 5}),
        ('solver="CG" iterations="3"', {"iterations": 3, "solver": 1}),
    ],
)
def test_the_planted_option_explains_the_recording_best(tmp_path, planted, options):
    best, *others = rank(write_block_recording(tmp_path, planted))
    assert dict(best.numerics.solver_options) == options
    assert best.numerics.integrator == "implicitfast"
    # Two of three runs are for fitting: 1200 readings of noise. A solver that does not converge
    # amplifies differences of its warm start.
    if planted != 'iterations="1"':
        assert best.squares == pytest.approx(1200, rel=0.15)
    assert all(other.squares > best.squares for other in others)


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_the_integrator_of_the_recording_is_the_only_alternative(tmp_path, integrator):
    change = (OPTIONS, f'integrator="{integrator}"')
    (best,) = rank(write_block_recording(tmp_path, change=change))
    assert best.numerics == (0.002, integrator, ())
    assert best.squares == pytest.approx(1200, rel=0.15)


def test_an_option_that_leaves_most_of_a_wrong_friction_is_no_alternative(tmp_path):
    assert rank(write_block_recording(tmp_path, change=('friction="0.6"', 'friction="0.7"'))) == []


def test_no_alternative_explains_a_clean_recording_better(tmp_path):
    assert rank(write_block_recording(tmp_path)) == []


def rate(changes, gain, residual):
    """Return the rating of a base model of the block with changed options of the solver."""
    settings = IntegratorSettings(0.002, "implicitfast").replace_options(changes)
    robot = SimpleNamespace(compiled=mujoco.MjModel.from_xml_string(BLOCK))
    runs = SimpleNamespace(kind=SimpleNamespace(robot=robot, numerics=settings))
    return RatedOptions(SimpleNamespace(runs=runs), gain, gain, residual, 0.0, False)


@pytest.mark.parametrize(
    ("changes", "gain", "residual", "is_better"),
    [
        ({"impratio": 20.0}, 100.0, 9.0, False),
        ({"impratio": 20.0}, 100.0, 5.9, True),
        ({"integrator": 0}, 100.0, 9.0, False),
        ({"integrator": 0}, 100.0, 5.9, True),
        ({"integrator": 0}, 10.0, 5.9, False),
    ],
)
def test_an_option_must_close_half_of_the_gap(changes, gain, residual, is_better):
    assert rate(changes, gain, residual).is_better_than(rate({}, 0.0, 11.0)) is is_better


def test_another_value_of_a_changed_option_needs_no_part_of_the_gap():
    assert rate({"impratio": 20.0}, 108.0, 4.9).is_better_than(rate({"impratio": 10.0}, 100.0, 5.0))
    assert rate({"integrator": 0}, 108.0, 4.9).is_better_than(rate({"integrator": 1}, 100.0, 5.0))


def test_settings_replace_options_by_number():
    settings = IntegratorSettings(0.002, "RK4", (("cone", 1),))
    assert settings.replace_options({"impratio": 10.0, "integrator": 0}) == (
        0.002,
        "Euler",
        (("cone", 1), ("impratio", 10.0)),
    )
    assert settings.to_document() == {"timestep": 0.002, "integrator": "RK4", "cone": "elliptic"}


def test_every_option_has_a_name_in_texts():
    assert all(format_effect(effect) != effect for effect in OPTION_EFFECTS)


@pytest.mark.slow
def test_a_planted_cone_is_the_only_cause_and_is_written_into_the_model_file(tmp_path):
    explanation = explain(write_block_recording(tmp_path, 'cone="elliptic"', samples=100))
    (cause,) = explanation.answer.causes
    assert explanation.answer.verdict == "named"
    assert cause.effect == "numerics.cone"
    number = cause.coefficients["coefficient"]
    assert (number.stated, number.value) == (0.0, 1.0)
    explanation.write(tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "extended.xml"))
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert 'cone = "elliptic"' in (tmp_path / "out" / "extended.toml").read_text()


@pytest.mark.long
def test_wrong_friction_is_not_explained_by_an_option(tmp_path):
    changed = ('friction="0.6"', 'friction="0.7"')
    answer = explain(write_block_recording(tmp_path, change=changed, samples=100)).answer
    assert [cause.effect for cause in answer.causes] == ["contact.friction@ground/foot"]
    assert answer.causes[0].coefficients["coefficient"].value == pytest.approx(0.1, rel=0.05)


@pytest.mark.long
def test_an_integrator_that_hardly_shows_is_the_only_cause(tmp_path):
    """The residual is 1.2 times the noise, and the coarser integrator made the recording."""
    changed = (OPTIONS, 'integrator="Euler"')
    answer = explain(write_block_recording(tmp_path, change=changed)).answer
    assert answer.verdict == "named"
    assert [cause.effect for cause in answer.causes] == ["numerics.integrator"]
    assert answer.causes[0].coefficients["coefficient"].value == 0


@pytest.mark.long
def test_a_solver_that_does_not_converge_is_named_with_its_iterations(tmp_path):
    path = write_block_recording(tmp_path, 'solver="PGS" iterations="3"', samples=100)
    answer = explain(path).answer
    # Rounding errors grow in such a solver, so that the recording cannot be reproduced exactly.
    assert answer.verdict in ("named", "partial")
    numbers = {cause.effect: cause.coefficients["coefficient"].value for cause in answer.causes}
    assert numbers == {"numerics.solver": 0, "numerics.iterations": 3}
