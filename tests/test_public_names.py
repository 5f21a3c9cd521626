"""Tests of the public names of `import simgap`, its import time, and packages hidden by
user files.
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import simgap

ROOT = Path(simgap.__file__).parent


def python(code, cwd, **environment):
    """Run code in a new interpreter that imports simgap from the same folder as this one."""
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        capture_output=True,
        text=True,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), **environment},
        check=False,
    )


def test_every_name_exists_with_the_type_of_its_stub():
    tree = ast.parse((ROOT / "simgap.pyi").read_text())
    imports = [n for n in tree.body if isinstance(n, ast.ImportFrom)]
    told = {alias.name: n.module for n in imports for alias in n.names}
    del told["Sequence"]
    assert told == simgap._MODULE_OF
    assert sorted([*told, "main"]) == simgap.__all__ == dir(simgap)
    for name in simgap.__all__:
        assert getattr(simgap, name) is not None, name
    (public,) = (ast.literal_eval(n.value) for n in tree.body if isinstance(n, ast.Assign))
    assert public == simgap.__all__
    with pytest.raises(AttributeError, match="module 'simgap' has no attribute 'tune'"):
        _ = simgap.tune


def test_the_import_takes_less_than_five_milliseconds_and_brings_nothing_heavy(tmp_path):
    code = (
        "import sys, time; t = time.perf_counter(); import simgap; t = time.perf_counter() - t\n"
        "print(1e3 * t, *(m for m in ('numpy', 'bench', 'torch', 'matplotlib') if m in "
        "sys.modules))"
    )
    answers = [python(code, tmp_path).stdout.split() for _ in range(5)]
    assert all(len(answer) == 1 for answer in answers), answers
    assert min(float(milliseconds) for (milliseconds,) in answers) < 5


@pytest.mark.parametrize("name", ["bench", "methods", "sims"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_hides_a_package_is_named_in_one_line(name, kind, tmp_path):
    place = tmp_path / (f"{name}.py" if kind == "file" else name)
    if kind == "folder":
        place.mkdir()
    (place if kind == "file" else place / "__init__.py").write_text("")
    wanted = (
        f"simgap cannot be imported here: the {kind} {place.resolve()} hides simgap's own package "
        f"'{name}'; rename that {kind}, or move your script out of its folder"
    )
    said = python("import simgap", tmp_path)
    assert said.returncode == 1
    assert said.stderr.strip().splitlines()[-1] == f"ImportError: {wanted}"
    # If the file is imported before simgap, the conflict is reported too.
    path = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import {name}; import simgap"
    assert python(path, "/").stderr.strip().splitlines()[-1] == f"ImportError: {wanted}"
    # `python -m simgap` in that folder prints one line and exits with the code of an input error.
    said = python("import runpy; runpy.run_module('simgap', run_name='__main__')", tmp_path)
    assert (said.returncode, said.stderr) == (2, f"simgap: error: {wanted}\n")


def test_a_script_next_to_a_file_that_hides_a_package_is_refused(tmp_path):
    """Python searches the folder of the script first, not the working directory."""
    (tmp_path / "sims.py").write_text("")
    (tmp_path / "mine.py").write_text("import simgap")
    script = f"import runpy, sys; sys.path[0] = {str(tmp_path)!r}; runpy.run_path('mine.py')"
    said = python(script, tmp_path)
    assert str(tmp_path.resolve() / "sims.py") in said.stderr.strip().splitlines()[-1]


def test_a_folder_of_that_name_without_a_package_in_it_does_no_harm(tmp_path):
    (tmp_path / "methods").mkdir()
    assert python("import simgap; simgap.Tuner", tmp_path).returncode == 0


def test_what_is_installed_exposes_neither_tests_nor_examples(tmp_path):
    """An editable install exposes only the packages of the wheel."""
    if not (Path(sys.prefix) / "bin" / "simgap").exists():
        pytest.skip("simgap is not installed in this environment")
    code = (
        "import importlib.util, simgap\n"
        "found = [importlib.util.find_spec(name) for name in ('tests', 'examples')]\n"
        "print([spec.origin for spec in found if spec])\n"
    )
    said = python(code, tmp_path, PYTHONPATH="")
    assert said.returncode == 0, said.stderr
    assert str(ROOT) not in said.stdout


def test_main_is_the_command_line(capsys):
    with pytest.raises(SystemExit):
        simgap.main(["--version"])
    assert capsys.readouterr().out == f"simgap {simgap.__version__}\n"


def test_a_renamed_name_still_works_and_warns():
    with pytest.warns(DeprecationWarning, match="use simgap.Proposal"):
        assert simgap.Ask is simgap.Proposal
    for old, new in simgap._RENAMED.items():
        assert new in simgap.__all__
        assert old not in simgap.__all__
