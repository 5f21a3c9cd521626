"""Comparisons in which cheaters meet honest rivals, and what is left when they are over."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import tomli_w
from scipy.stats import mannwhitneyu

from bench.benchmark.storage.result_folder import read_comparison
from methods.tuner import Tuner
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import COMMAND

HERE = Path(__file__).parent
SALT = "a secret of the tests"
RIVALS = {"random": {"seeds": 12}, "nelder_mead": {}, "least_squares": {}}
"""Who plays by the rules; the first is the yardstick."""
MEASURED = ["tuner_seconds", "simulator_seconds"]
CHANCE = 1e-4
"""Probability below which nobody would call it chance, with fifty cheaters and fixed seeds."""
SMALL = {
    **{key: value for key, value in SPRING.items() if key != "salt"},
    "ranges": ["in"], "targets": 3, "seeds": 3, "budget": 12, "timeout": 3, "memory": 64,
    "identifiability": False,
}  # fmt: skip


def cheats(name):
    """The tuners of a plugin file, by name; its code runs here and now."""
    spec = importlib.util.spec_from_file_location(f"cheats_{name}", HERE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    own = [value for value in vars(module).values() if isinstance(value, type)]
    kinds = [kind for kind in own if issubclass(kind, Tuner) and kind.__module__ == module.__name__]
    return {kind.name: kind for kind in kinds}


def compared(folder, tuners, plugins=(), options=(), **changes):
    """A comparison in a process of its own, and what it wrote on stderr."""
    folder.mkdir(exist_ok=True)
    experiment = folder / "spring-test.toml"
    experiment.write_text(tomli_w.dumps({**SMALL, **changes, "tuners": tuners}))
    # Copies: some write to their own file.
    given = [PLUGINS / "spring.py", *(HERE / f"{name}.py" for name in plugins)]
    files = [shutil.copy(file, folder) for file in given]
    command = [*COMMAND, "compare", str(experiment)]
    command += ["--out", str(folder / "run"), "--allow-failures", *options]
    command += [word for file in files for word in ("--plugin", str(file))]
    # Where their processes are told to keep files, by which they are known.
    environment = {**os.environ, "TMPDIR": str(folder)}
    return subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, timeout=300
    )


def stored(folder):
    return read_comparison(folder / "run")


def rows(table, names):
    """Rows of runs, without what is measured."""
    kept = table[table["tuner"].isin(names)].reset_index(drop=True)
    return kept.drop(columns=MEASURED)


def errors(folder):
    """Mean error of the parameters over a run, for each run, by tuner."""
    runs = stored(folder).runs
    means = runs[runs["k"] > 0].groupby(["tuner", "run"], sort=True)["param_error"].mean()
    return {name: group.to_numpy() for name, group in means.groupby(level=0)}


def gains(folder, name):
    """Probability that random search comes out as well as a cheater, by chance."""
    found = errors(folder)
    return mannwhitneyu(found[name], found["random"], alternative="less").pvalue


def left(folder):
    """What outlives a comparison: processes that keep their files there, and these files."""
    processes = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("TMPDIR") == str(folder):
                processes.append(process)
        except (psutil.Error, OSError):
            continue
    files = [path for path in folder.iterdir() if path.name.startswith("simgap-")]
    writable = ("/tmp", "/var/tmp", "/dev/shm", HERE, sys.prefix, Path(np.__file__).parent)
    for place in map(Path, writable):
        files += [path for path in place.iterdir() if path.name.startswith("simgap-cheat-")]
    return [process.cmdline() for process in processes], files
