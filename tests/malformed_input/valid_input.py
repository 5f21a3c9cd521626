"""Build valid inputs, from which malformed ones are made."""

from __future__ import annotations

import math
import os
import tempfile
from functools import cache
from pathlib import Path
from unittest.mock import patch

import tomli_w

from bench.api.recordings import simulate
from bench.benchmark.comparison_study import Comparison
from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.runner.experiment_runner import run_experiment
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.benchmark.runner.study_base import prepare_study
from bench.cli.main import main
from bench.core.plugin_registries import REGISTRIES
from bench.logs.film_rendering import write_film as film
from tests.bench.logs.log_writers import write_folder
from tests.conftest import PLUGINS

LEARNER = Path(__file__).with_name("learner.py")
SPRING = PLUGINS / "spring.py"
SWING = {
    "title": "a swing",
    "simulator": "pendulum",
    "observe": ["q"],
    "targets": 1,
    "seeds": 1,
    "budget": 2,
    "training_budget": 5,
    "timeout": 60,
    "salt": "public",
    "sampling": {"rate": 20.0, "samples": 30},
    "initial": {"q": [0.8, 1.2]},
    "noise": {"q": 0.01},
    "tuners": {"random": {"seeds": 1}, "cma": {"tuner": "cma_es", "options": {"sigma": 0.2}}},
}
MORE = (
    "memory", "settings", "world", "constants", "recording", "ranges", "held_out", "parameters",
    "inputs", "sweep", "shot", "tags", "says", "same_targets_as", "isolation", "trusted",
    "salt_sha256", "identifiability", "error_channel", "bounds", "effects", "oops",
)  # fmt: skip
"""Optional keys of an experiment, and an unknown one."""
SECRET = {key: value for key, value in SWING.items() if key != "salt"}
WORLDLY = {
    **SECRET,
    "settings": {"engine": "batch"},
    "world": {"time_step": 0.001},
    "held_out": {"scenarios": 2},
    "constants": {"gravity": 9.8},
    "ranges": ["in", "wide"],
    "tags": ["x"],
    "sweep": {"budget": [2, 3]},
}
LEARNED = {**SWING, "tuners": {"learner": {"seeds": 1}}}


def toml(document) -> bytes:
    return tomli_w.dumps(document).encode()


@cache
def recorded(system: str) -> dict[str, bytes]:
    """Simulate a short recording of a system and return its table and description."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.csv"
        initial = {"ball": {"z": 1.0}, "pendulum": {"q": (0.8, 1.2)}}[system]
        channels = {"ball": ["z"], "pendulum": ["q", "qd"]}[system]
        simulate(
            system, observe=channels, runs=2, seconds=1.0, rate=20.0, initial=initial,
            noise={channels[0]: 0.01},
        ).write(path)  # fmt: skip
        return {"data.csv": path.read_bytes(), "data.toml": path.with_suffix(".toml").read_bytes()}


MODEL = {
    "name": "pendulum_extended",
    "system": "pendulum",
    "engine": "batch",
    "title": "a pendulum with drag",
    "observe": ["q"],
    "constants": {"gravity": 9.81},
    "parameters": {},
    "effects": {"drag.linear": {"coefficient": {"value": 0.001, "unit": "N m s/rad"}}},
}


@cache
def model() -> dict:
    """Return a model file of a pendulum that `simgap explain` wrote."""
    import tomllib

    from sims.systems.pendulum import Pendulum

    reference = Path(__file__).parents[2] / "results/reference/real/pendulum_free_swing/recording"
    held = tomllib.loads((reference / "extended.toml").read_text(encoding="utf-8"))
    assert held["system"] == Pendulum.name
    return held


def bases(folder: Path) -> dict[str, Path]:
    """Prepare folders by name: results, trained weights and a film.

    The results are a complete comparison, one with a public salt, and one without its report.
    """
    made = {}
    known = [registry.snapshot() for registry in REGISTRIES]
    with patch.dict(os.environ, {"SIMGAP_CACHE": str(folder / "cache")}):
        experiments = {
            "done": {**SECRET, "tuners": {"random": {}, "learner": {}}},
            "public": SWING,
            "half": SECRET,
        }
        for name, document in experiments.items():
            path = folder / f"swing-{name}.toml"
            path.write_bytes(toml(document))
            experiment = load_experiment(str(path)).chosen(trusted=True)
            plugins = [str(LEARNER)] if name == "done" else []
            load_plugins_for_experiment(plugins, experiment)
            made[name] = folder / name
            comparison = Comparison.begin(prepare_study(experiment, plugins, made[name], jobs=0))
            if name == "half":
                run_experiment(comparison.results, plugins, 0)
                comparison.results.run_sink.close()
            else:
                comparison.run(jobs=0)
                with patch("bench.benchmark.comparison_report._render_figures", return_value={}):
                    comparison.report(lambda _: None)
    path = folder / "learned.toml"
    path.write_bytes(toml(LEARNED))
    made["weights"] = folder / "weights"
    with patch.dict(os.environ, {"SIMGAP_CACHE": str(made["weights"])}):
        assert main(trains(str(path), str(folder / "losses"))) == 0
    made["film"] = folder / "film"
    made["film"].mkdir()
    drop = simulate("ball", observe=["z"], runs=1, seconds=0.8, rate=50.0, initial={"z": 2.0})
    drop.write(folder / "drop.csv")
    film(folder / "drop.csv", made["film"] / "drop.mp4", None, 64, 0)
    for registry, snapshot in zip(REGISTRIES, known, strict=True):
        registry.restore(snapshot)
    return made


def trains(experiment: str, out: str) -> list[str]:
    """Return the command that trains the plugin's tuner."""
    plugin = ["--plugin", str(LEARNER), "--trust", "--out", out]
    return ["train", "learner", "pendulum", "--experiment", experiment, *plugin]


ARM = b"""<mujoco model="arm"><compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="hip" axis="0 1 0" range="-2 2"/><geom size="0.1" pos="0 0 -0.3"/>
<body pos="0 0 -0.6"><joint name="knee" axis="0 1 0" range="-2 2"/>
<geom size="0.1" pos="0 0 -0.3"/></body></body></worldbody>
<actuator><position name="m_hip" joint="hip" kp="100" kv="10"/>
<position name="m_knee" joint="knee" kp="100" kv="10"/></actuator></mujoco>"""
MAPPED = {
    "model": "arm.xml", "free": ["damping@*"],
    "time": {"column": "stamp", "unit": "ms", "offset": 0.01},
    "channels": {"q.hip": {"file": "log.csv", "column": "position[0]", "unit": "deg"},
                 "q.knee": {"file": "log.csv", "column": "position[1]", "unit": "deg"}},
    "inputs": {"u.m_hip": {"file": "log.csv", "column": "command_hip", "unit": "deg",
                           "hold": "linear"}},
    "runs": {"1": {"held_out": False}},
}  # fmt: skip
"""Description of `MAPPED_LOG`."""


MAPPED_LOG = "\n".join(
    [
        "stamp,position,command_hip,command_knee,note",
        *(
            f'{20 * k},"[{60 * math.sin(0.06 * k):.4f}, {30 * math.cos(0.04 * k):.4f}]",'
            f"{60 * math.sin(0.06 * k + 0.1):.4f},{30 * math.cos(0.04 * k + 0.1):.4f},ok"
            for k in range(60)
        ),
    ]
).encode()


@cache
def log_folder(kind: str) -> dict[str, bytes]:
    """Return the files of two short runs in a log format, and the model file of the arm."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_folder(folder, kind, runs=2, count=40)
        files = [path for path in folder.rglob("*") if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(files)}
