import numpy as np
import pytest

from bench.benchmark.runner.tuner_loop import drive_tuner
from methods.tuner import Proposal, Task, Tuner

TRUE_PARAMETERS = np.array([0.3, 0.6])


def task(budget, dim=2):
    observed = np.zeros((5, 1))
    return Task(
        dim,
        np.full(dim, 0.5),
        observed,
        np.ones(1),
        np.array([[0.0] * dim, [1.0] * dim]),
        budget,
        (5,),
    )


class Counted:
    """Objective with the distance to the true parameters as loss, which counts simulations."""

    def __init__(self):
        self.simulated = 0

    def __call__(self, points):
        self.simulated += len(points)
        losses = np.linalg.norm(points - TRUE_PARAMETERS[: points.shape[1]], axis=1)
        return np.repeat(losses, 5).reshape(-1, 5, 1), losses


def run(tune, budget=10, **options):
    evaluate = Counted()
    tuner = type("Probe", (Tuner,), {"tune": tune})()
    return drive_tuner(tuner, task(budget), evaluate, np.random.default_rng(0), **options), evaluate


@pytest.mark.parametrize("budget", range(1, 8))
@pytest.mark.parametrize("batch", [1, 2, 3, 5, 100])
def test_budget_is_exact_for_populations(budget, batch):
    def tune(self, task, rng):
        while True:
            seen = yield rng.uniform(size=(batch, task.dim))
            assert len(seen.losses) == batch, "a cut batch must not be handed back"

    trace, evaluate = run(tune, budget)
    assert evaluate.simulated == budget == len(trace.losses) == len(trace.proposals)
    assert len(trace.recommendations) == budget + 1
    assert trace.status == "done"


def test_recommends_the_lowest_loss_by_default_even_inside_a_batch():
    points = np.array([[0.9, 0.9], [0.3, 0.5], [0.0, 0.0], [0.3, 0.6]])

    def tune(self, task, rng):
        yield points

    trace, _ = run(tune)
    np.testing.assert_array_equal(
        trace.recommendations, [[0.5, 0.5], points[0], points[1], points[1], points[3]]
    )
    assert trace.status == "converged"


def test_of_equal_losses_the_first_is_recommended():
    def tune(self, task, rng):
        yield np.array([[0.3, 0.35], [0.3, 0.85]])
        yield np.array([0.3, 0.35])

    trace, _ = run(tune)
    assert trace.losses.tolist() == [0.25, 0.25, 0.25]
    assert trace.recommendations[1:, 1].tolist() == [0.35, 0.35, 0.35]


def test_recommendation_of_an_ask_is_what_the_tuner_would_deliver_after_what_it_has_seen():
    def tune(self, task, rng):
        for guess in (0.1, 0.2, 0.3, 0.4):
            yield Proposal(np.full(2, guess), recommend=np.full(2, guess))

    trace, _ = run(tune, budget=3)
    np.testing.assert_allclose(trace.proposals[:, 0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        trace.recommendations[:, 0], [0.1, 0.2, 0.3, 0.4]
    )  # the newest recommendation, which was not simulated
    assert trace.status == "done"


def test_recommendation_of_a_batch_changes_only_when_the_tuner_has_seen_it():
    def tune(self, task, rng):
        yield Proposal(rng.uniform(size=(3, 2)), recommend=np.full(2, 0.1))
        yield Proposal(rng.uniform(size=(3, 2)), recommend=np.full(2, 0.2))

    trace, _ = run(tune, budget=5)
    np.testing.assert_allclose(trace.recommendations[:, 0], [0.1, 0.1, 0.1, 0.2, 0.2, 0.2])


def test_what_lies_outside_the_cube_is_moved_to_its_border():
    def tune(self, task, rng):
        seen = yield np.array([[-3.0, 7.0]])
        np.testing.assert_array_equal(seen.proposals, [[0.0, 1.0]])
        yield Proposal(np.array([0.5, 0.5]), recommend=np.array([2.0, 0.5]))

    trace, _ = run(tune, budget=2)
    assert trace.status == "converged"
    np.testing.assert_array_equal(trace.recommendations[1], [1.0, 0.5])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_proposal_that_is_not_finite_ends_as_diverged_and_keeps_its_rows(bad):
    def tune(self, task, rng):
        yield task.start
        yield np.array([0.5, bad])

    trace, _ = run(tune)
    assert trace.status == "diverged"
    assert str(bad) in trace.reason
    assert len(trace.losses) == 1


def test_crash_keeps_its_rows_and_its_traceback():
    def tune(self, task, rng):
        yield task.start
        raise KeyError("lost")

    trace, _ = run(tune)
    assert trace.status == "crashed"
    assert "KeyError: 'lost'" in trace.reason
    assert "test_tuner_loop.py" in trace.reason
    assert len(trace.losses) == 1


@pytest.mark.parametrize("shape", [(3,), (2, 3), (0, 2), (1, 1, 2)])
def test_proposals_of_another_shape_are_refused(shape):
    def tune(self, task, rng):
        yield np.full(shape, 0.5)

    trace, evaluate = run(tune)
    assert trace.status == "crashed"
    assert "expected (n, 2)" in trace.reason or "shape" in trace.reason
    assert evaluate.simulated == 0


def test_reason_of_a_tuner_that_stops():
    def tune(self, task, rng):
        yield task.start
        return "nothing moves any more"

    trace, _ = run(tune)
    assert (trace.status, trace.reason) == ("converged", "nothing moves any more")


def test_a_tune_that_is_no_generator_is_a_crash_and_a_missing_one_says_so():
    trace, _ = run(lambda self, task, rng: None)
    assert trace.status == "crashed"
    trace = drive_tuner(Tuner(), task(3), Counted(), np.random.default_rng(0))
    assert trace.status == "crashed"
    assert "does not implement tune" in trace.reason


def test_soft_time_limit():
    def tune(self, task, rng):
        while True:
            yield task.start

    trace, _ = run(tune, budget=10**6, seconds=0.05)
    assert trace.status == "timeout"
    assert 1 <= len(trace.losses) < 10**6


def test_tuner_cannot_change_what_is_recorded():
    def tune(self, task, rng):
        mine = np.array([[0.2, 0.2]])
        seen = yield mine
        mine[:] = 0.9
        with pytest.raises(ValueError, match="read-only"):
            seen.proposals[:] = 0.7
        yield mine

    trace, _ = run(tune, budget=2)
    np.testing.assert_array_equal(trace.proposals, [[0.2, 0.2], [0.9, 0.9]])


def test_time_of_a_batch_is_shared_out():
    def tune(self, task, rng):
        yield rng.uniform(size=(4, 2))

    trace, _ = run(tune, budget=4)
    assert len(set(trace.simulator_seconds)) == 1
    assert (trace.tuner_seconds > 0).all()


def test_generator_is_closed_when_the_budget_ends():
    closed = []

    def tune(self, task, rng):
        try:
            while True:
                yield task.start
        finally:
            closed.append(True)

    run(tune, budget=2)
    assert closed == [True]
