"""Tests of the worker pool: results identical to the last bit, and no process left behind."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from bench.core.resource_estimates import count_available_cores
from bench.diagnosis.evaluation import forked_workers as crews
from bench.diagnosis.evaluation.forked_workers import (
    ForkedWorkerPool,
    can_fork,
    serialise_message,
)
from bench.diagnosis.evaluation.search_control import SearchControl

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux alone")


def evaluator(**control_options):
    """Return the attributes of a run evaluator that a worker pool needs."""
    return SimpleNamespace(
        simulation_count=0,
        search_control=SearchControl(**control_options),
        worker_pool=None,
        factor=3,
    )


@pytest.fixture(autouse=True)
def eager(monkeypatch):
    """Start workers at once, for any amount of work and any threads of other tests."""
    monkeypatch.setattr(crews, "PARALLEL_THRESHOLD_SECONDS", 0.0)
    monkeypatch.setattr(crews, "can_fork", lambda: True)


def times(there, number):
    there.simulation_count += number
    return there.factor * number, os.getpid()


def dies(there, number):
    if number == 2 and os.getpid() != PARENT:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def fails(there, number):
    if number:
        raise ValueError(f"no {number}")


def waits(there, number):
    while not there.search_control.should_abandon_fit(0.0):
        time.sleep(0.01)
    return number


def summed(there, values):
    return float(values.sum()), values.strides, values


PARENT = os.getpid()


def alive(numbers):
    return [n for n in numbers if os.path.exists(f"/proc/{n}")]


@pytest.mark.parametrize("jobs", [2, 5])
def test_results_come_in_order_from_other_processes_and_are_accounted_for(jobs):
    there = evaluator()
    with closing(ForkedWorkerPool(jobs)) as crew:
        results = crew.map(there, times, [(n,) for n in range(20)])
    assert [value for value, _ in results] == [3 * n for n in range(20)]
    workers = {process for _, process in results}
    assert os.getpid() not in workers
    assert 1 <= len(workers) <= jobs
    assert there.simulation_count == sum(range(20))
    assert not alive(workers)


def test_one_job_and_one_item_stay_here():
    there = evaluator()
    with closing(ForkedWorkerPool(1)) as crew:
        assert {process for _, process in crew.map(there, times, [(1,), (2,)])} == {os.getpid()}
    with closing(ForkedWorkerPool(2)) as crew:
        assert crew.map(there, times, [(1,)])[0][1] == os.getpid()


def test_little_work_starts_nobody(monkeypatch):
    monkeypatch.setattr(crews, "PARALLEL_THRESHOLD_SECONDS", 60.0)
    with closing(ForkedWorkerPool(2)) as crew:
        for _ in range(3):
            results = crew.map(evaluator(), times, [(1,), (2,)])
            assert {process for _, process in results} == {os.getpid()}


def test_no_process_is_forked_while_a_thread_runs(monkeypatch):
    monkeypatch.setattr(crews, "can_fork", can_fork)
    done = threading.Event()
    thread = threading.Thread(target=done.wait)
    thread.start()
    try:
        with closing(ForkedWorkerPool(2)) as crew:
            results = crew.map(evaluator(), times, [(1,), (2,)])
    finally:
        done.set()
        thread.join()
    assert {process for _, process in results} == {os.getpid()}


def test_what_a_worker_that_died_was_at_is_done_again():
    there = evaluator()
    with closing(ForkedWorkerPool(2)) as crew:
        # Each worker that takes number 2 dies, until only this process remains.
        assert crew.map(there, dies, [(n,) for n in range(6)]) == list(range(6))
        assert crew.map(there, times, [(1,), (2,)])[0] == (3, os.getpid())


def test_a_fault_is_raised_here():
    with closing(ForkedWorkerPool(2)) as crew, pytest.raises(ValueError, match="no 1") as raised:
        crew.map(evaluator(), fails, [(n,) for n in range(3)])
    assert "in fails" in str(raised.value.__cause__)


def test_workers_leave_off_when_the_search_has_to_end():
    wanted = []
    there = evaluator(stop=lambda: bool(wanted) or wanted.append(1))
    with closing(ForkedWorkerPool(2)) as crew:
        assert crew.map(there, waits, [(1,), (2,)]) == [1, 2]
    assert there.search_control.has_abandoned_fits()
    there = evaluator(budget=0.2)
    with closing(ForkedWorkerPool(2)) as crew:
        assert crew.map(there, waits, [(1,), (2,)]) == [1, 2]


def test_a_message_keeps_the_order_of_arrays_in_memory():
    rng = np.random.default_rng(0)
    values = np.moveaxis(rng.standard_normal((7, 11, 13)), 0, -1)
    with closing(ForkedWorkerPool(2)) as crew:
        found = crew.map(evaluator(), summed, [(values,), (values.T,)])
    for (total, strides, back), sent in zip(found, (values, values.T), strict=True):
        assert total == float(sent.sum())
        assert strides == back.strides == sent.strides
        assert np.array_equal(back, sent)
    assert len(serialise_message(values)) < 1.1 * values.nbytes


def test_workers_end_with_a_parent_that_is_killed():
    code = textwrap.dedent(r"""
        import os, time
        from types import SimpleNamespace
        from bench.diagnosis.evaluation import forked_workers
        from bench.diagnosis.evaluation.search_control import SearchControl
        def task(world, number):
            os.write(1, f"{os.getpid()}\n".encode())
            time.sleep(60)
        forked_workers.PARALLEL_THRESHOLD_SECONDS = 0.0
        control = SearchControl()
        world = SimpleNamespace(simulation_count=0, search_control=control, worker_pool=None)
        forked_workers.ForkedWorkerPool(2).map(world, task, [(1,), (2,)])
    """)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        try:
            workers = [int(parent.stdout.readline()) for _ in range(2)]
            assert len(alive(workers)) == 2
        finally:
            parent.kill()
    for _ in range(200):
        if not alive(workers):
            break
        time.sleep(0.02)
    assert not alive(workers)


def test_there_is_a_core():
    assert count_available_cores() >= 1
