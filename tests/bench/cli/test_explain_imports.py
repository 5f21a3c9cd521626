"""Tests of the imports of `simgap explain`: a simple system loads only what it needs."""

import json
import subprocess
import sys

import pytest

from tests.simulation_arguments import simulation_spec, write

HEAVY = {
    "IPython",
    "av",
    "cv2",
    "distributed",
    "jsonschema",
    "mujoco",
    "nlopt",
    "pandas",
    "pint",
    "pyarrow",
    "pybullet",
    "scipy",
    "skopt",
    "sklearn",
    "statsmodels",
    "torch",
}
"""Packages whose import takes about as long as a small diagnosis, or longer."""
ROBOTS = {"sims.robot.robot_model", "sims.robot.robot_simulator", "sims.robot.model_field_effects"}
"""Modules that are needed only for a model file."""
BACKENDS = {
    "matplotlib.pyplot",
    "matplotlib.backends.backend_pdf",
    "matplotlib.backends.backend_svg",
}
"""Modules of Matplotlib that are needed only for vector graphics and notebooks."""
RUN = """
import json, sys
import bench.cli.main
code = bench.cli.main.main(sys.argv[1:])
print(json.dumps(sorted(sys.modules)), file=sys.stderr)
sys.exit(code)
"""


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    path = tmp_path_factory.mktemp("swing") / "swing.csv"
    spec = simulation_spec(
        "pendulum",
        runs=3,
        seconds=2.0,
        effects=["drag.linear=2e-4"],
        noise=["q=0.01", "qd=0.05"],
        engine="batch",
    )
    write(spec, path)
    return path


def loaded(*arguments):
    """Run the command in its own process and return the modules that are loaded at its end."""
    command = [sys.executable, "-c", RUN, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stderr.splitlines()[-1]))


def test_explain_loads_no_package_that_it_does_not_need(swing, tmp_path):
    modules = loaded("explain", swing, "--jobs", 1, "--out", tmp_path / "out")
    assert "matplotlib.backends.backend_agg" in modules, "the figures are drawn"
    assert modules & (HEAVY | BACKENDS | ROBOTS) == set()
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {
        ".csv", ".html", ".json", ".png", ".toml",
    }  # fmt: skip


def test_explain_of_a_robot_loads_mujoco_but_no_other_large_package(arm_log, tmp_path):
    modules = loaded("explain", arm_log, "--jobs", 1, "--out", tmp_path / "out")
    assert modules >= ROBOTS
    assert modules & (HEAVY | BACKENDS) == {"mujoco"}


@pytest.mark.slow
def test_with_pdf_it_writes_vector_graphics_and_the_same_verdict(swing, tmp_path):
    plain = tmp_path / "plain"
    loaded("explain", swing, "--jobs", 1, "--out", plain)
    modules = loaded("explain", swing, "--jobs", 1, "--pdf", "--out", tmp_path / "out")
    assert modules >= BACKENDS - {"matplotlib.pyplot"}
    pictures = {path.stem: path for path in (tmp_path / "out").glob("*.pdf")}
    assert set(pictures) == {path.stem for path in plain.glob("*.png")}
    assert all(path.read_bytes().startswith(b"%PDF") for path in pictures.values())
    for name in ("verdict.json", "apart.csv"):
        texts = [(folder / name).read_text().splitlines() for folder in (plain, tmp_path / "out")]
        first, second = ([line for line in text if '"seconds"' not in line] for text in texts)
        assert first == second
