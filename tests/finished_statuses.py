"""Read how the finished runs of a study ended."""

from bench.benchmark.storage.run_journal import read_statuses_by_file


def read_finished_statuses(folder):
    """Return the statuses of the finished runs of a study by index in the plan."""
    return {
        plan_index: status
        for _, statuses in read_statuses_by_file(folder)
        for plan_index, status in statuses.items()
    }
