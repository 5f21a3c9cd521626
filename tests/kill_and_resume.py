"""Kills the runner, its workers, a cluster's workers, and the processes in which tuners live and
those that start them, at random moments; resumes, and compares with no kill at all.

Nothing may be lost or doubled, every table must be the same, and neither a process nor a folder of
a tuner may remain.

`make chaos` makes 100 kills. Run `python -m tests.kill_and_resume --kills N [--seed S]` for another
number.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import subprocess
import tempfile
import time
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import psutil
import tomli_w

from bench.benchmark.isolation.temporary_folders import remove_stale_folders
from bench.benchmark.storage.result_folder import read_configuration
from bench.benchmark.storage.run_journal import read_statuses
from tests.conftest import PLUGINS
from tests.local_cluster import cluster, command_line
from tests.sample_experiments import SPRING
from tests.without_drawing import COMMAND

MEASURED = ["tuner_seconds", "simulator_seconds", "fit_seconds", "seconds"]
TUNERS = {"random": {}, "cma_es": {}, "least_squares": {}, "regressor": {"seeds": 1}}

SALT = "as secret as can be"
ISOLATION_PROCESSES = ("nursery", "keeper", "tuner")
"""Kinds of processes below a worker: fork server, supervisor, isolated tuner (each the parent of
the next).
"""


def start(folder, experiment, address, environment, isolation="run"):
    """Start a new comparison, or resume one that was killed."""
    begun = (
        ["--resume", str(folder)]
        if folder.exists()
        else [str(experiment), "--out", str(folder), "--salt", SALT, "--isolation", isolation]
    )
    where = ["--cluster", address] if address else ["--jobs", "2"]
    command = [
        *COMMAND,
        "compare",
        *begun,
        *where,
        "--plugin",
        str(PLUGINS / "spring.py"),
    ]
    with errors_of(folder).open("w") as errors:
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=errors)


def errors_of(folder):
    return folder.with_suffix(".stderr")


def victims(process, what, running):
    """Return the living processes of one kind; `process` is the runner."""
    runner = psutil.Process(process.pid)
    if what == "runner":
        return [runner]
    if what == "cluster worker":
        return running.workers()
    if what == "worker":
        return [c for c in runner.children() if "spawn_main" in command_line(c)]
    return below([runner, *(running.workers() if running else [])], what)


def below(top, what):
    """Return the fork servers, supervisors or tuners that descend from these processes."""
    everyone = [c for one in top for c in one.children(recursive=True)]
    # All three have the same command line, because the fork server forks the others.
    processes = {
        c.pid: c for c in everyone if "bench.benchmark.isolation.fork_server" in command_line(c)
    }
    return [c for c in processes.values() if _kind(c, processes) == what]


def _kind(process, processes):
    """Return the kind of a process; None if it has ended since it was listed."""
    try:
        return ISOLATION_PROCESSES[_depth(process, processes)]
    except psutil.NoSuchProcess:
        return None


def _depth(process, processes):
    depth = 0
    while (process := processes.get(process.ppid())) is not None:
        depth += 1
    return min(depth, 2)


def disturbed(folder, experiment, kills, rng, running, environment, isolation):
    """Kill processes at random moments until `kills` are reached or all runs are done.

    Returns:
        Number of kills by kind of process.
    """
    hits = Counter()
    address = running and running.address
    process = start(folder, experiment, address, environment, isolation)
    while sum(hits.values()) < kills:
        time.sleep(rng.uniform(0.0, 2.5))
        if process.poll() is not None:
            if process.returncode != 0:
                raise AssertionError(ended(process, folder))
            return hits
        before = read_statuses(folder)
        what = str(
            rng.choice(["runner", "cluster worker" if running else "worker", *ISOLATION_PROCESSES])
        )
        if not killed(process, what, running, rng):
            continue
        hits[what] += 1
        if what == "runner":
            process.wait()
            after = read_statuses(folder)
            lost = set(before) - set(after)
            if lost and (folder / "segments").exists():
                raise AssertionError(f"lost {len(lost)} finished runs")
            process = start(folder, experiment, address, environment, isolation)
    if process.wait(timeout=600) != 0:
        raise AssertionError(ended(process, folder))
    return hits


def ended(process, folder):
    """Return the exit code and errors of a runner, and the failed runs of its status table."""
    words = f"it ended with {process.returncode}: {errors_of(folder).read_text()}"
    if not (folder / "status.csv").exists():
        return words
    status = pd.read_csv(folder / "status.csv")
    return words + status[status["status"] == "crashed"][["run", "reason"]].to_csv()


def killed(process, what, running, rng):
    """Kill one process of this kind, and return whether one was found.

    Some processes live only briefly, so the search is repeated for up to 1 s.
    """
    until = time.monotonic() + 1.0
    while time.monotonic() < until and process.poll() is None:
        with suppress(psutil.NoSuchProcess):
            chosen = victims(process, what, running)
            if chosen:
                chosen[int(rng.integers(len(chosen)))].kill()
                return True
    return False


def check_nothing_left(place, running):
    """Wait up to 20 s, then raise if orphaned processes or abandoned folders remain."""
    until = time.monotonic() + 20.0
    while orphans(place, running) or deserted(place):
        if time.monotonic() > until:
            raise AssertionError(f"left: {orphans(place, running)}, {deserted(place)}")
        time.sleep(0.2)


def of_ours(place):
    """Return the processes whose temporary folder is below `place`, whatever their parent is."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.environ().get("TMPDIR", "").startswith(str(place)):
                found.append(process)
    return found


def orphans(place, running):
    """Return the processes of the runs that still live; those of the cluster may continue."""
    top = [] if running is None else [running.scheduler, *running.nannies]
    kept = {p.pid for p in top}
    for one in top:
        kept |= {c.pid for c in psutil.Process(one.pid).children(recursive=True)}
    return [p for p in of_ours(place) if p.pid not in kept and p.is_running()]


def deserted(place):
    """Return the tuner folders that no living process has locked."""
    found = []
    for path in place.glob("simgap-tuner-*"):
        with suppress(OSError), closing(path) as folder:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            found.append(path)
    return found


@contextmanager
def closing(path):
    folder = os.open(path, os.O_RDONLY)
    try:
        yield folder
    finally:
        os.close(folder)


def compare(folder, undisturbed):
    """Raise unless both result folders are equal except for measured times."""
    for name, read in (
        ("status.csv", pd.read_csv),
        ("table.csv", pd.read_csv),
        ("runs.parquet", pd.read_parquet),
    ):
        a, b = (read(f / name) for f in (folder, undisturbed))
        pd.testing.assert_frame_equal(
            *(f.drop(columns=[c for c in MEASURED if c in f]) for f in (a, b)), check_exact=True
        )
        if name == "status.csv" and a["run"].duplicated().any():
            raise AssertionError("runs are doubled")
    for each in (folder, undisturbed):
        if read_configuration(each).experiment.salt != SALT or (each / "segments").exists():
            raise AssertionError(f"{each}: the salt was not revealed")


def chaos(folder, kills, seed, on_cluster, targets=60):
    """Repeat a comparison with random kills until there were `kills` kills.

    Returns:
        Number of kills by kind of process, number of rounds, and number of runs of a comparison.
    """
    rng = np.random.default_rng(seed)
    experiment = folder / "chaos.toml"
    document = {
        **{key: value for key, value in SPRING.items() if key != "salt"},
        "targets": targets,
        "seeds": 2,
        "budget": 60,
        "training_budget": 60,
        "tuners": TUNERS,
    }
    experiment.write_text(tomli_w.dumps(document))
    # A separate temporary folder: everything left in it comes from these runs.
    place = folder / "tmp"
    place.mkdir()
    environment = {**os.environ, "SIMGAP_CACHE": str(folder / "cache"), "TMPDIR": str(place)}
    hits, rounds = Counter(), 0
    with cluster(folder, environment=environment) if on_cluster else _nobody() as running:
        while (left := kills - sum(hits.values())) > 0:
            rounds += 1
            isolation = ("tuner", "run")[rounds % 2]
            undisturbed = folder / f"undisturbed-{isolation}"
            if not undisturbed.exists():
                start(undisturbed, experiment, None, environment, isolation).wait(timeout=600)
            folder_here = folder / f"round-{on_cluster:d}-{rounds}"
            hits += disturbed(folder_here, experiment, left, rng, running, environment, isolation)
            compare(folder_here, undisturbed)
            check_nothing_left(place, running)
    # The next runner cleans up like this. The cluster itself was killed, on both sides of its
    # pipes.
    with patch("tempfile.tempdir", str(place)):
        remove_stale_folders()
    check_nothing_left(place, None)
    return hits, rounds, len(pd.read_csv(undisturbed / "status.csv"))


class _nobody:  # noqa: N801 - a context manager that gives None
    def __enter__(self):
        return None

    def __exit__(self, *_):
        return None


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    total = Counter()
    shares = ((options.kills - options.kills // 4, False), (options.kills // 4, True))
    for kills, on_cluster in shares:
        with tempfile.TemporaryDirectory() as folder:
            started = time.monotonic()
            hits, rounds, runs = chaos(Path(folder), kills, options.seed, on_cluster)
            where = "cluster" if on_cluster else "local"
            seconds = time.monotonic() - started
            print(
                f"{where}: {dict(hits)} in {rounds} rounds of {runs} runs, {seconds:.0f} s: "
                "identical",
                flush=True,
            )
            total += hits
    print(
        f"{sum(total.values())} kills; nothing lost, nothing doubled, nothing left, "
        "every table identical"
    )


if __name__ == "__main__":
    main()
