"""The face: what `import simgap` offers, how quickly, and whose folder hides it."""

import ast
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

import simgap

ROOT = Path(simgap.__file__).parent


def python(code, cwd, **environment):
    """Run code in a fresh interpreter that finds simgap where this one does."""
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        capture_output=True,
        text=True,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), **environment},
        check=False,
    )


def test_every_name_is_there_and_means_what_type_checkers_are_told():
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
def test_a_folder_that_hides_a_package_is_named_in_one_line(name, tmp_path):
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("")
    said = python("import simgap", tmp_path)
    assert said.returncode == 1
    last = said.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: simgap cannot be imported here: the package '{name}' in")
    assert str(tmp_path.resolve() / name) in last
    # Imported before simgap, it hides the other way round.
    path = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import {name}; import simgap"
    assert str(tmp_path.resolve() / name) in python(path, "/").stderr


def test_a_folder_of_that_name_without_a_package_in_it_does_no_harm(tmp_path):
    (tmp_path / "methods").mkdir()
    assert python("import simgap; simgap.Tuner", tmp_path).returncode == 0


def test_what_is_installed_exposes_neither_tests_nor_examples(tmp_path):
    """An editable install offers what the wheel holds."""
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


@pytest.mark.slow
def test_the_wheel_is_typed_for_who_installs_it(tmp_path):
    """Of everything under the one name, in a user's strict checking."""
    built = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = ZipFile(wheel).namelist()
    typed = {f"{package}/py.typed" for package in ("bench", "methods", "sims")}
    assert {"simgap.py", "simgap-stubs/__init__.pyi", *typed} <= set(names)
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == {"bench", "methods", "sims", "simgap.py", "simgap-stubs"}


def test_main_is_the_command_line(capsys):
    with pytest.raises(SystemExit):
        simgap.main(["--version"])
    assert capsys.readouterr().out == f"simgap {simgap.__version__}\n"
