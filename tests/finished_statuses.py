"""Read how the finished runs of a study ended."""

import time

from bench.benchmark.storage.run_journal import read_statuses


def wait_for_runs(process, folder, count, seconds=120.0):
    """Wait until a process has finished this number of runs, has ended, or the time is over."""
    deadline = time.monotonic() + seconds
    while (
        len(read_statuses(folder)) < count
        and process.poll() is None
        and time.monotonic() < deadline
    ):
        time.sleep(0.01)
