"""Run ``simgap explain`` of an installation with a limit of processor time, and measure it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

CPU_LIMIT = 120.0  # Maximum processor seconds of one call, summed over its processes.
WALL_FACTOR = 10.0  # A call that waits is ended after this multiple of the limit.
POLL_SECONDS = 0.1
RUNNING = set()  # Process groups of running calls.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Outcome:
    """Result and resources of a call of ``simgap explain``.

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
    cpu: float
    wall: float
    memory: float
    output: str

    @property
    def message(self):
        """Last lines of the output of a call without a verdict."""
        return "" if self.verdict else "\n".join(self.output.strip().splitlines()[-6:])[-1500:]

    def json(self):
        return asdict(self) | {"output": "", "message": self.message}


def parser_of(program, description, out):
    """Return a parser with the common options of programs that examine an installation.

    Args:
        program: module that is run, as in ``python -m PROGRAM``.
        description: text of its help.
        out: default of ``--out``.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {program}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--simgap",
        type=Path,
        default=Path(sys.executable).parent / "simgap",
        help="command of the installation to examine (default: the one of this Python)",
    )
    parser.add_argument("--version", help="name of it in the tables (default: its commit)")
    parser.add_argument("--out", type=Path, default=Path(out))
    parser.add_argument(
        "--cpu-limit",
        type=float,
        default=CPU_LIMIT,
        help="processor seconds of one call (default: %(default)s)",
    )
    parser.add_argument("--fresh", action="store_true", help="explain again with this version")
    return parser


def explain(simgap, recording, out, cpu_limit=CPU_LIMIT, options=("--jobs", "1")):
    """Run ``SIMGAP explain RECORDING --out OUT``.

    Args:
        simgap: path of the command of the examined installation.
        recording: path of the table or of the description, or a list of paths.
        out: output folder of the command.
        cpu_limit: processor seconds after which the call is ended.
        options: further options of the command.
    """
    recordings = recording if isinstance(recording, (list, tuple)) else [recording]
    command = [str(simgap), "explain", *map(str, recordings), "--out", str(out), *options]
    begin = time.perf_counter()
    with tempfile.TemporaryFile("w+", errors="replace") as printed:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=subprocess.STDOUT,
            env=os.environ | ONE_THREAD,
            start_new_session=True,
            cwd=Path(out).parent,
        )
        RUNNING.add(process.pid)
        used, peak, was_ended, pid = 0.0, 0.0, False, 0
        try:
            while not pid:
                time.sleep(POLL_SECONDS)
                seconds, resident = _tree_usage(process.pid)
                used, peak = max(used, seconds), max(peak, resident)
                wall = time.perf_counter() - begin
                if not was_ended and (used > cpu_limit or wall > WALL_FACTOR * cpu_limit):
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
    document = None if was_ended else _verdict(Path(out) / "verdict.json")
    return Outcome(
        document,
        None if was_ended else process.returncode,
        max(used, usage.ru_utime + usage.ru_stime),
        wall,
        max(peak, usage.ru_maxrss / 1024),
        output,
    )


def end_when_terminated():
    """Make SIGTERM and Ctrl-C of this program also end its running calls."""

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


def _verdict(path):
    if not path.is_file():
        return None
    document = json.loads(path.read_text())
    return {key: value for key, value in document.items() if key != "candidates"}


def version_of(simgap):
    """Return the version of an installation: the commit of its source, or its release.

    A "+" follows the commit if tracked files of the source differ from it.
    """
    code = (
        "import bench, importlib.metadata as m; print(bench.__file__); print(m.version('simgap'))"
    )
    python = Path(simgap).parent / "python"
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
