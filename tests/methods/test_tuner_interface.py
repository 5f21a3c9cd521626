import threading
from collections.abc import Callable

import numpy as np
import pytest

from bench.benchmark.runner.tuner_loop import drive_tuner
from methods.tuner import Array, Evaluation, Task, Tuner, TunerGenerator, from_callback
from tests.methods.analytic_problems import smooth


def threads() -> int:
    return sum(thread.name == "callback-optimiser" for thread in threading.enumerate())


def seen(points: Array, loss: float) -> Evaluation:
    return Evaluation(points, np.zeros((1, 1, 1)), np.array([loss]))


class Endless(Tuner):
    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        def minimise(loss: Callable[[Array], float]) -> str | None:
            while True:
                loss(task.start)

        return from_callback(minimise)


def test_points_and_losses_are_handed_over_in_order() -> None:
    answers = []

    def minimise(loss: Callable[[Array], float]) -> str | None:
        point = np.array([0.1])
        answers.append(loss(point))
        point[0] = 0.2  # the optimiser may reuse its array
        answers.append(loss(point))
        return "two are enough"

    steps = from_callback(minimise)
    first = next(steps)
    second = steps.send(seen(np.asarray(first), 3.0))
    with pytest.raises(StopIteration) as stop:
        steps.send(seen(np.asarray(second), 4.0))
    assert (np.asarray(first) == [[0.1]]).all()
    assert (np.asarray(second) == [[0.2]]).all()
    assert answers == [3.0, 4.0]
    assert stop.value.value == "two are enough"
    assert threads() == 0


def test_optimiser_works_only_while_the_harness_waits() -> None:
    log = []

    def minimise(loss: Callable[[Array], float]) -> str | None:
        for k in range(3):
            log.append(f"asks {k}")
            loss(np.array([0.5]))
        return None

    steps = from_callback(minimise)
    asked = next(steps)
    for k in range(2):
        log.append(f"simulates {k}")
        asked = steps.send(seen(np.asarray(asked), 0.0))
    steps.close()
    assert log == ["asks 0", "simulates 0", "asks 1", "simulates 1", "asks 2"]


def test_error_of_the_optimiser_is_filed_as_a_crash() -> None:
    class Broken(Tuner):
        def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
            def minimise(loss: Callable[[Array], float]) -> str | None:
                loss(task.start)
                loss(task.start)
                raise ZeroDivisionError("the optimiser's own")

            return from_callback(minimise)

    trace = drive_tuner(Broken(), *smooth(1, 10), np.random.default_rng(0))
    assert trace.status == "crashed"
    assert "ZeroDivisionError: the optimiser's own" in trace.reason
    assert len(trace.losses) == 2
    assert threads() == 0


def test_error_of_the_simulator_ends_the_thread() -> None:
    task, _ = smooth(1, 10)

    def evaluate(points: Array) -> tuple[Array, Array]:
        raise RuntimeError("no simulator")

    assert drive_tuner(Endless(), task, evaluate, np.random.default_rng(0)).status == "crashed"
    assert threads() == 0


def test_closed_run_ends_the_thread() -> None:
    trace = drive_tuner(Endless(), *smooth(1, 3), np.random.default_rng(0))
    assert trace.status == "done"
    assert len(trace.losses) == 3
    assert threads() == 0


def test_run_that_never_began_starts_no_thread() -> None:
    task, _ = smooth(1, 3)
    steps = Endless().tune(task, np.random.default_rng(0))
    assert threads() == 0
    steps.close()
    assert threads() == 0


def test_many_runs_leave_no_threads() -> None:
    before = threading.active_count()
    task, evaluate = smooth(1, 2)
    for seed in range(50):
        drive_tuner(Endless(), task, evaluate, np.random.default_rng(seed))
    assert threading.active_count() == before


def test_optimiser_without_a_question_ends_at_once() -> None:
    with pytest.raises(StopIteration) as stop:
        next(from_callback(lambda loss: "nothing to do"))
    assert stop.value.value == "nothing to do"


def test_residuals_are_in_units_of_the_scale_and_zero_where_nothing_was_seen() -> None:
    observed = np.array([[1.0, 10.0], [np.nan, 20.0], [3.0, np.nan]])
    corners = np.array([[0.0], [1.0]])
    task = Task(1, np.array([0.5]), observed, np.array([0.1, 5.0]), corners, 1, (3,))
    simulated = np.stack([observed, observed + np.array([0.2, -5.0])])
    simulated[np.isnan(simulated)] = 7.0
    expected = [[0.0] * 6, [2.0, -1.0, 0.0, -1.0, 2.0, 0.0]]
    np.testing.assert_allclose(task.residuals(simulated), expected, atol=1e-12)
