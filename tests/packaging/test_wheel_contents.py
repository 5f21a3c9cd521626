"""Tests that the wheel contains everything an installation needs and works outside the checkout.

CI has no time to install the wheel with all its dependencies; `make wheel` does that.
"""

import json
import shutil
import site
import subprocess
import zipfile

import pytest

from tests.packaging.wheel_in_environment import (
    PACKAGES,
    build,
    environment,
    find_wheel_errors,
    run_simgap,
)

EXTRA_TUNERS = {
    *("npe", "turbo", "snpe", "mujoco_sysid"),
    *("nevergrad_ngopt", "optuna_cma", "optuna_tpe", "pso"),
}
"""Tuners whose packages are extras, which CI does not install."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build(tmp_path_factory.mktemp("wheel"))


def test_the_wheel_contains_exactly_the_package_files(wheel):
    assert find_wheel_errors(wheel) == []
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
    assert {
        "bench/schemas/verdict.schema.json",
        "bench/experiments/ball-drop.toml",
        "bench/experiments/arm2.xml",
        "bench/diagnosis/report/report.css",
        "bench/reference/ball-drop/table.csv",
        *(f"{package}/py.typed" for package in PACKAGES),
    } <= names
    assert not [name for name in names if name.startswith(("tests/", "examples/", "results/"))]


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("bench/schemas/error.schema.json", "missing: bench/schemas/error.schema.json"),
        ("bench/reference/ball-drop/table.csv", "missing: bench/reference/ball-drop/table.csv"),
        ("dist-info/licenses/LICENSE", "no licence"),
        (None, "nobody asked for: tests/conftest.py"),
    ],
)
def test_a_wheel_that_lacks_a_file_or_has_one_too_many_is_found(wheel, tmp_path, lost, message):
    other = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as whole, zipfile.ZipFile(other, "w", zipfile.ZIP_DEFLATED) as less:
        for name in whole.namelist():
            if lost is None or not name.endswith(lost):
                less.writestr(name, whole.read(name))
        if lost is None:
            less.writestr("tests/conftest.py", "")
    assert find_wheel_errors(other) == [message]


@pytest.mark.slow
def test_the_wheel_works_outside_the_checkout(wheel, tmp_path):
    python = environment(tmp_path / "env")
    (packages,) = (tmp_path / "env" / "lib").glob("python3*/site-packages")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(packages)
    # Dependencies come from the packages of this environment, which are searched last.
    (packages / "others.pth").write_text("\n".join(site.getsitepackages()) + "\n")

    def simgap(*arguments):
        return run_simgap(python, tmp_path, *arguments).stdout

    assert simgap("--version") == "simgap 0.1.0\n"
    found = json.loads(simgap("list", "--json"))
    assert {each["name"] for each in found["references"]} >= {"ball-drop", "comparison/ball-wind"}
    skipped = {each["name"] for each in found["tuners"] if each["skipped"]}
    assert skipped <= EXTRA_TUNERS, "only tuners whose packages are extras are skipped"
    assert str(tmp_path) in json.loads(simgap("info", "--json"))["paths"]["simgap"]


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash")
def test_bash_completes_commands_options_names_and_files(tmp_path):
    from bench.cli.commands.completion import build_completion_script
    from bench.cli.main import build_parser

    (tmp_path / "simgap.bash").write_text(build_completion_script(build_parser(), "bash"))
    (tmp_path / "swing.csv").write_text("")

    def completed(*words):
        script = f"""
source simgap.bash
COMP_WORDS=(simgap {" ".join(f"'{word}'" for word in words)})
COMP_CWORD={len(words)}
COMP_LINE="simgap {" ".join(words)}"
COMP_POINT=${{#COMP_LINE}}
_shtab_simgap
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
        done = subprocess.run(
            ["bash", "--norc", "-c", script],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr == ""
        return set(done.stdout.split())

    assert completed("ex") == {"explain"}
    assert {"--targets", "--tuners", "--timeout", "--training-budget", "--trust"} == completed(
        "compare", "--t"
    )
    assert {"ball-drop", "ball-drop-video", "ball-drop-published"} <= completed("compare", "ball")
    assert completed("list", "ef") == {"effects"}
    assert completed("schema", "verd") == {"verdict"}
    assert "swing.csv" in completed("explain", "sw")
    assert completed("check", "drag.q") == {"drag.quadratic"}
