import numpy as np
import pytest

from bench.benchmark.problem.experiment_recording import ObservedRuns
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.problem.tuning_problem import ProposalEvaluator, TuningProblem
from tests.sample_experiments import spring_experiment

pytestmark = pytest.mark.usefixtures("spring")


def evaluator(**changes):
    problem = TuningProblem(spring_experiment(**changes))
    side = draw_targets(problem)[0].blinded.fitting
    return problem, side, ProposalEvaluator(problem, side)


def test_loss_of_one_proposal_is_that_in_a_batch():
    problem, side, one = evaluator(noise={"x": 0.1})
    points = np.random.default_rng(0).uniform(size=(5, 2))
    _, together = ProposalEvaluator(problem, side)(points)
    alone = np.concatenate([one(point[None])[1] for point in points])
    np.testing.assert_allclose(alone, together, rtol=1e-13)
    simulated = problem.simulate(points, side.scenarios)
    expected = np.sqrt(((simulated - side.observed) ** 2).mean(axis=(1, 2))) / 0.1
    np.testing.assert_allclose(alone, expected, rtol=1e-12)
    np.testing.assert_allclose(
        one.compute_rmse(points, points[::-1])[:, 0], expected[::-1] * 0.1, rtol=1e-12
    )


def test_two_channels_weigh_by_their_scale_and_missing_samples_do_not_count():
    problem, side, _ = evaluator(observe=["x", "v"], noise={"x": 0.1, "v": 0.5})
    observed = side.observed.copy()
    observed[3:9, 0] = np.nan
    points = np.array([[0.3, 0.4]])
    _, loss = ProposalEvaluator(problem, ObservedRuns(side.scenarios, observed))(points)
    difference = problem.simulate(points, side.scenarios)[0] - observed
    expected = np.sqrt(
        (np.nanmean(difference[:, 0] ** 2) / 0.01 + np.nanmean(difference[:, 1] ** 2) / 0.25) / 2
    )
    assert loss[0] == pytest.approx(expected, rel=1e-12)


def test_failed_simulation_has_an_infinite_loss(monkeypatch):
    problem, _, one = evaluator()
    monkeypatch.setattr(
        problem, "simulate", lambda points, scenarios: np.full((len(points), 60, 1), np.nan)
    )
    assert one(np.full((1, 2), 0.5))[1][0] == np.inf
    assert (one(np.full((3, 2), 0.5))[1] == np.inf).all()
