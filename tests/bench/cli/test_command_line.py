import json
import os
import resource
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pandas as pd
import pytest
import tomli_w

from bench.benchmark.statistics.error_curves import ERROR_TABLE_COLUMNS
from bench.cli.main import main
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import COMMAND

SPRING_PLUGIN = str(PLUGINS / "spring.py")
PLUGIN_TUNER = """from methods.tuner import Tuner


class Corners(Tuner):
    def tune(self, task, rng):
        while True:
            yield rng.integers(0, 2, size=(1, task.dim))
"""


@pytest.fixture
def experiment(tmp_path):
    document = {**SPRING, "tuners": {"random": {}, "least_squares": {}}, "title": "Spring <b>"}
    path = tmp_path / "spring-test.toml"
    path.write_text(tomli_w.dumps(document))
    return path


def simgap(*arguments, cwd=None):
    command = [sys.executable, "-m", "bench.cli.main", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, timeout=300, check=False
    )


def test_a_command_ends_without_a_search_for_unused_objects():
    code = (
        "import atexit, gc, sys; from bench.cli.main import main; "
        "atexit.register(lambda: print('frozen', gc.get_freeze_count())); "
        "sys.argv = ['simgap', 'completion', 'bash']; main()"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert int(result.stdout.splitlines()[-1].removeprefix("frozen ")) > 1000


def test_help_is_quick_and_imports_nothing_heavy():
    code = "import bench.cli.main; bench.cli.main.main(['--help'])"
    command = [sys.executable, "-c", code]
    seconds = []
    for _ in range(3):  # processor time, because wall time depends on the load of the machine
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(seconds) <= 0.3
    traced = subprocess.run(
        [*command[:1], "-X", "importtime", *command[1:]], capture_output=True, text=True, check=True
    )
    imported = {line.split("|")[-1].strip().split(".")[0] for line in traced.stderr.splitlines()}
    assert "argparse" in imported
    assert not imported & {
        "numpy",
        "pandas",
        "torch",
        "pybullet",
        "matplotlib",
        "skopt",
        "scipy",
        "cma",
        "nlopt",
    }


def test_version():
    assert run_command("--version").out == "simgap 0.1.0\n"


@pytest.mark.slow
def test_compare_writes_the_folder_it_promises_and_a_plugin_tuner_is_in_it(experiment, tmp_path):
    plugin = tmp_path / "corners.py"
    plugin.write_text(PLUGIN_TUNER)
    assert len(PLUGIN_TUNER.strip().splitlines()) - 2 <= 6, "a new tuner takes at most six lines"
    done = simgap(
        "compare", experiment, "--tuners", "random,nelder_mead,corners", "--plugin", SPRING_PLUGIN,
        "--plugin", plugin,
        "--targets", 3, "--seeds", 2, "--budget", 6, "--jobs", 2, "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "out"
    lines = pd.read_csv(folder / "table.csv")
    assert list(lines.columns) == [*ERROR_TABLE_COLUMNS, "salt", "trusted"]
    assert set(lines["tuner"]) == {"random", "nelder_mead", "corners"}
    assert set(lines["simulations"]) == {0, 1, 2, 3, 5, 6}
    assert set(lines["metric"]) == {"param_error", "stiff_error", "sloppy_error", "obs_error"}
    corners = lines[(lines["tuner"] == "corners") & (lines["metric"] == "param_error")]
    assert set(corners["runs"]) == {6}
    runs = pd.read_parquet(folder / "runs.parquet")
    assert set(runs.columns) >= {
        "run", "experiment", "tuner", "simulator", "target", "seed", "range", "k", "loss",
        "param_error", "obs_error",
        "heldout_error", "stiff_error", "sloppy_error", "tuner_seconds", "simulator_seconds",
        "outside",
        "proposal_rate", "recommendation_rate",
    }  # fmt: skip
    assert len(runs) == 2 * 3 * (2 + 1 + 2) * 7, "nelder_mead uses no chance: one seed"
    statuses = pd.read_csv(folder / "status.csv")
    assert list(statuses.columns) == [
        "run", "tuner", "simulator", "target", "seed", "status", "reason", "simulations", "seconds",
        "trusted",
    ]  # fmt: skip
    environment = json.loads((folder / "environment.json").read_text())
    assert environment["packages"]["numpy"]
    assert environment["plugins"] == [SPRING_PLUGIN, str(plugin)]
    for name in ("error-vs-simulations", "error-vs-distance"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 20_000
        assert not (folder / "figures" / f"{name}.pdf").exists()
    assert "nelder_mead" in done.stdout
    assert str(folder / "table.csv") in done.stdout

    table, figure = (
        (folder / "table.csv").read_bytes(),
        folder / "figures" / "error-vs-simulations.png",
    )
    (folder / "table.csv").unlink()
    figure.unlink()
    again = simgap("plot", folder, "--plugin", SPRING_PLUGIN, "--pdf")
    assert again.returncode == 0, again.stderr
    for name in ("error-vs-simulations", "error-vs-distance"):
        assert (folder / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    assert (folder / "table.csv").read_bytes() == table
    assert figure.exists()

    refused = simgap("compare", experiment, "--plugin", SPRING_PLUGIN, "--out", folder)
    assert refused.returncode == 2
    assert "never overwritten" in refused.stderr
    assert (folder / "table.csv").read_bytes() == table


@pytest.mark.slow
def test_interrupt_ends_cleanly_and_keeps_what_is_finished(experiment, tmp_path):
    arguments = [
        "compare",
        experiment,
        "--plugin",
        SPRING_PLUGIN,
        "--tuners",
        "random",
        "--targets",
        4000,
    ]
    command = [*COMMAND, *map(str, arguments), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60
    # Wait until some runs are stored, so that all workers have started, however long that took.
    journals = tmp_path / "out" / "segments"
    while time.monotonic() < deadline:
        if sum(path.stat().st_size for path in journals.glob("*.journal")) > 20_000:
            break
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: signal the parent and the workers
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "runs are finished and stored" in errors
    statuses = pd.read_csv(tmp_path / "out" / "status.csv")
    runs = pd.read_parquet(tmp_path / "out" / "runs.parquet")
    assert 0 < len(statuses) < 16000
    assert set(statuses["run"]) == set(runs["run"])
    assert set(statuses["status"]) == {"done"}
    assert (tmp_path / "out" / "table.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["compare", "bal-drop"],
            "unknown experiment 'bal-drop'; did you mean ball-drop",
        ),
        (["compare", "none.toml"], "none.toml: no such file"),
        (
            ["compare", "ball-drop", "--tuners", "cma"],
            "unknown tuner 'cma'; did you mean cma_es?",
        ),
        (["compare", "ball-drop", "--plugin", "none.py"], "none.py: no such file"),
        (["compare"], "expected an experiment (see `simgap list experiments`), or --resume DIR"),
        (["compare", "--resume", "nowhere"], "nowhere: expected the folder of a comparison"),
        (["compare", "ball-drop", "--resume", "x"], "leave out experiment"),
        (["status", "nowhere"], "nowhere: expected the folder of a comparison"),
        (["plot", "nowhere"], "nowhere: expected the folder of a comparison"),
    ],
)
def test_unknown_names_are_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    captured = run_command(*arguments, code=2)
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"


@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "ball-drop", "--budget", "0"],
        ["compare", "ball-drop", "--jobs", "two"],
        ["compare", "ball-drop", "--targets", "-3"],
        ["compare", "ball-drop", "--timeout", "nan"],
        ["list", "engines"],
        ["frobnicate"],
    ],
)
def test_bad_values_exit_with_2(arguments):
    assert "Traceback" not in run_command(*arguments, code=2).err


def test_faults_inside_an_experiment_show_before_any_work(experiment, tmp_path):
    text = experiment.read_text()
    for change, message in [
        (text.replace('"spring"', '"sprig"'), "unknown simulator 'sprig'"),
        (text.replace("[tuners.random]", "[tuners.random.options]\nwide = 3"), "tuner random: "),
        (text.replace('observe = [\n    "x",\n]', 'observe = ["y"]'), "unknown channel"),
        (text + "\n[constants]\ngravity = 3.0\n", "unknown constant"),
        (text + "\n[settings]\nstep = 3.0\n", "unexpected keyword argument 'step'"),
    ]:
        assert change != text
        path = tmp_path / "changed.toml"
        path.write_text(change)
        captured = run_command(
            "compare", path, "--plugin", SPRING_PLUGIN, "--out", tmp_path / "out", code=2
        ).err
        assert message in captured
        assert captured.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_list_shows_tags_of_experiments():
    lines = {line.split()[0]: line for line in run_command("list", "experiments").out.splitlines()}
    assert lines["ball-drop-video"].endswith(" [published, video]")
    assert lines["pendulum-real"].endswith(" [several-parameters, real]")


def test_list_says_what_each_thing_is():
    for what, expected in [
        ("tuners", ["cma_es", "tunenet", "least_squares"]),
        ("simulators", ["ball", "pendulum"]),
        ("experiments", ["ball-drop", "pendulum-real"]),
    ]:
        lines = run_command("list", what).out.splitlines()
        names = [line.split()[0] for line in lines]
        assert set(expected) <= set(names)
        assert all(len(line.split()) > 3 for line in lines)
        assert {line.split()[0] for line in lines if "skipped" in line} <= {
            *("npe", "turbo", "snpe", "mujoco_sysid"),
            *("nevergrad_ngopt", "optuna_cma", "optuna_tpe", "pso"),
        }, "their packages are extras"


def test_experiments_need_no_install_location(tmp_path):
    done = simgap("list", "experiments", cwd=tmp_path)
    assert done.returncode == 0
    assert "ball-drop" in done.stdout


FAILING = """from methods.tuner import Tuner


class Failing(Tuner):
    def tune(self, task, rng):
        yield task.start[None]
        raise RuntimeError("no more")
"""


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_terminal_says_who_is_best_and_marks_a_tuner_whose_runs_all_failed(
    tmp_path, capsys, spring
):
    experiment, plugin = tmp_path / "spring-test.toml", tmp_path / "failing.py"
    experiment.write_text(tomli_w.dumps({**SPRING, "noise": {"x": 1e-4}}))
    plugin.write_text(FAILING)
    tuners = ["--tuners", "failing,random,least_squares", "--targets", "7", "--seeds", "1"]
    options = ["--plugin", SPRING_PLUGIN, "--plugin", str(plugin), "--jobs", "0"]
    code = main(
        ["compare", str(experiment), *tuners, *options, "--budget", "12", "--allow-failures",
         "--out", str(tmp_path / "out")]
    )  # fmt: skip
    assert code == 0
    said = capsys.readouterr().out
    first = said.split("\n\n")[0].strip().splitlines()
    assert first[0].startswith("best tuners, targets in the training range, 7 targets (")
    assert "errors below 0.001 count as equal" in first[0]
    after = {line.split()[1]: line for line in first if line.startswith("  after")}
    assert list(after) == ["1", "3", "10", "12"]
    assert after["12"].split("best: ")[1].startswith("least_squares (")
    assert any(line.strip().startswith("worse: random") for line in first)
    assert sum("all runs failed: failing" in line for line in first) == 4
    assert "failed runs, which count as infinite errors: failing 7 of 7" in first
    assert "Holm-corrected for 1 comparison." in first[-1]
    tables = [part.splitlines() for part in said.split("\n\n") if part.startswith("median abs")]
    for lines in tables:
        names = [line.split("  ")[0] for line in lines[2:]]
        assert names[0].startswith("least_squares")
        assert names[-1].startswith("failing [all runs failed]")
    assert len(tables) == 2


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glfw asks on Linux")
def test_a_command_names_the_library_that_glfw_would_choose(monkeypatch):
    """Without this variable, each import of MuJoCo starts an interpreter to query a version."""
    pytest.importorskip("glfw")
    for name in ("PYGLFW_LIBRARY", "PYGLFW_LIBRARY_VARIANT", "XDG_SESSION_TYPE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "argv", ["simgap", "list"])
    main()
    named = os.environ.pop("PYGLFW_LIBRARY")
    assert named == str(Path(find_spec("glfw").origin).parent / "x11" / "libglfw.so")
    monkeypatch.setenv("PYGLFW_LIBRARY", "mine.so")
    main()
    assert os.environ["PYGLFW_LIBRARY"] == "mine.so"


def test_listed_help_texts_have_no_format_characters():
    commands = json.loads(run_command("list", "commands", "--json").out)
    explain = next(each for each in commands["commands"] if each["name"] == "explain")
    ranges = next(each for each in explain["options"] if each["name"] == "ranges")
    assert "the 95 % intervals" in ranges["says"]
