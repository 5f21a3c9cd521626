"""Runs a bounce-shot experiment: records drops, has every method plan, makes the shots, keeps what
is finished.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bench.problem.experiment import Experiment
from bench.runs.pools import Call, LocalPool
from bench.runs.runner import Progress, check
from bench.shot import tune
from bench.shot.deal import RECORDINGS, Deal, deals, in_view, record
from bench.shot.settings import Settings, settings_of
from bench.shot.throw import thrown
from bench.store.folder import Configuration, configuration, create, free_folder
from sims.base import InputError
from sims.camera import packages
from sims.files import write
from sims.shot import world

Say = Callable[[str], None]
SHOTS = "shots"


def begin(experiment: Experiment, plugins: Sequence[str], out: str | None, jobs: int) -> Path:
    """Check the experiment and make its folder.

    Raises:
        InputError: a fault in it, or the folder is not free.
    """
    from bench.runs.identity import fingerprint

    if settings_of(experiment).filmed:
        packages.require("; or set shot.filmed = 0")
    if experiment.simulator != "ball" or experiment.observe != ("z",):
        raise InputError(
            f'experiment {experiment.name}: a shot needs simulator = "ball" and observe = ["z"]'
        )
    folder = free_folder(experiment, Path(out) if out else None)
    create(folder, Configuration(experiment, list(plugins), fingerprint(experiment, plugins)), jobs)
    return folder


def is_shot(folder: Path) -> bool:
    """Whether a folder holds a bounce shot."""
    return bool(configuration(folder).experiment.shot)


def status(folder: Path, say: Say) -> bool:
    """Say how many shots a folder holds; returns whether that is all."""
    experiment = configuration(folder).experiment
    dealt = deals(experiment, settings_of(experiment))
    made = sum(_path(folder, one).exists() for one in dealt)
    complete = made == len(dealt)
    say(
        f"{experiment.name}: {made} of {len(dealt)} shots made" + (", complete" if complete else "")
    )
    if not complete:
        say(f"to finish it: simgap compare --resume {folder}")
    return complete


def make(folder: Path, plugins: Sequence[str], jobs: int, bar: Progress, say: Say) -> int:
    """Make what is missing in the folder, write table and figures; returns the exit code."""
    from bench.shot.report import finish

    experiment = configuration(folder).experiment
    if reason := world.missing():
        say(f"skipped: {reason}")
        return 0
    skipped = check(experiment)
    experiment = experiment.with_tuners(
        [e.label for e in experiment.tuners if e.label not in skipped]
    )
    settings = settings_of(experiment)
    missing = [one for one in deals(experiment, settings) if not _path(folder, one).exists()]
    if missing:
        _unchanged(folder, plugins)
    try:
        _shoot(folder, experiment, settings, missing, plugins, jobs, bar)
    except KeyboardInterrupt:  # the balls take turns, so what there is tells of all of them
        if any((folder / SHOTS).glob("*.json")):
            finish(folder, experiment, settings, skipped, say)
        say(f"simgap: interrupted; to finish: simgap compare --resume {folder}")
        return 130
    return finish(folder, experiment, settings, skipped, say)


def _unchanged(folder: Path, plugins: Sequence[str]) -> None:
    """Refuse to mix shots of two configurations."""
    from bench.runs.identity import fingerprint, refuse_changes

    held = configuration(folder)
    everything = held.plugins + sorted(
        {str(Path(p).resolve()) for p in plugins} - set(held.plugins)
    )
    refuse_changes(folder, held.fingerprint, fingerprint(held.experiment, everything))


def _shoot(
    folder: Path,
    experiment: Experiment,
    settings: Settings,
    missing: list[Deal],
    plugins: Sequence[str],
    jobs: int,
    bar: Progress,
) -> None:
    if not missing:
        return
    weights = _trained(experiment, settings, bar)
    for name in (SHOTS, RECORDINGS):
        (folder / name).mkdir(exist_ok=True)
    paths = [folder / RECORDINGS / f"{one.name}.csv" for one in missing]
    drops: list[Call] = [
        (record, (experiment, one, settings, path))
        for one, path in zip(missing, paths, strict=True)
    ]
    step = bar("dropping", len(missing))
    unseen: dict[int, BaseException] = {}
    with LocalPool(jobs) as pool:  # these workers know the balls, and tune nothing
        for place, fault in pool.results(drops, experiment.timeout):
            if isinstance(fault, BaseException):
                unseen[place] = fault
            step()
    seen = [place for place in range(len(missing)) if place not in unseen]
    known = {
        place: tune.Known(missing[place].name, paths[place], missing[place].scene, weights)
        for place in seen
    }
    step = bar("shooting", len(missing))
    for place, fault in unseen.items():
        status = "no recording" if isinstance(fault, InputError) else "crashed"
        _keep(folder, missing[place], settings, _failed(experiment, fault, status), 0.0)
        step()
    with LocalPool(jobs) as pool:
        pool.load(plugins)
        calls: list[Call] = [(tune.models, (experiment, settings, known[place])) for place in seen]
        for at, made in pool.results(calls, experiment.timeout):
            place = seen[at]
            models = _failed(experiment, made) if isinstance(made, BaseException) else made
            _keep(folder, missing[place], settings, models, in_view(paths[place], experiment))
            step()


def _keep(
    folder: Path, dealt: Deal, settings: Settings, models: list[dict[str, Any]], seen: float
) -> None:
    kept = {
        "models": models,
        "rows": [{**row, "seen": seen} for row in thrown(dealt, settings, models)],
    }
    write(_path(folder, dealt), json.dumps(_plain(kept), indent=1, allow_nan=False) + "\n")


def _trained(experiment: Experiment, settings: Settings, bar: Progress) -> dict[str, Path]:
    from bench.registry import tuners
    from bench.runs.training import train

    learned = [entry for entry in experiment.tuners if tuners.get(entry.tuner).learned]
    step = bar("training", len(learned))
    weights = {}
    for entry in learned:
        weights[entry.label] = train(tune.tuned_in(experiment, settings, entry), entry, 0).path
        step()
    return weights


def _failed(
    experiment: Experiment, error: BaseException, status: str = "crashed"
) -> list[dict[str, Any]]:
    """The models of a shot whose drop could not be recorded, or whose worker died or took too long:
    none has a plan.
    """
    if isinstance(error, TimeoutError):
        status = "timeout"
    nothing = partial(
        tune.Model, effects={}, simulations=0, seconds=math.nan, status=status, reason=str(error)
    )
    labels = [e.label for e in experiment.tuners]
    methods = [tune.NOMINAL, *labels, tune.EXPLAINED, *(label + tune.AFTER for label in labels)]
    return [vars(nothing(method=method, restitution=math.nan)) for method in methods]


def read(folder: Path, dealt: Deal) -> dict[str, Any] | None:
    """What is kept of a shot; None where it has not been made."""
    path = _path(folder, dealt)
    if not path.exists():
        return None
    try:
        kept: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for model in kept["models"]:
            model.update(
                {
                    k: math.nan
                    for k in ("height", "margin", "restitution", "seconds")
                    if model[k] is None
                }
            )
        return kept
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: damaged; delete it and finish with --resume {folder}") from None


def _path(folder: Path, dealt: Deal) -> Path:
    return folder / SHOTS / f"{dealt.name}.json"


def _plain(value: Any) -> Any:
    """What JSON can hold: numbers that are none become null."""
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
