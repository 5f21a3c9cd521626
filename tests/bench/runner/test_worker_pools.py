import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from bench.benchmark.isolation.resource_limits import limited_memory
from bench.benchmark.runner.plugin_inspection import Plugin
from bench.benchmark.runner.worker_pools import (
    MAX_RETRIES,
    LocalPool,
    WorkerContext,
    WorkerDiedError,
    ignore_interrupts,
)
from sims.core.simulator import InputError
from tests.conftest import PLUGINS


def double(x):
    return 2 * x


def leave(code):
    os._exit(code)


def hang(path):
    Path(path).write_text(str(os.getpid()))
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(3600)


def killed_until(path, times):
    """Kill this process with SIGKILL in the first `times` calls; then return their number."""
    count = len(Path(path).read_text()) if Path(path).exists() else 0
    Path(path).write_text("x" * (count + 1))
    if count < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return count


def half_a_message():
    """Die while a large result is sent with the lock held: the parent waits for the rest."""
    import threading

    threading.Timer(0.2, lambda: os.kill(os.getpid(), signal.SIGKILL)).start()
    return np.zeros(60_000_000)


def shout():
    print("x" * 10_000_000)
    os.write(2, b"y" * 1_000_000)
    return sys.stdout.isatty()


def run_calls(calls, seconds=60.0, jobs=2, plugins=()):
    with LocalPool(jobs) as pool:
        pool.load_plugins([Plugin(path) for path in plugins])
        return dict(pool.iterate_results(calls, seconds))


def test_a_death_costs_its_own_call_and_no_other(monkeypatch):
    monkeypatch.setattr("bench.benchmark.runner.worker_pools.HARD_LIMIT_GRACE_SECONDS", 0.0)
    calls = [(double, (i,)) for i in range(40)]
    calls[3], calls[11], calls[12], calls[20] = (
        (leave, (3,)),
        (leave, (0,)),
        (os.abort, ()),
        (double, ()),
    )
    results = run_calls(calls)
    odd = {i: results[i] for i in (3, 11, 12, 20)}
    assert all(isinstance(odd[i], WorkerDiedError) for i in (3, 11, 12))
    assert [str(odd[i]) for i in (3, 11, 12)] == [
        "the worker process exited with code 3",
        "the worker process exited with code 0",
        "the worker process was killed by SIGABRT",
    ]
    assert isinstance(odd[20], TypeError)
    assert [results[i] for i in range(40) if i not in odd] == [
        2 * i for i in range(40) if i not in odd
    ]


def test_hanging_call_is_killed_at_its_limit_even_if_it_ignores_the_polite_signal(
    monkeypatch, tmp_path
):
    monkeypatch.setattr("bench.benchmark.runner.worker_pools.HARD_LIMIT_GRACE_SECONDS", 0.3)
    started = time.monotonic()
    results = run_calls([(hang, (str(tmp_path / "pid"),)), (double, (1,))], seconds=1.0)
    assert isinstance(results[0], TimeoutError)
    assert results[1] == 2
    assert time.monotonic() - started < 30
    assert not psutil.pid_exists(int((tmp_path / "pid").read_text()))


@pytest.mark.parametrize(
    ("times", "expected"), [(MAX_RETRIES, MAX_RETRIES), (MAX_RETRIES + 5, WorkerDiedError)]
)
def test_call_whose_worker_is_killed_from_outside_is_made_again_but_not_for_ever(
    tmp_path, times, expected
):
    result = run_calls([(killed_until, (str(tmp_path / "count"), times)), (double, (1,))])[0]
    if expected is WorkerDiedError:
        assert isinstance(result, WorkerDiedError)
        assert "SIGKILL (out of memory?)" in str(result)
        assert len((tmp_path / "count").read_text()) == MAX_RETRIES + 1
    else:
        assert result == expected


@pytest.mark.slow
def test_worker_killed_in_the_middle_of_its_answer_stops_nobody():
    results = run_calls([(half_a_message, ()), *[(double, (i,)) for i in range(5)]])
    assert [results[i] for i in range(1, 6)] == [0, 2, 4, 6, 8]
    assert isinstance(results[0], WorkerDiedError | np.ndarray)


def test_what_is_printed_goes_nowhere(capfd):
    assert run_calls([(shout, ())], jobs=1) == {0: False}
    captured = capfd.readouterr()
    assert "x" not in captured.out
    assert "yyyy" not in captured.err


def test_workers_that_die_at_once_are_an_error_and_no_endless_loop(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("bench.benchmark.runner.worker_pools._MAX_IMMEDIATE_DEATHS", 2)
    plugin = tmp_path / "fatal.py"
    plugin.write_text("import os\nos._exit(9)\n")
    with pytest.raises(InputError, match="die as soon as they start"):
        run_calls([(double, (1,))], jobs=1, plugins=[str(plugin)])


def test_no_worker_outlives_its_parent(tmp_path):
    import subprocess

    code = (
        "from bench.benchmark.runner.worker_pools import LocalPool\n"
        "from tests.bench.runner.test_worker_pools import hang\n"
        "if __name__ == '__main__':\n"
        "    pool = LocalPool(1)\n"
        f"    list(pool.iterate_results([(hang, ({str(tmp_path / 'pid')!r},))], 100.0))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    root = str(PLUGINS.parents[1])
    parent = subprocess.Popen(
        [sys.executable, str(script)], env={**os.environ, "PYTHONPATH": root}, cwd=root
    )
    deadline = time.monotonic() + 30
    while (
        not ((tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
        and time.monotonic() < deadline
    ):
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    worker = int((tmp_path / "pid").read_text())
    while (
        psutil.pid_exists(worker)
        and psutil.Process(worker).status() != "zombie"
        and time.monotonic() < deadline
    ):
        time.sleep(0.05)
    assert not psutil.pid_exists(worker) or psutil.Process(worker).status() == "zombie"


def allocate_within_and_beyond_the_limit():
    with limited_memory(200):
        held = np.ones(12_500_000)  # 100 MB: within the limit
        with pytest.raises(MemoryError):
            np.ones(37_500_000)  # 300 MB: beyond the limit
    del held
    assert np.ones(37_500_000).nbytes == 300_000_000
    with limited_memory(0):
        assert np.ones(37_500_000).nbytes == 300_000_000


def test_memory_beyond_the_limit_is_refused_and_the_limit_ends_with_the_block():
    """Run in a new process, because memory that a process has freed is reused without limit."""
    process = multiprocessing.get_context("spawn").Process(
        target=allocate_within_and_beyond_the_limit
    )
    process.start()
    process.join(60.0)
    assert process.exitcode == 0


def interrupted_at_birth(context):
    """Return the exit code of a process that receives Ctrl-C as soon as it exists."""
    process = context.Process(target=exit_on_interrupt)
    process.start()
    os.kill(process.pid, signal.SIGINT)
    process.join(60.0)
    return process.exitcode


def exit_on_interrupt():
    ignore_interrupts()
    os.kill(os.getpid(), signal.SIGINT)
    os._exit(7)


def test_an_interrupt_waits_for_a_worker_that_is_not_there_yet():
    """Ctrl-C goes to the whole process group; a worker that is importing would show a traceback."""
    assert interrupted_at_birth(WorkerContext()) == 7
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_an_interrupt_ends_a_process_that_nothing_shelters():
    assert interrupted_at_birth(multiprocessing.get_context("spawn")) != 7
