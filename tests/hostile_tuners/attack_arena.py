"""Run comparisons of attacking and honest tuners, and find what remains afterwards."""

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
HONEST_TUNERS = {"random": {"seeds": 12}, "nelder_mead": {}, "least_squares": {}}
"""Honest tuners; the first one is the reference."""
MEASURED = ["tuner_seconds", "simulator_seconds"]
MAX_P_VALUE = 1e-4
"""P-value limit for a gain; small enough for fifty attackers and fixed seeds."""
SMALL = {
    **{key: value for key, value in SPRING.items() if key != "salt"},
    "ranges": ["in"], "targets": 3, "seeds": 3, "budget": 12, "timeout": 3, "memory": 64,
    "identifiability": False,
}  # fmt: skip


def cheats(name):
    """Return the tuners of a plugin file by name; the file is executed in this process."""
    spec = importlib.util.spec_from_file_location(f"cheats_{name}", HERE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    own = [value for value in vars(module).values() if isinstance(value, type)]
    kinds = [kind for kind in own if issubclass(kind, Tuner) and kind.__module__ == module.__name__]
    return {kind.name: kind for kind in kinds}


def compared(folder, tuners, plugins=(), options=(), **changes):
    """Run a comparison in a separate process."""
    folder.mkdir(exist_ok=True)
    experiment = folder / "spring-test.toml"
    experiment.write_text(tomli_w.dumps({**SMALL, **changes, "tuners": tuners}))
    # Copies, because some plugins write to their own file.
    given = [PLUGINS / "spring.py", *(HERE / f"{name}.py" for name in plugins)]
    files = [shutil.copy(file, folder) for file in given]
    command = [*COMMAND, "compare", str(experiment)]
    command += ["--out", str(folder / "run"), "--allow-failures", *options]
    command += [word for file in files for word in ("--plugin", str(file))]
    # Processes of this comparison are recognised by this temporary folder.
    environment = {**os.environ, "TMPDIR": str(folder)}
    return subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, timeout=300
    )


def stored(folder):
    return read_comparison(folder / "run")


def rows(table, names):
    """Return the rows of runs without measured times."""
    kept = table[table["tuner"].isin(names)].reset_index(drop=True)
    return kept.drop(columns=MEASURED)


def errors(folder):
    """Return the mean parameter error of each run, by tuner."""
    runs = stored(folder).runs
    means = runs[runs["k"] > 0].groupby(["tuner", "run"], sort=True)["param_error"].mean()
    return {name: group.to_numpy() for name, group in means.groupby(level=0)}


def gains(folder, name):
    """Return the p-value that an attacker has smaller errors than random search (Mann-Whitney U
    test).
    """
    found = errors(folder)
    return mannwhitneyu(found[name], found["random"], alternative="less").pvalue


def left(folder):
    """Return the processes and files that remain after a comparison."""
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
