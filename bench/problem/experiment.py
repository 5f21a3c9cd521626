"""An experiment as a data file: which tuners, on which simulator and targets, with what budget.

The file's keys are the fields of `Experiment`; everything else is derived. `Experiment.document`
gives the exact configuration back, defaults filled in and command-line changes applied, and is what
a run stores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

from bench.problem.reading import checked, pair, table_of
from sims.base import InputError, unknown
from sims.recording.recording import read_toml

RANGES = ("in", "wide", "real")


@dataclass(frozen=True)
class Entry:
    """One tuner of a comparison: its registered name, options, and seeds or budget where they
    differ.
    """

    label: str
    tuner: str
    options: Mapping[str, Any] = field(default_factory=dict)
    seeds: int | None = None
    budget: int | None = None


@dataclass(frozen=True)
class Sampling:
    """Sample times of a simulated target: `samples` of them at `rate` Hz, from zero."""

    rate: float = 100.0
    samples: int = 400


@dataclass(frozen=True)
class HeldOut:
    """Unseen scenarios of a simulated target; initial states and inputs are the experiment's where
    not given.
    """

    scenarios: int = 3
    initial: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Source:
    """The recording that an experiment on real data tunes to; `path` is relative to the folder of
    recordings.
    """

    path: str = ""


@dataclass(frozen=True)
class Experiment:
    """One comparison.

    Attributes:
        name: file name without its ending.
        title: heading of figures.
        says: a sentence on what it is.
        simulator: registered name.
        observe: channels the tuner sees; all where empty.
        error_channel: the channel in which `obs_error` and `heldout_error` are reported; the first
            where empty.
        ranges: in, wide (simulated targets), or real (a recording).
        targets: number of targets in each range; for a recording, number of starting points.
        seeds: runs of each stochastic tuner on each target, and trainings of each learned one.
        budget: simulations on one target.
        same_targets_as: another experiment whose targets are met; its own where empty.
        training_budget: simulations that a learned tuner may train with.
        timeout: seconds a run may take.
        memory: MiB that a run may take beside what its worker holds; 0 is no limit.
        noise: standard deviation of the sensor noise added to simulated targets, by channel.
        settings: the simulator's own settings, e.g. its time step.
        world: settings of the simulator that makes the targets, where it is another: another
            engine, effects with fixed coefficients. Empty: the same simulator. Its parameters are
            the first of the tuned ones.
        constants: constants other than the simulator's defaults: a number, or [low, high] for
            uniform between in each scenario, known to whoever simulates it.
        parameters: changes to parameters' nominal, bounds, training range.
        initial: initial state: a number, or [low, high] for uniform between.
        inputs: input signals by name, as `simgap simulate` writes them, e.g. ``sine:2:0.5``
            (`bench.problem.signals`).
        sampling: sample times of simulated targets.
        held_out: unseen scenarios on which the tuned simulator's prediction is measured; for
            simulated targets.
        identifiability: whether to find what the data of each simulated target identify, where
            there are several parameters (`bench.problem.identifiability`): two simulations a
            parameter and target, beside all budgets.
        recording: the measured data, for range real.
        shot: where the experiment is a bounce shot, its scene (`bench.shot.settings`); targets are
            then shots a ball.
        tuners: the entries.
    """

    name: str
    title: str = ""
    says: str = ""
    simulator: str = ""
    observe: tuple[str, ...] = ()
    error_channel: str = ""
    ranges: tuple[str, ...] = ("in", "wide")
    targets: int = 20
    seeds: int = 1
    budget: int = 100
    same_targets_as: str = ""
    training_budget: int = 1600
    timeout: float = 3600.0
    memory: int = 0
    noise: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    world: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    initial: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    sampling: Sampling = field(default_factory=Sampling)
    held_out: HeldOut | None = None
    identifiability: bool = True
    recording: Source | None = None
    shot: Mapping[str, Any] = field(default_factory=dict)
    tuners: tuple[Entry, ...] = ()

    def __post_init__(self) -> None:
        for what in ("targets", "seeds", "budget"):
            if getattr(self, what) < 1:
                raise InputError(
                    f"experiment {self.name}: {what} must be at least 1, found {getattr(self, what)}"
                )
        if self.memory < 0 or not self.timeout > 0:
            raise InputError(f"experiment {self.name}: expected timeout > 0 and memory >= 0")
        for name in self.ranges:
            if name not in RANGES:
                raise unknown("range", name, RANGES)
        if ("real" in self.ranges) != (self.recording is not None) or (
            self.recording and len(self.ranges) != 1
        ):
            raise InputError(
                f"experiment {self.name}: range 'real' and a [recording] go together, and alone"
            )
        if self.held_out and (self.recording or self.held_out.scenarios < 1):
            raise InputError(
                f"experiment {self.name}: [held_out] needs simulated targets and scenarios of at least 1"
            )

    def document(self) -> dict[str, Any]:
        """The whole configuration as TOML tables; `parse` of it gives an equal experiment."""
        document = {
            k: v for k, v in asdict(self).items() if k not in ("name", "tuners") and v is not None
        }
        document["tuners"] = {e.label: _without_none(e) for e in self.tuners}
        return document

    @property
    def fixed(self) -> dict[str, float]:
        """The constants that are the same in every scenario."""
        return {
            name: value for name, value in self.constants.items() if not isinstance(value, tuple)
        }

    def chosen(self, **changes: Any) -> Experiment:
        """This experiment with the given fields replaced where they are not None."""
        return replace(self, **{k: v for k, v in changes.items() if v is not None})

    def with_seeds(self, seeds: int) -> Experiment:
        """The same number of seeds for every tuner whose entry does not ask for fewer."""
        entries = tuple(
            replace(e, seeds=min(e.seeds, seeds) if e.seeds else None) for e in self.tuners
        )
        return replace(self, seeds=seeds, tuners=entries)

    def with_tuners(self, labels: Sequence[str]) -> Experiment:
        """Only the tuners of these labels, in this order; a registered name that has no entry gets
        one.
        """
        entries = {entry.label: entry for entry in self.tuners}
        return replace(
            self, tuners=tuple(entries.get(label, Entry(label, label)) for label in labels)
        )


def _without_none(entry: Entry) -> dict[str, Any]:
    return {k: v for k, v in asdict(entry).items() if v is not None and k != "label"}


def names() -> list[str]:
    """The experiments that come with the project."""
    return sorted(
        f.name[:-5]
        for f in resources.files("bench.experiments").iterdir()
        if f.name.endswith(".toml")
    )


def load(name_or_path: str) -> Experiment:
    """An experiment of the project by name, or a user's by the path of its TOML file.

    Raises:
        InputError: no such experiment, or a fault in its file, in one line.
    """
    if name_or_path in names():
        path = Path(str(resources.files("bench.experiments").joinpath(f"{name_or_path}.toml")))
    elif name_or_path.endswith(".toml"):
        path = Path(name_or_path)
    else:
        raise InputError(
            f"{unknown('experiment', name_or_path, names())} (or give the path of a .toml file)"
        )
    return parse(path.stem, read_toml(path), path)


def parse(name: str, document: Mapping[str, Any], path: Path) -> Experiment:
    """Check the tables of an experiment file.

    Raises:
        InputError: an unknown key or a value of another type, naming file and key.
    """
    values = dict(document)
    entries = checked(path, "tuners", values.pop("tuners", {}), dict)
    fields = {k: _field(path, k, v) for k, v in values.items()}
    if not fields.get("simulator"):
        raise InputError(f'{path}: expected simulator = "NAME", found none')
    tuners = tuple(_entry(path, label, table) for label, table in entries.items())
    try:
        return Experiment(name=name, tuners=tuners, **fields)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


_TYPES: dict[str, type | tuple[type, ...]] = {
    "title": str,
    "says": str,
    "simulator": str,
    "observe": list,
    "error_channel": str,
    "ranges": list,
    "targets": int,
    "seeds": int,
    "budget": int,
    "same_targets_as": str,
    "training_budget": int,
    "timeout": (int, float),
    "memory": int,
    "noise": dict,
    "settings": dict,
    "world": dict,
    "constants": dict,
    "parameters": dict,
    "initial": dict,
    "inputs": dict,
    "sampling": dict,
    "held_out": dict,
    "identifiability": bool,
    "recording": dict,
    "shot": dict,
}


def _field(path: Path, key: str, value: Any) -> Any:
    if key not in _TYPES:
        raise unknown(f"entry of {path}", key, [*_TYPES, "tuners"])
    checked(path, key, value, _TYPES[key])
    if key in ("observe", "ranges"):
        return tuple(checked(path, key, v, str) for v in value)
    if key == "noise":
        return {k: float(checked(path, f"{key}.{k}", v, (int, float))) for k, v in value.items()}
    if key == "parameters":
        return {k: dict(_parameter(path, k, v)) for k, v in value.items()}
    if key in ("initial", "constants"):
        return _initial(path, key, value)
    if key == "inputs":
        return _inputs(path, key, value)
    if key == "held_out":
        return _held_out(path, value)
    if key == "sampling":
        return Sampling(**table_of(path, key, value, {"rate": (int, float), "samples": int}))
    if key == "recording":
        return Source(**table_of(path, key, value, {"path": str}))
    return value


def _parameter(path: Path, name: str, table: Any) -> dict[str, Any]:
    changes = table_of(
        path,
        f"parameters.{name}",
        table,
        {"nominal": (int, float), "bounds": list, "training": list, "log": bool},
    )
    for key in ("bounds", "training"):
        if key in changes:
            changes[key] = pair(path, f"parameters.{name}.{key}", changes[key])
    return changes


def _initial(path: Path, where: str, value: Any) -> dict[str, float | tuple[float, float]]:
    return {
        k: pair(path, f"{where}.{k}", v)
        if isinstance(v, list)
        else float(checked(path, f"{where}.{k}", v, (int, float)))
        for k, v in value.items()
    }


def _inputs(path: Path, where: str, value: Any) -> dict[str, str]:
    return {k: str(checked(path, f"{where}.{k}", v, str)) for k, v in value.items()}


def _held_out(path: Path, value: Any) -> HeldOut:
    given = table_of(path, "held_out", value, {"scenarios": int, "initial": dict, "inputs": dict})
    initial = _initial(path, "held_out.initial", given.pop("initial", {}))
    return HeldOut(
        initial=initial, inputs=_inputs(path, "held_out.inputs", given.pop("inputs", {})), **given
    )


def _entry(path: Path, label: str, table: Any) -> Entry:
    where = f"tuners.{label}"
    fields = table_of(
        path, where, table, {"tuner": str, "options": dict, "seeds": int, "budget": int}
    )
    for key in ("seeds", "budget"):
        if fields.get(key, 1) < 1:
            raise InputError(f"{path}: {where}.{key}: expected at least 1, found {fields[key]}")
    return Entry(label, fields.pop("tuner", label), **fields)
