"""Tuners that search for the true parameters or simulate without being counted.

A tuner that finds nothing continues as random search.
"""

import contextlib
import ctypes
import gc
import os
import sys
import time
from pathlib import Path

import numpy as np

from methods.tuner import Tuner
from methods.tuners.random_search import RandomSearch

NAME = "spring-test"
"""Name of the experiment, which is public."""
LOWEST, WIDTHS = np.array([1.0, 0.0]), np.array([4.0, 1.0])
"""Lower bounds and widths of its parameters, which are public."""
SOMEWHERE = ("/tmp", "/var/tmp", "/dev/shm", "/home", "/root", "/work", "/srv", "/mnt")
"""Folders in which users may store results."""


def cube(physical):
    return (np.asarray(physical) - LOWEST) / WIDTHS


class Cheat(RandomSearch):
    """Proposes points from another source; the base class has none.

    Args:
        places: folders of the comparison, which an attacker may know.
    """

    name = "cheat"

    def __init__(self, places=()):
        self.places = [Path(place) for place in places]

    def find(self, task):
        return []

    def tune(self, task, rng):
        found = []
        with contextlib.suppress(Exception):
            found = [np.clip(point, 0.0, 1.0) for point in self.find(task)]
        # Leave half of the budget to random search.
        for point in found[: task.budget // 2]:
            yield point[None]
        return (yield from super().tune(task, rng))


def matching(targets, task):
    return [cube(t.truth) for t in targets if np.array_equal(t.blinded.start, task.start)]


class ProblemOfWorker(Cheat):
    """Samples the targets with the problem of the worker process."""

    name = "problem-of-worker"

    def find(self, task):
        from bench.benchmark.problem.targets import draw_targets
        from bench.benchmark.runner import run_in_worker

        problems = [problem for _, problem in run_in_worker._problems.values()]
        return [point for problem in problems for point in matching(draw_targets(problem), task)]


def drawn(task, salt):
    """Yield the true parameters that belong to this start, computed with public functions."""
    from bench.core.random_streams import TargetStreams

    whole = np.array([[0.0], [1.0]])
    for index in range(20):
        for kind, box in (("in", task.training), ("wide", whole)):
            streams = TargetStreams(salt, NAME, kind, index)
            start, truth = (
                streams.get_stream(what).uniform(box[0], box[1], size=task.dim)
                for what in ("start", "truth")
            )
            if np.array_equal(start, task.start):
                yield truth


class DrawnAgain(Cheat):
    name = "drawn-again"

    def find(self, task):
        return [point for salt in ("", "public", "None") for point in drawn(task, salt)]


class DrawnFromTheSalt(Cheat):
    """Reads the secret salt from its file, and tries environment variables as salts."""

    name = "drawn-from-the-salt"

    def find(self, task):
        salts = [path.read_text() for place in self.places for path in place.rglob("salt")]
        salts += list(os.environ.values())
        return [point for salt in salts for point in drawn(task, salt)]


def list_true_parameters(folders):
    """Return the true parameters in journals and tables below these folders, without duplicates."""
    return list({tuple(truth): truth for truth in _read_true_parameters(folders)}.values())


def _read_true_parameters(folders):
    import pyarrow.parquet

    from bench.benchmark.storage.run_journal import decode_rows, read_records

    for folder in folders:
        for path in folder.rglob("*.journal"):
            for record in read_records(path):
                rows = decode_rows(record.rows)
                yield cube([rows["true_rate"][0].as_py(), rows["true_decay"][0].as_py()])
        for path in folder.rglob("*.parquet"):
            rows = pyarrow.parquet.read_table(path)
            yield cube([rows["true_rate"][0].as_py(), rows["true_decay"][0].as_py()])


class Journal(Cheat):
    """Reads the results of other tuners for the same targets from disk."""

    name = "journal"

    def find(self, task):
        return list_true_parameters([*self.places, Path.cwd()])


class Anywhere(Cheat):
    """Searches for results in common folders and in paths from environment variables."""

    name = "anywhere"

    def find(self, task):
        told = [Path(text) for text in os.environ.values() if text.startswith("/")]
        upward = [Path(f"/proc/self/{link}").resolve() for link in ("cwd", "root", "exe")]
        return list_true_parameters([*map(Path, SOMEWHERE), *told, *upward])


def regions(pid):
    """Yield begin and end of each writable memory region of a process."""
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        place, rights, *_ = line.split()
        begin, end = (int(part, 16) for part in place.split("-"))
        if rights.startswith("rw") and end - begin < 1 << 27:
            yield begin, end


class Memory(Cheat):
    """Searches the harness's memory for the start, which is stored next to the true parameters."""

    name = "memory"

    def read_memory(self, pid):
        with open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
            for begin, end in regions(pid):
                with contextlib.suppress(OSError):
                    memory.seek(begin)
                    yield memory.read(end - begin)

    def find(self, task):
        pids = [os.getppid(), *(int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit())]
        wanted, found = task.start.tobytes(), []
        for pid in [pid for pid in pids if pid not in (0, os.getpid())]:
            with contextlib.suppress(OSError):
                for piece in self.read_memory(pid):
                    place = piece.find(wanted)
                    if place >= 0:
                        near = np.frombuffer(piece[place : place + 256], "<f8", count=32)
                        found += [near[i : i + task.dim] for i in range(2, 30)]
        return found


class VmRead(Memory):
    """Reads memory with `process_vm_readv`, which does not open /proc/PID/mem."""

    name = "vm-read"

    def read_memory(self, pid):
        libc = ctypes.CDLL(None, use_errno=True)

        class Vector(ctypes.Structure):
            _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))

        for begin, end in regions(pid):
            held = ctypes.create_string_buffer(end - begin)
            here = Vector(ctypes.addressof(held), end - begin)
            there = Vector(begin, end - begin)
            if libc.process_vm_readv(pid, ctypes.byref(here), 1, ctypes.byref(there), 1, 0) > 0:
                yield held.raw


class Ptrace(Memory):
    """Stops the parent with ptrace and reads its memory."""

    name = "ptrace"

    def read_memory(self, pid):
        libc = ctypes.CDLL(None, use_errno=True)
        attach, seize, detach = 16, 0x4206, 17
        if libc.ptrace(seize, pid, None, None) < 0 and libc.ptrace(attach, pid, None, None) < 0:
            return
        yield from super().read_memory(pid)
        libc.ptrace(detach, pid, None, None)


class Descriptors(Memory):
    """Reads file descriptors and pipes that were left open."""

    name = "descriptors"

    def read_memory(self, _):
        for descriptor in range(3, 4096):
            with contextlib.suppress(OSError):
                os.set_blocking(descriptor, False)
                yield os.read(descriptor, 1 << 20)

    def find(self, task):
        wanted = task.start.tobytes()
        return [np.frombuffer(p[:16], "<f8") for p in self.read_memory(0) if wanted in p]


def frames():
    """Yield every frame of every thread and its callers."""
    for frame in [sys._getframe(), *sys._current_frames().values()]:
        while frame is not None:
            yield frame
            frame = frame.f_back


def best_of(evaluator, dim):
    """Return the best of 1000 simulations that are removed from the count."""
    evaluator = getattr(evaluator, "_evaluate", evaluator)
    points = np.random.default_rng(0).uniform(size=(1000, dim))
    problem = evaluator._problem
    before, seen = problem.simulated, list(evaluator._evaluated_squares)
    _, losses = evaluator(points)
    problem.simulated, evaluator._evaluated_squares[:] = before, seen
    return points[np.argsort(losses)[:1]]


class Frames(Cheat):
    """Takes the evaluator from the calling frames and resets its counter."""

    name = "frames"

    def find(self, task):
        for frame in frames():
            evaluator = frame.f_locals.get("evaluate") or frame.f_locals.get("evaluator")
            if evaluator is not None:
                return best_of(evaluator, task.dim)
        return []


class Garbage(Cheat):
    """Searches all living objects for the evaluator and for targets."""

    name = "garbage"

    def find(self, task):
        known = [thing for thing in gc.get_objects() if type(thing).__name__ == "ProposalEvaluator"]
        found = [best_of(evaluator, task.dim)[0] for evaluator in known[-1:]]
        targets = [thing for thing in gc.get_objects() if type(thing).__name__ == "Target"]
        return found + matching(targets, task)


class Spy:
    """An object that runs an attack when it is converted to an array."""

    def __init__(self, cheat, task):
        self.cheat, self.task = cheat, task

    def __array__(self, dtype=None, copy=None):
        found = self.cheat.find(self.task)
        return np.array(found[0] if len(found) else self.task.start, dtype=np.float64)


class Locals(Frames):
    """Runs the attack in the frames that convert its proposal, or in the traceback of an error."""

    name = "locals"

    def find(self, task):
        try:
            np.asarray(Spy(super(), task)).reshape(99)
        except ValueError as error:
            trace = error.__traceback__
            while trace is not None:
                evaluator = trace.tb_frame.f_locals.get("evaluate")
                if evaluator is not None:
                    return best_of(evaluator, task.dim)
                trace = trace.tb_next
        return super().find(task)

    def tune(self, task, rng):
        yield Spy(self, task)
        return (yield from super().tune(task, rng))


class UsedPutBack(Cheat):
    """Increases its budget and resets the count of used simulations."""

    name = "used-put-back"

    def tune(self, task, rng):
        object.__setattr__(task, "budget", 10**9)
        steps = super().tune(task, rng)
        evaluation = None
        while True:
            asked = steps.send(evaluation)
            evaluation = yield asked
            for frame in frames():
                for name in ("record", "used"):
                    record = frame.f_locals.get(name)
                    if hasattr(record, "used"):
                        record.used = 1


class ChangedAfterwards(Cheat):
    """Overwrites earlier proposals and losses with the best ones."""

    name = "changed-afterwards"

    def tune(self, task, rng):
        steps, evaluation, shown = super().tune(task, rng), None, []
        while True:
            asked = steps.send(evaluation)
            evaluation = yield asked
            shown.append(evaluation)
            best = min(shown, key=lambda one: one.losses[0])
            for one in shown:
                for held, good in ((one.proposals, best.proposals), (one.losses, best.losses)):
                    with contextlib.suppress(ValueError):
                        held.flags.writeable = True
                        held[:] = good.copy()


class Timing(Cheat):
    """Assumes that slower simulations are closer to the true parameters."""

    name = "timing"

    def tune(self, task, rng):
        times = []
        for _ in range(task.budget // 2):
            point = rng.uniform(size=task.dim)
            before = time.perf_counter()
            yield point
            times.append((time.perf_counter() - before, point.tolist()))
        while True:
            near = np.array(max(times)[1]) + 0.05 * rng.standard_normal(task.dim)
            yield np.clip(near, 0.0, 1.0)


class PatchedTuners(Cheat):
    """Patches other tuners to propose only zeros, and patches NumPy functions."""

    name = "patched-rivals"

    def find(self, task):
        def propose_zeros(self, task, rng):
            while True:
                yield np.zeros(task.dim)

        for module in [module for name, module in sys.modules.items() if name[:8] == "methods."]:
            for kind in list(vars(module).values()):
                if isinstance(kind, type) and issubclass(kind, Tuner) and kind is not RandomSearch:
                    kind.tune = propose_zeros
        np.random.Generator.__doc__ = "spoilt"
        with contextlib.suppress(TypeError):
            np.random.Generator.uniform = propose_zeros
        for name in ("argmin", "clip", "linalg"):
            setattr(np, name, propose_zeros)
        return []


class Network(Cheat):
    """Requests the true parameters from a server to which another process may have sent them.

    Args:
        address: path of a Unix socket.
        port: TCP port on this machine.
    """

    name = "network"

    def __init__(self, places=(), address="", port=0):
        super().__init__(places)
        self.address, self.port = address, port

    def find(self, task):
        import socket

        found = []
        ways = ((socket.AF_UNIX, self.address), (socket.AF_INET, ("127.0.0.1", self.port)))
        for family, where in ways:
            with contextlib.suppress(OSError), socket.socket(family) as link:
                link.settimeout(1.0)
                link.connect(where)
                link.sendall(task.start.tobytes())
                found.append(np.frombuffer(link.recv(1024), "<f8"))
        return found
