"""Tests of recordings with two or three unmarked runs: all are fitted and cross-validated."""

from dataclasses import replace

import numpy as np
import pytest

import simgap
from bench.benchmark.problem.experiment_recording import load_recorded_runs
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.report.summary_text import format_summary
from bench.diagnosis.validation.cross_validation import CrossValidation
from bench.diagnosis.validation.held_out_runs import HeldOutRuns
from bench.logs.recording_joining import load_joined
from sims.core.simulator import Scenario
from sims.recording.recording import split_held_out
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.explained_samples import evaluator, recorded, white, with_runs
from tests.bench.diagnosis.report_tables import table

TIMES = np.arange(150) / 50
SIGMA = 0.002


def released(inertia, friction=0.0, seed=0, times=TIMES):
    """Return free swings of a pendulum, one per inertia, as columns."""
    rng, runs = np.random.default_rng(seed), []
    for number, value in enumerate(inertia):
        effects = {"friction.coulomb": friction} if friction else None
        scenario = Scenario(times, {"q": 0.5 + 0.3 * number})
        q = Pendulum(fixed=effects, observe=["q"]).simulate(np.array([[value]]), scenario)[0, :, 0]
        runs.append((times, q + SIGMA * rng.standard_normal(q.size)))
    return runs


def swung(folder, *args, marks=(), **options):
    more = "\n".join(f"[runs.{name}]\nheld_out = true" for name in marks)
    path = table(folder, released(*args, **options), ("q",), noise={"q": SIGMA})
    description = path.with_suffix(".toml")
    description.write_text(description.read_text() + more)
    return path


def test_two_runs_are_both_fitted_and_each_is_predicted_by_the_other(tmp_path):
    found = explain(swung(tmp_path, [3.3e-3, 3.3e-3], friction=2e-3))
    (cause,) = found.answer.causes
    assert (found.verdict, cause.effect) == ("named", "friction.coulomb")
    assert cause.coefficients["coefficient"].value == pytest.approx(2e-3, rel=0.1)
    assert found.story.fitting.names == found.story.held_out.names == ("1", "2")
    heldout = found.answer.heldout
    assert heldout.gap_closed > 0.95
    assert heldout.low < heldout.gap_closed <= heldout.high
    text = " ".join(format_summary(found.story))
    assert "the error on runs left out in turn" in text
    assert "held-out" not in text


def test_the_simulators_of_all_folds_are_closed(tmp_path, monkeypatch):
    made, closed = [], []
    make, close = CrossValidation._make_evaluator, RunEvaluator.close

    def make_fold(validation, rows):
        made.append(make(validation, rows))
        return made[-1]

    def close_evaluator(fold):
        closed.append(fold)
        close(fold)

    monkeypatch.setattr(CrossValidation, "_make_evaluator", make_fold)
    monkeypatch.setattr(RunEvaluator, "close", close_evaluator)
    explain(swung(tmp_path, [3.3e-3, 3.3e-3], friction=2e-3))
    assert len(made) == 4
    assert all(any(fold is one for one in closed) for fold in made)


def test_each_run_is_predicted_by_a_fit_to_the_other_alone():
    """A fit to both runs lies between their inertias, so it must not make the predictions."""
    parts = [
        recorded(Pendulum(observe=["q"]), [value], [{"q": 0.6}], TIMES, SIGMA)
        for value in (3.3e-3, 3.5e-3)
    ]
    made = with_runs(parts[0], [part.runs[0] for part in parts])
    there = evaluator(split_held_out(made, folds=True))
    noise = white(there, SIGMA)
    fit = fit_base_model(there, noise).fit
    validation = CrossValidation(there, noise)
    assert validation.simulations == 0
    (predicted,) = validation.validate([fit])
    assert validation.simulations > 2 * len(made.runs), "the folds are fitted and predicted"
    for run in (0, 1):
        other = evaluator(replace(made, runs=made.runs[1 - run : 2 - run]))
        alone = evaluator(replace(made, runs=made.runs[run : run + 1]))
        theta = fit_base_model(other, noise).fit.theta
        (expected,) = HeldOutRuns(alone, noise).fit_initial_states([theta])
        np.testing.assert_allclose(predicted.simulated[run], expected.simulated[0], atol=SIGMA / 4)
        assert np.abs(predicted.simulated[run] - fit.simulated[run]).max() > 20 * SIGMA


@pytest.mark.slow
def test_a_cause_on_which_runs_disagree_is_not_named(tmp_path):
    """One run has strong dry friction and the other none, so neither predicts the other."""
    times = TIMES[:75]
    parts = released([3.3e-3] * 2, 6e-3, times=times), released([3.3e-3] * 2, seed=1, times=times)
    path = table(tmp_path, [parts[0][0], parts[1][1]], ("q",), noise={"q": SIGMA})
    found = explain(path)
    assert found.verdict in ("unknown", "partial")
    assert found.answer.heldout.rmse_extended > 3 * SIGMA


def test_an_effect_that_the_other_runs_do_not_show_predicts_nothing():
    """Only run 2 has an input, so a fold without it cannot determine the input gain."""
    torque = {"u": 0.02 * np.sin(3 * TIMES)}
    still = {"u": np.zeros(TIMES.size)}
    made = recorded(
        Pendulum(fixed={"input.gain": 0.5}, observe=["q"]),
        [3.3e-3],
        [({"q": 0.6}, still), ({"q": 0.6}, torque)],
        TIMES,
        SIGMA,
    )
    there = evaluator(split_held_out(made, folds=True))
    noise = white(there, SIGMA)
    fits = TrajectoryFitter(there, noise).fit_models(
        [
            FitStart(names, there.get_nominal_theta(), there.initial_state_guesses)
            for names in ((), ("input.gain",))
        ],
        20,
    )
    assert fits[1].theta[there.coefficient_slices["input.gain"]] == pytest.approx([0.5], abs=0.1)
    base, gain = CrossValidation(there, noise).validate(fits)
    np.testing.assert_allclose(gain.simulated[1], base.simulated[1], atol=0.2 * SIGMA)
    assert np.abs(gain.simulated[1] - there.observed[1]).max() > 20 * SIGMA
    there.close()


def test_runs_of_other_lengths_are_padded(tmp_path):
    lengths = released([3.3e-3]), released([3.3e-3, 3.3e-3], times=TIMES[:90])
    path = table(tmp_path, [lengths[0][0], lengths[1][1]], ("q",), noise={"q": SIGMA})
    found = explain(path)
    assert found.verdict == "adequate"
    assert found.answer.heldout.rmse_base == pytest.approx(SIGMA, rel=0.3)
    assert np.isnan(found.story.held_out.before[1, 90:]).all()


@pytest.mark.parametrize(("count", "folds", "held_out"), [(2, 2, 0), (3, 3, 0), (4, 0, 1)])
def test_more_than_three_runs_are_held_out_as_before(tmp_path, count, folds, held_out):
    path = swung(tmp_path, [3.3e-3] * count)
    made = simgap.read_recording(path)
    assert (len(made.folds()), len(made.held_out())) == (folds, held_out)


def test_marks_stay_binding(tmp_path):
    path = swung(tmp_path, [3.3e-3, 3.3e-3], marks=["1"])
    made = simgap.read_recording(path)
    assert made.folds() == ()
    assert [run.name for run in made.held_out()] == ["1"]
    assert explain(path).story.fitting.names == ("2",)


def test_single_runs_of_two_logs_are_folds_and_more_runs_are_not(tmp_path):
    paths = []
    for name, count in (("a", 1), ("b", 1), ("c", 2)):
        (tmp_path / name).mkdir()
        swung(tmp_path / name, [3.3e-3] * count)
        paths.append(tmp_path / name / "odd.csv")
    joined, _ = load_joined(paths[:2])
    assert (joined.folds(), len(joined.training())) == ((0, 1), 2)
    joined, _ = load_joined(paths)
    assert joined.folds() == ()
    assert [run.log.split("/")[0] for run in joined.held_out()] == ["a", "b", "c"]


def test_a_tuner_still_has_a_run_held_out(tmp_path):
    path = swung(tmp_path, [3.3e-3, 3.3e-3])
    data = load_recorded_runs(str(path), Pendulum(observe=["q"]))
    assert (len(data.fitting.scenarios), len(data.held_out.scenarios)) == (1, 1)
