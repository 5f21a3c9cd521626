"""Start a real Dask scheduler and workers on the loopback interface."""

import json
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil


class Cluster:
    """Scheduler process and worker processes, which Dask nannies restart."""

    def __init__(self, folder, workers=2, environment=None):
        self._environment = environment
        self._file = folder / "scheduler.json"
        common = ["--scheduler-file", str(self._file), "--no-dashboard", "--host", "127.0.0.1"]
        self.scheduler = self._start("scheduler", "--port", "0", *common)
        self._await(self._file.exists)
        self.address = json.loads(self._file.read_text())["address"]
        local = ["--local-directory", str(folder), "--nthreads", "1"]
        self.nannies = [self._start("worker", *common, *local) for _ in range(workers)]
        self._await(lambda: len(self._there()) == workers)

    def _start(self, *arguments):
        command = [sys.executable, "-m", "dask", *arguments]
        nowhere = subprocess.DEVNULL
        return subprocess.Popen(command, stdout=nowhere, stderr=nowhere, env=self._environment)

    def _await(self, condition):
        deadline = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < deadline, "the cluster did not start"
            time.sleep(0.1)

    def _there(self):
        from distributed import Client

        with Client(self.address, timeout=30, set_as_default=False) as client:
            return client.nthreads()

    def workers(self):
        """Return the Dask worker processes, which are children of the nannies."""
        return [
            c
            for nanny in self.nannies
            for c in psutil.Process(nanny.pid).children()
            if "spawn_main" in command_line(c)
        ]

    def stop(self):
        processes = [
            psutil.Process(p.pid) for p in (*self.nannies, self.scheduler) if p.poll() is None
        ]
        # Kill the children too, so that no process remains.
        everyone = processes + [c for p in processes for c in p.children()]
        for process in everyone:
            try:
                process.kill()
            except psutil.NoSuchProcess:
                continue
        for process in (*self.nannies, self.scheduler):
            process.wait()


def command_line(process):
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


@contextmanager
def cluster(folder, workers=2, environment=None):
    started = Cluster(folder, workers, environment)
    try:
        yield started
    finally:
        started.stop()
