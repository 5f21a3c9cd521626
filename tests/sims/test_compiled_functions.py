"""Tests of compiling, caching and loading machine code, and of the checks on its arrays."""

import inspect
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.diagnosis.kalman import kalman_recursions
from sims.core.simulator import InputError
from sims.engines.compiled import (
    data_layout,
    element_stepping,
    interpreter,
    machine_code,
    machine_code_cache,
    numba_compilation,
    register_programs,
    traced_array,
)
from sims.robot.dynamics import mujoco_callback

ROOT = Path(__file__).resolve().parents[2]


def fail_if_called():
    raise AssertionError("another process was waited for or the content was made")


@pytest.mark.parametrize(
    ("module", "entry"),
    [
        (element_stepping, element_stepping.COMPILED.make_entry()),
        (mujoco_callback, mujoco_callback.add_effect_forces),
        (kalman_recursions, kalman_recursions.COMPILED.make_entry()),
    ],
)
def test_the_cache_name_depends_on_every_compiled_source_file(module, entry):
    sources = {str(path) for path in machine_code_cache.list_source_files(module.__name__)}
    assert module.__file__ in sources
    assert all(Path(path).is_file() for path in sources)
    called = numba_compilation.list_called_functions(entry)
    assert called
    for function in called:
        for thing in (function, *function.__globals__.values()):
            module_of_thing = inspect.getmodule(thing)
            if (
                module is not kalman_recursions
                and module_of_thing is not None
                and module_of_thing.__name__.startswith("sims.engines")
            ):
                assert module_of_thing.__file__ in sources, (function, module_of_thing)
        assert inspect.getsourcefile(function) in sources


def test_a_damaged_cache_file_is_made_again(tmp_path):
    path = tmp_path / "deep" / "code.bin"
    assert machine_code_cache.read_cached(path) is None
    assert machine_code_cache.make_cached(path, lambda: b"code", fail_if_called) == b"code"
    assert machine_code_cache.make_cached(path, fail_if_called, fail_if_called) == b"code"
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert machine_code_cache.read_cached(path) is None
    assert machine_code_cache.make_cached(path, lambda: b"anew", fail_if_called) == b"anew"


def test_an_interrupted_compilation_leaves_no_file(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    path = tmp_path / "code.bin"
    with pytest.raises(KeyboardInterrupt):
        machine_code_cache.make_cached(path, interrupted, fail_if_called)
    assert [p.name for p in tmp_path.iterdir()] == ["code.lock"]


def test_one_process_compiles_while_others_wait_and_a_killed_one_blocks_none(tmp_path):
    code = (
        "import os, sys, time; from pathlib import Path; "
        "from sims.engines.compiled import machine_code_cache\n"
        "path = Path(sys.argv[1])\n"
        "def make():\n"
        "    path.with_name('at-it').touch()\n"
        "    time.sleep(float(sys.argv[2]))\n"
        "    return str(os.getpid()).encode()\n"
        "print(machine_code_cache.make_cached(path, make, lambda: print('waits')).decode())\n"
    )

    def start_process(seconds):
        command = [sys.executable, "-c", code, tmp_path / "code.bin", str(seconds)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        while not (tmp_path / "at-it").exists():
            assert process.poll() is None
        return process

    killed = start_process(60.0)
    killed.send_signal(signal.SIGKILL)
    killed.wait(timeout=10)
    killed.stdout.close()
    (tmp_path / "at-it").unlink()
    first = start_process(0.5)
    second = start_process(60.0)
    assert first.communicate(timeout=20)[0].split() == [str(first.pid)]
    assert second.communicate(timeout=20)[0].split()[-1] == str(first.pid)


def load_kernel():
    return machine_code_cache.load_stored(
        element_stepping.__name__, "COMPILED", "the batch engine", 1, {}
    )


def get_kernel_path():
    name = machine_code_cache.make_cache_name(element_stepping.__name__, {})
    return machine_code_cache.get_cache_folder() / name


def test_a_compiler_that_fails_is_reported_in_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("SIMGAP_COMPILED", str(tmp_path))
    monkeypatch.setattr(
        numba_compilation, "_START", "raise ImportError('Numba needs an older NumPy')"
    )
    with pytest.raises(InputError, match="Numba needs an older NumPy; expected working versions"):
        load_kernel()
    assert "once after an install" in capsys.readouterr().err


def test_code_that_cannot_be_stored_is_compiled_again(monkeypatch, tmp_path, capsys):
    path = machine_code_cache.get_cache_folder() / machine_code_cache.make_cache_name(
        element_stepping.__name__, {}
    )
    code = machine_code_cache.read_cached(path)
    (tmp_path / "file").touch()
    monkeypatch.setenv("SIMGAP_COMPILED", str(tmp_path / "file"))
    monkeypatch.setattr(numba_compilation, "build_module", lambda *_: code)
    assert load_kernel() is not None
    assert "set SIMGAP_COMPILED to a folder that can be written" in capsys.readouterr().err


def test_code_with_a_missing_symbol_is_not_loaded():
    path = machine_code_cache.get_cache_folder() / machine_code_cache.make_cache_name(
        element_stepping.__name__, {}
    )
    code = machine_code.MachineCode.unpack(machine_code_cache.read_cached(path))
    assert machine_code.MachineCode.unpack(code.pack()) == code
    with pytest.raises(machine_code.CodeNotLoadableError, match="frobnicate"):
        machine_code.load_machine_code(code._replace(needs=(*code.needs, "frobnicate")))


def test_loading_the_kernel_does_not_import_numba():
    code = (
        "import sys; from sims.engines.compiled.element_stepping import COMPILED;"
        "assert COMPILED.load();"
        "sys.exit('numba' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def make_small_arrays():
    """Return the arrays of an empty program for two elements."""
    program = data_layout.ProgramArrays(
        code=np.zeros((0, 5), dtype=np.int64),
        ends=np.zeros(4, dtype=np.int64),
        rows=np.array([0, 1, 2, 3, 3, 4, 5, 6, -1, 4, 5]),
        out=np.array([2]),
        flags=np.array([1, 0, 0, 0, 1, 0]),
    )
    work = data_layout.BatchArrays(
        order=np.array([1, 0]), parameters=np.ones((2, 1)),
        mass=np.ones(2), x=np.ones((2, 1)), v=np.ones((2, 1)), steps=np.ones((1, 4)),
        inputs=np.zeros((0, 1, 4)), max_steps=np.ones(2), planned_counts=np.ones(2),
        divisions=np.ones(2), ground=np.zeros((4, 2)), limits=np.array([np.inf, 0.07]),
        records=np.zeros((2, 3, 3)), steps_per_record=2,
    )  # fmt: skip
    return program, work, data_layout.allocate_block(np.zeros((7, 32))), 8


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
        ("divisions", np.ones(3)),
        ("limits", np.ones(1)),
    ],
)
def test_arrays_of_wrong_shape_are_refused(name, value):
    program, work, block, w = make_small_arrays()
    check_arrays(program, work, block, w)
    with pytest.raises(ValueError, match=r"expected a contiguous|does not match the arrays"):
        check_arrays(program, work._replace(**{name: value}), block, w)
    with pytest.raises(ValueError, match="does not match the arrays"):
        check_arrays(program, work, block, 0)
    far = program._replace(code=np.array([[interpreter.ADD, 7, 0, 0, 0]]))
    with pytest.raises(ValueError, match="does not match the arrays"):
        check_arrays(far, work, block, w)


def check_arrays(program, arrays, buffers, w):
    block = data_layout.Block(*program, *arrays[:-1], *buffers, arrays.steps_per_record, w)
    data_layout.check_block(block)


def test_instructions_are_checked_and_run_on_any_number_of_slots():
    ops = {name: code for code, name in enumerate(traced_array.OPERATIONS)}
    code = np.array([[ops["add"], 2, 0, 1, 0], [ops["tanh"], 3, 2, 2, 2]], dtype=np.int64)
    for size in (1, 5, 64, 130):
        r = np.zeros((4, size))
        run = register_programs.make_instruction_runner(code, 0, 2, r)
        for seed in range(2):
            r[:2] = np.random.default_rng(seed).normal(size=(2, size))
            run()
            np.testing.assert_allclose(r[3], np.tanh(r[0] + r[1]), rtol=1e-14)
    held = np.zeros((4, 8))
    register_programs.make_instruction_runner(code, 1, 1, held)()
    assert not held.any(), "an empty program wrote to registers"
    wrong = code.copy()
    wrong[1, 1] = 4
    for bad in (
        lambda: register_programs.make_instruction_runner(wrong, 0, 2, held),
        lambda: register_programs.make_instruction_runner(code, 0, 3, held),
        lambda: register_programs.make_instruction_runner(code, 0, 2, held[:, ::2]),
        lambda: register_programs.make_instruction_runner(code.astype(np.int32), 0, 2, held),
    ):
        with pytest.raises(
            ValueError, match=r"not for these registers|expected a contiguous array"
        ):
            bad()
