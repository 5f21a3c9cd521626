"""Tests of the access of a tuner process, made from inside the process."""

import fcntl
import os

import pytest

from tests.bench.isolation.isolated_process import PROBE, held, need, run_isolated

LIBC = "import ctypes, os\nlibc = ctypes.CDLL(None, use_errno=True)\n"
CALL = LIBC + "result = libc.{}\n(result, ctypes.get_errno())"
"""Code that calls a C library function and gives its result and errno."""
NOT_PERMITTED, ABSENT = "(-1, 1)", "(-1, 38)"


@pytest.mark.parametrize("mode", ["r", "r+", "a", "w"])
def test_no_file_outside_is_opened(tmp_path, mode):
    need("files")
    path = tmp_path / "secret"
    path.write_text("0.25")
    code = f"open({str(path)!r}, {mode!r}).read()"
    assert run_isolated(code).startswith(("PermissionError", "OSError: [Errno 30]"))
    assert path.read_text() == "0.25"


@pytest.mark.parametrize("mode", ["r", "r+"])
def test_a_file_that_is_given_is_read_and_not_written(mode, tmp_path):
    need("files")
    path = tmp_path / "given"
    path.write_text("0.25")
    said = run_isolated(f"open({str(path)!r}, {mode!r}).read()", [path])
    assert said == "'0.25'" if mode == "r" else said.startswith(("Permission", "OSError"))


@pytest.mark.parametrize("what", ["listdir", "scandir"])
@pytest.mark.parametrize("place", ["/", "/tmp", "~", "given"])
def test_no_folder_outside_is_listed(what, place, tmp_path):
    need("files")
    folder = tmp_path if place == "given" else os.path.expanduser(place)
    assert run_isolated(f"import os\nos.{what}({str(folder)!r})").startswith("PermissionError")


def test_it_has_an_empty_folder_that_it_fills_no_further_than_allowed():
    need("disk")
    assert run_isolated("import os\nos.listdir()") == "[]"
    assert run_isolated("open('x', 'w').write('abc')") == "3"
    full = "for i in range(20):\n    open(str(i), 'wb').write(bytes(8 << 20))\nNone"
    assert run_isolated(full).startswith("OSError: [Errno 28]")
    assert run_isolated("import os\nos.listdir()") == "[]", "and the next one has another"


def test_reading_a_file_leaves_no_trace(tmp_path):
    need("disk")
    path = tmp_path / "given"
    path.write_text("0.25")
    os.utime(path, (1e9, 1e9))
    assert run_isolated(f"open({str(path)!r}).read()", [path]) == "'0.25'"
    assert os.stat(path).st_atime == 1e9


@pytest.mark.parametrize(
    "code", ["chmod(PATH, 0)", "utime(PATH)", "setxattr(PATH, 'user.x', b'x')", "truncate(PATH, 0)"]
)
def test_it_changes_nothing_about_a_file_that_it_reads(tmp_path, code):
    need("calls")
    path = tmp_path / "given"
    path.write_text("0.25")
    before = os.stat(path)
    assert run_isolated(f"import os\nPATH = {str(path)!r}\nos.{code}", [path]).startswith(
        "PermissionError"
    )
    assert os.stat(path) == before


def test_its_locks_lock_nothing(tmp_path):
    need("calls")
    path = tmp_path / "given"
    path.write_text("0.25")
    lock = f"import fcntl\nfile = open({str(path)!r})\nfcntl.flock(file, fcntl.LOCK_EX)"
    with path.open("r+") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert run_isolated(lock, [path]) == "None", (
            "it neither waits nor hears of who has locked it"
        )


@pytest.mark.parametrize(
    ("call", "error"),
    [
        ("fork()", NOT_PERMITTED),
        ("vfork()", NOT_PERMITTED),
        ("execv(b'/bin/true', None)", NOT_PERMITTED),
        ("ptrace(16, os.getppid(), None, None)", NOT_PERMITTED),
        ("unshare(0x10000000)", NOT_PERMITTED),
        ("mount(b'proc', b'/proc', b'proc', 0, None)", NOT_PERMITTED),
        ("umount2(b'/proc', 2)", NOT_PERMITTED),
        ("kill(2, 9)", NOT_PERMITTED),
        ("kill(0, 9)", NOT_PERMITTED),
        ("kill(-1, 9)", NOT_PERMITTED),
        ("prctl(1, 0, 0, 0, 0)", NOT_PERMITTED),
        ("setpriority(1, 0, 19)", NOT_PERMITTED),
        ("shmget(1, 4096, 0o1600)", NOT_PERMITTED),
        ("syscall(240 if os.uname().machine == 'x86_64' else 180, b'x', 66, 384, 0)", "(-1, 1)"),
        ("inotify_init()", NOT_PERMITTED),
        ("syscall(425, 8, bytes(120))", ABSENT),
        ("syscall(435, bytes(88), 88)", ABSENT),
        ("socket(1, 1, 0)", NOT_PERMITTED),
        ("socket(2, 1, 0)", NOT_PERMITTED),
        ("socketpair(1, 2, 0, ctypes.create_string_buffer(8))", NOT_PERMITTED),
        ("setuid(12345)", None),
        ("chroot(b'.')", None),
        ("sethostname(b'x', 1)", None),
    ],
)
def test_what_it_may_not_ask_of_the_kernel(call, error):
    need("calls")
    said = run_isolated(CALL.format(call))
    assert said == error if error else said.startswith("(-1, ")


@pytest.mark.parametrize(
    ("code", "result"),
    [
        ("import threading\nt = threading.Thread(target=int)\nt.start()\nt.join()", "None"),
        ("import os, signal\nsignal.signal(10, lambda *_: None)\nos.kill(os.getpid(), 10)", "None"),
        ("import socket\na, b = socket.socketpair()\na.send(b'x')\nb.recv(1)", "b'x'"),
        ("import resource\nresource.setrlimit(resource.RLIMIT_CPU, (99, 99))", "None"),
        ("import sqlite3\nc = sqlite3.connect('x')\nlist(c.execute('create table a (b)'))", "[]"),
        ("import tempfile\nf = tempfile.TemporaryFile()\nf.write(b'abc')", "3"),
        ("import mmap\nlen(mmap.mmap(-1, 4096))", "4096"),
        ("import asyncio\nasyncio.run(asyncio.sleep(0, 7))", "7"),
        ("from concurrent import futures\nlist(futures.ThreadPoolExecutor().map(abs, [1]))", "[1]"),
        ("open('/dev/null', 'w').write('abc')", "3"),
    ],
)  # fmt: skip
def test_what_an_honest_tuner_does_goes_on_working(code, result):
    assert run_isolated(code) == result


def test_it_sees_no_other_process():
    need("processes")
    listed = "import os\n(os.getpid(), [p for p in os.listdir('/proc/self/task')])"
    assert run_isolated(listed) == "(1, ['1'])"
    assert run_isolated("import os\nos.getppid()") == "0"


def test_it_has_no_additional_rights():
    assert "CapEff:\\t0000000000000000\\n" in run_isolated("open('/proc/self/status').read()")
    assert "NoNewPrivs:\\t1\\n" in run_isolated("open('/proc/self/status').read()")


def test_nothing_is_open_but_its_pipes():
    said = run_isolated("import os\nsorted(int(n) for n in os.listdir('/proc/self/fd'))")
    assert set(eval(said)) - {3} == {0, 1, 2, 100, 101}


def test_its_environment_tells_of_nothing_but_the_machine(monkeypatch):
    from bench.benchmark.runner import tuner_process_start

    tuner_process_start.close_isolated_processes()
    monkeypatch.setenv("SECRET_TRUTH", "0.25")
    monkeypatch.setenv("SIMGAP_DATA", "/data")
    names = set(eval(run_isolated("import os\nsorted(os.environ)")))
    tuner_process_start.close_isolated_processes()
    known = {"PATH", "LANG", "LC_ALL", "LC_CTYPE", "LD_LIBRARY_PATH", "HOME", "TMPDIR"}
    # SIMGAP_COMPILED is the folder of compiled integration steps.
    known |= {"CUDA_VISIBLE_DEVICES", "PYTHONDONTWRITEBYTECODE", "SIMGAP_COMPILED"}
    others = names - known
    assert all(name.startswith(("OPENBLAS_", "MKL_", "OMP_", "NPY_")) for name in others), others
    assert names >= {"HOME", "TMPDIR", "OMP_NUM_THREADS"}


def test_short_of_memory_it_ends_before_the_harness():
    assert run_isolated("open('/proc/self/oom_score_adj').read()") == "'1000\\n'"


@pytest.mark.parametrize(
    "code",
    [
        "import numpy as np\nnp.ones(1 << 24).sum()",
        "import mmap\nmmap.mmap(-1, 1 << 27)",
        "import os\nos.memfd_create('x')",
        "bytearray(1 << 27)[0]",
    ],
)
def test_its_memory_is_counted_whatever_it_is_of(code):
    need("calls")
    said = run_isolated(code, memory=64)
    assert "Error" in said
    assert "Error" not in run_isolated(code)


def test_the_active_isolation_layers_are_listed_in_order():
    from bench.benchmark.isolation.isolation_layers import ISOLATION_LAYERS

    seals = held()
    assert seals[0] == "process"
    assert seals == [name for name in ISOLATION_LAYERS if name in seals]


def test_its_own_file_is_read():
    assert run_isolated(f"len(open({PROBE!r}).read()) > 0") == "True"
