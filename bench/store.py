"""The folder of a comparison: exact configuration, versions and machine, a row a simulation, a status a run."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench import __version__
from bench.experiment import Experiment, parse
from sims.base import InputError
from sims.recording import read_toml

if TYPE_CHECKING:
    import pandas as pd

    from bench.runner import Results


def new_folder(experiment: Experiment, out: str | None, results: Path = Path("results")) -> Path:
    """Make the folder of a new run: `out`, or one below results/ named for the experiment and the time.

    Raises:
        InputError: `out` exists and has something in it, or cannot be made.
    """
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    folder = Path(out) if out else results / f"{experiment.name}-{stamp}"
    number = 1
    while not out and folder.exists():
        number += 1
        folder = results / f"{experiment.name}-{stamp}-{number}"
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"--out {folder}: exists and is not empty; results are never overwritten, name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be made ({error.strerror})") from None
    return folder


def write_configuration(folder: Path, experiment: Experiment, plugins: Sequence[str], jobs: int) -> None:
    """Write experiment.toml and environment.json."""
    import tomli_w

    text = tomli_w.dumps(_plain(experiment.document()))
    (folder / "experiment.toml").write_text(text, encoding="utf-8")
    environment = {
        "simgap": __version__,
        "experiment": experiment.name,
        "plugins": [str(Path(p).resolve()) for p in plugins],
        "jobs": jobs,
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "python": sys.version,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "packages": dict(sorted({d.metadata["Name"]: d.version for d in distributions()}.items())),
    }
    (folder / "environment.json").write_text(json.dumps(environment, indent=1) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """Tuples as lists, mappings as dictionaries: what TOML can hold."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value


def write_results(folder: Path, results: Results) -> None:
    """Write runs.parquet, status.csv and training.csv in the order of the plan."""
    import pandas as pd

    columns = [results.columns[i] for i in sorted(results.columns)]
    runs = pd.DataFrame({name: np.concatenate([c[name] for c in columns]) for name in (columns[0] if columns else ())})
    statuses = pd.DataFrame([asdict(results.statuses[i]) for i in sorted(results.statuses)] + _skipped(results))
    runs.to_parquet(folder / "runs.parquet", compression="zstd", index=False)
    statuses.to_csv(folder / "status.csv", index=False)
    trained = [(label, seed, t.simulations, t.seconds) for (label, seed), t in sorted(results.trainings.items())]
    training = pd.DataFrame(trained, columns=["tuner", "seed", "simulations", "seconds"])
    training.to_csv(folder / "training.csv", index=False)


def _skipped(results: Results) -> list[dict[str, Any]]:
    simulator = results.problem.experiment.simulator
    fixed = {"target": "", "seed": 0, "status": "skipped", "simulations": 0, "seconds": 0.0}
    return [
        {"run": label, "tuner": label, "simulator": simulator, **fixed, "reason": reason}
        for label, reason in results.skipped.items()
    ]


class Stored(NamedTuple):
    """A comparison read back: experiment, runs, statuses, and (simulations, seconds) of one training by tuner."""

    experiment: Experiment
    runs: pd.DataFrame
    statuses: pd.DataFrame
    costs: dict[str, tuple[float, float]]


def read(folder: Path) -> Stored:
    """Read the folder of a comparison.

    Raises:
        InputError: the folder lacks a file of a comparison, or one is damaged.
    """
    import pandas as pd

    configuration = folder / "experiment.toml"
    if not configuration.is_file():
        raise InputError(f"{folder}: expected the folder of a comparison with experiment.toml in it, found none")
    try:
        name = json.loads((folder / "environment.json").read_text(encoding="utf-8"))["experiment"]
        runs = pd.read_parquet(folder / "runs.parquet")
        statuses = pd.read_csv(folder / "status.csv", keep_default_na=False)
        training = pd.read_csv(folder / "training.csv")
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: not a complete comparison: {str(error).splitlines()[0]}") from None
    experiment = parse(str(name), read_toml(configuration), configuration)
    return Stored(experiment, runs, statuses, _costs(training))


def _costs(training: pd.DataFrame) -> dict[str, tuple[float, float]]:
    """Simulations and seconds of one training, the mean over seeds, by tuner."""
    means = training.groupby("tuner")[["simulations", "seconds"]].mean()
    values = means.to_numpy(dtype=np.float64)
    return {str(name): (float(row[0]), float(row[1])) for name, row in zip(means.index, values, strict=True)}
