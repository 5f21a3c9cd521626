"""Tests of compiling, caching and loading machine code, and of the checks on its arrays."""

import importlib
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.engines.compiled import (
    code_cache,
    data_layout,
    expression_graph,
    interpreter,
    kernel,
    kernel_build,
    llvm_code,
)

ROOT = Path(__file__).resolve().parents[2]


def nobody():
    raise AssertionError("nobody waits")


def test_all_that_the_code_is_made_of_is_in_its_name():
    sources = {str(path) for path in kernel.list_source_files()}
    assert all(Path(path).is_file() for path in sources)
    for module in (*kernel_build.KERNEL_MODULES, kernel_build):
        assert module.__file__ in sources
        for thing in vars(module).values():
            of = getattr(thing, "__module__", None) or getattr(thing, "__name__", "")
            if str(of).startswith("sims."):
                assert importlib.import_module(of).__file__ in sources, (module, of)


def test_it_is_kept_whole_or_made_anew(tmp_path):
    path = tmp_path / "deep" / "code.bin"
    assert code_cache.read_cached(path) is None
    assert code_cache.make_cached(path, lambda: b"code", nobody) == b"code"
    assert code_cache.make_cached(path, nobody, nobody) == b"code"
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert code_cache.read_cached(path) is None
    assert code_cache.make_cached(path, lambda: b"anew", nobody) == b"anew"


def test_an_interrupted_making_leaves_nothing(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    path = tmp_path / "code.bin"
    with pytest.raises(KeyboardInterrupt):
        code_cache.make_cached(path, interrupted, nobody)
    assert [p.name for p in tmp_path.iterdir()] == ["code.lock"]


def test_a_killed_making_holds_nobody_up_and_one_makes_while_the_others_wait(tmp_path):
    code = (
        "import os, sys, time; from pathlib import Path; "
        "from sims.engines.compiled import code_cache\n"
        "path = Path(sys.argv[1])\n"
        "def make():\n"
        "    path.with_name('at-it').touch()\n"
        "    time.sleep(float(sys.argv[2]))\n"
        "    return str(os.getpid()).encode()\n"
        "print(code_cache.make_cached(path, make, lambda: print('waits')).decode())\n"
    )

    def begun(seconds):
        command = [sys.executable, "-c", code, tmp_path / "code.bin", str(seconds)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        while not (tmp_path / "at-it").exists():
            assert process.poll() is None
        return process

    killed = begun(60.0)
    killed.send_signal(signal.SIGKILL)
    killed.wait(timeout=10)
    killed.stdout.close()
    (tmp_path / "at-it").unlink()
    first = begun(0.5)
    second = begun(60.0)
    assert first.communicate(timeout=20)[0].split() == [str(first.pid)]
    assert second.communicate(timeout=20)[0].split()[-1] == str(first.pid)


load_kernel = kernel._load_kernel.__wrapped__


def test_compiled_code_is_loaded_without_numba(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "numba", None)
    assert load_kernel() is not None


def test_a_compiler_that_fails_is_reported_in_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("SIMGAP_COMPILED", str(tmp_path))
    monkeypatch.setattr(kernel_build, "_START", "raise ImportError('Numba needs an older NumPy')")
    with pytest.raises(InputError, match="Numba needs an older NumPy; expected working versions"):
        load_kernel()
    assert "once after an install" in capsys.readouterr().err


def test_code_that_cannot_be_stored_is_compiled_again(monkeypatch, tmp_path, capsys):
    path = code_cache.get_cache_folder() / f"stepping-{kernel._key()}.bin"
    code = code_cache.read_cached(path)
    (tmp_path / "file").touch()
    monkeypatch.setenv("SIMGAP_COMPILED", str(tmp_path / "file"))
    monkeypatch.setattr(kernel_build, "build_kernel", lambda _: code)
    assert load_kernel() is not None
    assert "set SIMGAP_COMPILED to a folder that can be written" in capsys.readouterr().err


def test_code_that_calls_what_is_not_there_is_not_loaded():
    path = code_cache.get_cache_folder() / f"stepping-{kernel._key()}.bin"
    code = llvm_code.MachineCode.unpack(code_cache.read_cached(path))
    assert llvm_code.MachineCode.unpack(code.pack()) == code
    with pytest.raises(llvm_code.CodeNotLoadableError, match="frobnicate"):
        llvm_code.load_machine_code(code._replace(needs=(*code.needs, "frobnicate")))


def test_stepping_imports_no_translator():
    code = (
        "import sys; from sims.engines.compiled import kernel; assert kernel.get_kernel();"
        "sys.exit('numba' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def small():
    """Return the arrays of an empty program for two elements."""
    program = data_layout.ProgramArrays(
        code=np.zeros((0, 5), dtype=np.int64),
        ends=np.zeros(4, dtype=np.int64),
        rows=np.array([0, 1, 2, 3, 3, 4, 5, 6, -1, 4, 5]),
        out=np.array([2]),
        flags=np.array([1, 0, 0, 0, 1]),
    )
    work = data_layout.BatchArrays(
        order=np.array([1, 0]), parameters=np.ones((2, 1)), mass=np.ones(2), x=np.ones((2, 1)),
        v=np.ones((2, 1)), steps=np.ones((1, 4)), inputs=np.zeros((0, 1, 4)), max_steps=np.ones(2),
        planned_counts=np.ones(2), ground=np.zeros((4, 2)), steps_per_record=2, patience=np.inf,
        records=np.zeros((2, 3, 3)),
    )  # fmt: skip
    return program, work, data_layout.allocate_block(7), 8, np.ones(2), np.ones(2)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("order", np.array([1, 2])),
        ("order", np.array([1, -1])),
        ("order", np.zeros(0, dtype=np.int64)),
        ("parameters", np.ones((2, 2))),
        ("steps", np.ones((3, 4))),
        ("inputs", np.zeros((1, 1, 4))),
        ("records", np.zeros((2, 2, 3))),
        ("mass", np.ones(2, dtype=np.float32)),
        ("x", np.ones((4, 1))[::2]),
        ("v", np.ones((2, 2))),
    ],
)
def test_arrays_of_other_shapes_never_reach_the_machine(name, value):
    program, work, block, w, spans, parts = small()
    data_layout.check_array_layout(program, work, block, w, spans, parts)
    with pytest.raises(ValueError, match=r"expected \(|does not match the arrays"):
        data_layout.check_array_layout(
            program, work._replace(**{name: value}), block, w, spans, parts
        )
    with pytest.raises(ValueError, match="does not match the arrays"):
        data_layout.check_array_layout(program, work, block, 0, spans, parts)
    far = program._replace(code=np.array([[interpreter.ADD, 7, 0, 0, 0]]))
    with pytest.raises(ValueError, match="does not match the arrays"):
        data_layout.check_array_layout(far, work, block, w, spans, parts)


def test_instructions_run_on_registers_of_any_width_and_are_looked_at_before():
    run_by = kernel.get_kernel()
    ops = {name: code for code, name in enumerate(expression_graph.OPERATIONS)}
    code = np.array([[ops["add"], 2, 0, 1, 0], [ops["tanh"], 3, 2, 2, 2]], dtype=np.int64)
    for lanes in (1, 5, 64, 130):
        r = np.zeros((4, lanes))
        run = run_by.make_instruction_runner(code, 0, 2, r)
        for seed in range(2):
            r[:2] = np.random.default_rng(seed).normal(size=(2, lanes))
            run()
            np.testing.assert_allclose(r[3], np.tanh(r[0] + r[1]), rtol=1e-14)
    held = np.zeros((4, 8))
    run_by.make_instruction_runner(code, 1, 1, held)()
    assert not held.any(), "of no instruction nothing comes"
    wrong = code.copy()
    wrong[1, 1] = 4
    for bad in (
        lambda: run_by.make_instruction_runner(wrong, 0, 2, held),
        lambda: run_by.make_instruction_runner(code, 0, 3, held),
        lambda: run_by.make_instruction_runner(code, 0, 2, held[:, ::2]),
        lambda: run_by.make_instruction_runner(code.astype(np.int32), 0, 2, held),
    ):
        with pytest.raises(ValueError, match="not for these registers"):
            bad()
