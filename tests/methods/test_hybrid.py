import numpy as np
import pytest

from bench.benchmark.runner.tuner_loop import drive_tuner
from methods.tuner import Evaluation, Task
from methods.tuners.hybrid import TuneNetLeastSquares, _compute_orthogonal_complement
from methods.tuners.least_squares import EvaluationHistory, LeastSquares
from methods.tuners.tunenet import TuneNet
from tests.methods import test_tunenet
from tests.methods.test_tunenet import TRAINING, Toy


@pytest.fixture(scope="module")
def two(two):
    """Return the trained network with least squares after it."""
    tuner = TuneNetLeastSquares(points=60)
    tuner.restore(two.state())
    return tuner


def errors(tuner, toy, budget=12, **options):
    """Return the mean absolute error after each simulation, (budget + 1,)."""
    return test_tunenet.errors(tuner, toy, range(12), budget, **options)


def test_starts_as_the_network_and_ends_as_least_squares(two):
    toy = Toy(2, runs=3)
    error, searched = errors(two, toy), errors(LeastSquares(), toy)
    assert error[1] < 0.03 < searched[1] / 2
    assert error[3] < 2e-3 < searched[3]
    assert error[12] < 1e-9


def test_finishes_where_the_network_is_wrong():
    """The network has one epoch on two scenarios, and targets are outside its training range."""
    poor = TuneNetLeastSquares(scenarios=2, points=60, epochs=1)
    poor.fit(Toy(2, budget=16), np.random.default_rng(0), 16)
    alone = TuneNet(points=60)
    alone.restore(poor.state())
    assert errors(alone, Toy(2), budget=30, wide=True)[30] > 1e-3
    assert errors(poor, Toy(2), budget=30, wide=True)[30] < 1e-9


def test_noise_is_averaged_as_least_squares_does(two):
    noise = np.random.default_rng(5)

    def spoil(observed):
        observed += 0.02 * noise.standard_normal(observed.shape)

    ours = errors(two, Toy(2, runs=3), budget=20, spoil=spoil)[20]
    noise = np.random.default_rng(5)
    theirs = errors(LeastSquares(), Toy(2, runs=3), budget=40, spoil=spoil)[40]
    assert ours == pytest.approx(theirs, rel=0.1)
    assert ours < 5e-3


def seen_so_far(points, matrix, offset=0.0):
    """Return the history of a run whose residuals are linear in the points."""
    task = Task(2, np.zeros(2), np.zeros((4, 1)), np.ones(1), TRAINING[2], 9, (4,))
    run = EvaluationHistory(task, 0.0)
    residuals = points @ matrix.T + offset
    for point, residual in zip(points, residuals, strict=True):
        run.tried.append(point)
        run.residuals.append(residual)
        run.losses.append(float(np.sqrt(np.mean(residual**2))))
    return run


def modelled(run, matrix):
    """Return the model, and the points simulated for it."""
    steps, asked = TuneNetLeastSquares()._build_linear_model(run, LeastSquares()), []
    try:
        points = next(steps)
        while True:
            asked += list(points)
            residuals = points @ matrix.T
            seen = Evaluation(points, residuals[:, :, None], np.sqrt((residuals**2).mean(axis=1)))
            points = steps.send(seen)
    except StopIteration as stop:
        return stop.value, asked


MATRIX = np.array([[1.0, 2.0], [0.0, -1.0], [3.0, 0.5], [1.0, 1.0]])


def test_model_takes_secants_for_differences():
    points = np.array([[0.4, 0.4], [0.41, 0.4], [0.41, 0.45], [0.9, 0.9]])
    model, asked = modelled(seen_so_far(points, MATRIX), MATRIX)
    assert not asked
    assert np.allclose(model.jacobian, MATRIX)
    assert model.point.tolist() == [0.4, 0.4]


def test_model_simulates_only_the_directions_that_are_missing():
    points = np.array([[0.4, 0.4], [0.43, 0.44], [0.9, 0.9]])  # the third is not near
    model, asked = modelled(seen_so_far(points, MATRIX), MATRIX)
    assert len(asked) == 1
    assert (asked[0] - points[0]) @ (points[1] - points[0]) == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(model.jacobian, MATRIX)
    rounding = np.array([[0.4, 0.4], [0.4 + 1e-9, 0.4]])
    _, asked = modelled(seen_so_far(rounding, MATRIX), MATRIX)
    assert len(asked) == 2


def test_complement_is_orthonormal():
    basis = [np.array([0.6, 0.8, 0.0])]
    directions = _compute_orthogonal_complement(basis, 3)
    assert directions.shape == (2, 3)
    assert np.allclose(directions @ directions.T, np.eye(2))
    assert np.allclose(directions @ basis[0], 0.0)


def test_everything_fails_and_it_still_uses_its_budget(two):
    toy = Toy(2, runs=3)
    task = toy.task(np.zeros((180, 2)), start=np.full(2, 0.5))

    def fail(points):
        return np.full((len(points), 180, 2), np.nan), np.full(len(points), np.inf)

    trace = drive_tuner(two, task, fail, np.random.default_rng(0))
    assert trace.status == "diverged"
    assert trace.reason.startswith("none of 9 simulations has a finite loss")
    assert len(trace.losses) == 9
