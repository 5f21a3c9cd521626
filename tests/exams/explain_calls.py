"""Call `simgap explain`: the function in this process, or the command of an installation.

Both have a limit of processor time and measure time and memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path

WALL_FACTOR = 10.0  # A call that waits is ended after this multiple of the limit.
POLL_SECONDS = 0.1
RUNNING = set()  # Process groups of running commands.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Outcome:
    """Result and resources of a call of `simgap explain`.

    Attributes:
        verdict: verdict.json without candidates; None if there is none.
        code: exit code; None if the call was ended at its limit.
        cpu: user and system seconds of all processes of the call.
        wall: elapsed seconds.
        memory: peak resident memory of the largest process, MB.
        output: output of the call.
    """

    verdict: dict | None
    code: int | None
    cpu: float = 0.0
    wall: float = 0.0
    memory: float = 0.0
    output: str = ""

    @property
    def message(self):
        """Last lines of the output of a call without a verdict."""
        return "" if self.verdict else "\n".join(self.output.strip().splitlines()[-6:])[-1500:]

    def to_json(self):
        return asdict(self) | {"output": "", "message": self.message}


@dataclass(frozen=True)
class ExplainCall:
    """How an exam calls `simgap explain`.

    Attributes:
        simgap: command of the installation to examine; None for the function in this process.
        cpu_limit: processor seconds after which a call is ended.
    """

    simgap: Path | None = None
    cpu_limit: float = 120.0

    def __call__(self, recording, out, options=()):
        """Explain one recording.

        Args:
            recording: path of the table or of the description.
            out: output folder of the command.
            options: further options of the command; they need `simgap`.
        """
        if self.simgap is None:
            return self._in_process(recording)
        return self._by_command(recording, out, ("--jobs", "1", *options))

    def _in_process(self, recording):
        from bench.diagnosis.explain import explain

        # Processor time beyond the limit kills this worker, which the runner notices.
        _reset_peak_memory()
        before, begin = time.process_time(), time.perf_counter()
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (int(before + self.cpu_limit) + 1, hard))
        verdict, output = None, ""
        try:
            verdict = _without_candidates(explain(recording).answer.to_document())
        except Exception:
            output = traceback.format_exc(limit=-4)
        finally:
            resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
        memory = _read_peak_memory()
        seconds = time.process_time() - before, time.perf_counter() - begin
        return Outcome(verdict, 1 if output else 0, *seconds, memory, output)

    def _by_command(self, recording, out, options):
        command = [str(self.simgap), "explain", str(recording), "--out", str(out), *options]
        begin = time.perf_counter()
        with tempfile.TemporaryFile("w+", errors="replace") as printed:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=printed, stderr=subprocess.STDOUT,
                env=os.environ | ONE_THREAD, start_new_session=True, cwd=Path(out).parent,
            )  # fmt: skip
            RUNNING.add(process.pid)
            used, peak, was_ended, pid = 0.0, 0.0, False, 0
            try:
                while not pid:
                    time.sleep(POLL_SECONDS)
                    seconds, resident = _tree_usage(process.pid)
                    used, peak = max(used, seconds), max(peak, resident)
                    wall = time.perf_counter() - begin
                    limits = self.cpu_limit, WALL_FACTOR * self.cpu_limit
                    if not was_ended and (used > limits[0] or wall > limits[1]):
                        was_ended = True
                        os.killpg(process.pid, signal.SIGKILL)
                    pid, status, usage = os.wait4(process.pid, os.WNOHANG)
                process.returncode = os.waitstatus_to_exitcode(status)
            finally:
                RUNNING.discard(process.pid)
                if not pid:
                    os.killpg(process.pid, signal.SIGKILL)
            printed.seek(0)
            output = printed.read()
        path, verdict = Path(out) / "verdict.json", None
        if path.is_file() and not was_ended:
            verdict = _without_candidates(json.loads(path.read_text()))
        return Outcome(
            verdict, None if was_ended else process.returncode,
            max(used, usage.ru_utime + usage.ru_stime), wall,
            max(peak, usage.ru_maxrss / 1024), output,
        )  # fmt: skip


def _reset_peak_memory():
    """Reset the peak memory of this process, which answers one question after another (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _read_peak_memory():
    """Return the peak memory of this process in MB; on other systems that of all questions."""
    with contextlib.suppress(OSError):
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _without_candidates(document):
    return {key: value for key, value in document.items() if key != "candidates"}


def end_commands_when_terminated():
    """Make SIGTERM and Ctrl-C of this process also end its running commands."""

    def end(number, frame):
        for group in RUNNING:
            os.killpg(group, signal.SIGKILL)
        os._exit(128 + number)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)


def _tree_usage(pid):
    """Return processor seconds and peak resident MB of a process and its descendants."""
    import psutil

    try:
        root = psutil.Process(pid)
        processes = [root, *root.children(recursive=True)]
    except psutil.NoSuchProcess:
        return 0.0, 0.0
    seconds, resident = 0.0, 0.0
    for process in processes:
        try:
            times = process.cpu_times()
            resident = max(resident, process.memory_info().rss / 2**20)
        except psutil.NoSuchProcess:
            continue
        # The parent includes the times of ended children after it has waited for them.
        seconds += times.user + times.system + times.children_user + times.children_system
    return seconds, resident


def version_of(simgap=None):
    """Return the version of an installation: the commit of its source, or its release.

    A "+" follows the commit if tracked files of the source differ from it.

    Args:
        simgap: command of the installation; None for the one of this Python.
    """
    code = (
        "import bench, importlib.metadata as m; print(bench.__file__); print(m.version('simgap'))"
    )
    python = Path(simgap).parent / "python" if simgap else sys.executable
    source, release = subprocess.run(
        [python, "-c", code], cwd="/", capture_output=True, text=True, check=True
    ).stdout.split()
    folder = Path(source).parents[1]

    def git(*words):
        return subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, check=False
        )

    commit = git("rev-parse", "--short=8", "HEAD")
    if commit.returncode or not (folder / ".git").exists():
        return release
    changed = git("status", "--porcelain", "--untracked-files=no", "bench", "sims", "methods")
    return commit.stdout.strip() + "+" * bool(changed.stdout.strip())
