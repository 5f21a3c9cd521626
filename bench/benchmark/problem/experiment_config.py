"""Experiment configuration: parse and check experiment files, and expand sweeps and suites.

An experiment states which tuners are compared, on which simulator and targets, and with what
budget. The keys of a file are the fields of `Experiment`. `Experiment.document` returns the exact
configuration, including defaults and command-line changes; it is stored with every run.

A sweep stands for one experiment for each combination of its values. A suite is an experiment file
that names its problems with their hashes. A hash covers everything in the problem's file that
determines its results, and the model and the recording in its folder. Words, and the numbers that
the suite states for all its problems, are not hashed.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, TypedDict

from bench.benchmark.problem.experiment_recording import resolve_recording_path
from bench.core.random_streams import check_commitment
from sims import effects
from sims.core.files import is_existing_file
from sims.core.number_limits import MAX_SAMPLING_RATE_HZ
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import (
    Range,
    check_entries,
    check_finite,
    check_known_names,
    check_text,
    get_type_hints_of,
    make_error,
    read_toml,
)
from sims.core.user_messages import MAX_DESCRIPTION_LENGTH, MAX_NAME_LENGTH

RANGES = ("in", "wide", "real")
"""Origin of targets: the training range, the bounds, or a recording."""
ISOLATION_MODES = ("run", "tuner")
"""Lifetimes of a tuner's process: one run, or all runs of the tuner."""
_MAX_TIMEOUT_SECONDS = 1e9
"""Maximum finite time limit in seconds; a longer one overflows timers. Infinity means no limit."""
_MAX_MEMORY_MIB = 10**9
"""Maximum memory limit in MiB; no machine has more memory."""
MAX_EXPERIMENTS = 10_000
"""Maximum number of experiments of one file.

Each one has its own folder, and all are checked before the first run.
"""
_RARE_KEYS = (
    "sweep",
    "experiments",
    "nuisance",
    "diagnosis",
    "identifiable",
    "resolution",
    "suite",
    "problem_hashes",
)
"""Keys that the stored configuration omits if they are empty."""
SHARED_KEYS = (
    "targets",
    "seeds",
    "budget",
    "training_budget",
    "timeout",
    "memory",
    "isolation",
    "trusted",
    "salt",
    "suite",
    "tuners",
)
"""Keys of a file with several experiments that hold for each of them."""
_UNHASHED_KEYS = (*SHARED_KEYS, "title", "says", "identifiable", "tags")
"""Keys that do not belong to the definition of a suite's problem: shared ones, and words."""
_OWN_PACKAGE = "package://bench/"
"""Prefix of model files that come with the project."""
_INVALID_CHARACTERS = re.compile(r"[^\w.+-]+")
"""Characters that are not valid in folder names, in tables and in command lines without quotes."""
FixedOrRange = float | Range
"""A number, or the range from which each scenario draws one uniformly."""


class ParameterOverride(TypedDict, total=False):
    """Parameter properties that an experiment may change; see `sims.core.simulator.Parameter`."""

    nominal: float
    bounds: Range
    training: Range
    log: bool


@dataclass(frozen=True)
class TunerEntry:
    """One tuner of a comparison: registered name, options, seeds and budget.

    Seeds and budget are given where they differ from those of the experiment. If `randomised`, the
    tuner trains with domain randomisation over the experiment's ``[nuisance]``.
    """

    label: str
    tuner: str
    options: Mapping[str, Any] = field(default_factory=dict)
    seeds: int | None = None
    budget: int | None = None
    randomised: bool = False

    def to_table(self) -> dict[str, Any]:
        """Return the entry as the table ``[tuners.LABEL]``."""
        table = {key: value for key, value in asdict(self).items() if value is not None}
        del table["label"]
        if not self.randomised:
            del table["randomised"]
        return table


@dataclass(frozen=True)
class SamplingConfig:
    """Sample times of a simulated target: `samples` of them at `rate` Hz, from zero."""

    rate: float = 100.0
    samples: int = 400


@dataclass(frozen=True)
class HeldOutConfig:
    """Held-out scenarios of a simulated target.

    Initial states and inputs that are not given are those of the experiment.
    """

    scenarios: int = 3
    initial: Mapping[str, FixedOrRange] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordingSource:
    """Recording to which an experiment on real data is tuned.

    The `path` is relative to the folder of recordings ($SIMGAP_DATA), to that of `simgap download`,
    to the experiment's file, or to the working directory.
    """

    path: str = ""


@dataclass(frozen=True)
class CalibrationConfig:
    """Simulated recording from which `simgap explain` extends the simulator that is tuned.

    It is simulated with the system that makes the targets, but with its own parameters.

    Attributes:
        runs: number of runs in the recording.
        held_out: number of these runs on which `simgap explain` measures how much a cause improves
            the prediction.
        initial: initial states that differ from those of the targets.
        inputs: input signals that differ from those of the targets.
    """

    runs: int = 6
    held_out: int = 2
    initial: Mapping[str, FixedOrRange] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """One comparison.

    Attributes:
        name: file name without its ending.
        title: heading of figures.
        says: description in one sentence.
        identifiable: what its data determine, in one sentence.
        tags: words by which a list is searched, e.g. ``quick``; they change nothing.
        simulator: registered name; for a robot, its name in tables (default: that of its file).
        model: model file of a robot (MJCF or URDF) instead of a registered simulator: relative to
            the experiment's file, to $SIMGAP_ROBOTS, to the folder of `simgap download` or to the
            working directory, or ``package://NAME/FILE`` in an installed package.
        free: numbers of the model file to tune, as ``damping@*`` or ``mass@forearm``.
        actuators: those that the model file lacks, as in a recording's ``[actuators.NAME]``.
        observe: channels that the tuner sees (default: all).
        error_channel: channel of `obs_error` and `heldout_error` (default: the first).
        ranges: in, wide (simulated targets), or real (a recording).
        targets: number of targets in each range; for a recording, number of starting points.
        seeds: runs of each stochastic tuner on each target, and trainings of each learned one.
        budget: number of simulations on one target.
        negligible_error: error below which tuners count as equal when they are ranked and tested,
            as a share of the training range (the unit of `param_error`); for a recording, the same
            share above the smallest error that any tuner reached. The shipped experiments state a
            tenth of a percent, or the standard error that their noise leaves if that is larger.
        same_targets_as: experiment whose targets are used (default: this one).
        training_budget: number of simulations that a learned tuner may train with.
        timeout: time limit of a run in seconds.
        memory: memory limit of a run in MiB, in addition to its worker; 0 is no limit.
        noise: standard deviation of the sensor noise of simulated targets, by channel.
        resolution: quantisation step of the noisy samples of simulated targets, by channel.
        settings: settings of the simulator, e.g. its time step.
        world: settings of another simulator that makes the targets: another engine, or effects with
            fixed coefficients (default: the same simulator). Its parameters are the first of the
            tuned ones.
        constants: constants that differ from the simulator's defaults; [low, high] is a uniform
            draw in each scenario, known to whoever simulates it.
        parameters: changes to parameters.
        nuisance: effects that the simulator lacks and the world may have: by coefficient, the range
            of the draws in the training of tuners with ``randomised = true``.
        initial: initial state; [low, high] is a uniform draw.
        inputs: input signals by name, as for `simgap simulate`, e.g. ``sine:2:0.5``.
        sampling: sample times of simulated targets.
        held_out: unseen scenarios on which the prediction of the tuned simulator is measured; for
            simulated targets.
        identifiability: whether to find what the data of each simulated target identify, if there
            are several parameters: two simulations per parameter and target, in addition to all
            budgets.
        recording: measured data, for range real.
        calibration: compare the tuners twice: in the simulator as it is, and in the one that
            `simgap explain` extends from such a recording.
        shot: scene of a bounce shot; `targets` is then the number of shots with each ball.
        diagnosis: cases and diagnosers of a comparison of diagnosers, which has no tuners;
            `budget`, `timeout` and `memory` are then those of an answer.
        isolation: run: a new process for every run of a tuner; tuner: one process for all runs of a
            tuner with one seed in a worker.
        trusted: whether tuners run in the processes of the harness, where they can read everything;
            tables and figures say so.
        salt: text from which targets are drawn (default: a secret one for each comparison, revealed
            at its end); ``public`` draws the published targets; any other text is as public as its
            file.
        salt_sha256: hash of the secret salt, in a folder of results from the beginning.
        sweep: lists of values by key, e.g. ``noise.x``; the file stands for an experiment
            ``NAME[budget=10]`` for each combination.
        experiments: other experiments, by name or file, for which the file stands: each with the
            targets, seeds, budgets, limits and tuners of this one.
        suite: name and version of the benchmark suite.
        problem_hashes: hash by name of each of the `experiments` of a suite, or of the questions of
            a comparison of diagnosers; a changed problem is refused.
        tuners: list of registered names, and of tables with ``tuner`` and, if two entries have the
            same, a ``label``; or a table for each label.
    """

    name: str
    title: str = ""
    says: str = ""
    identifiable: str = ""
    tags: tuple[str, ...] = ()
    simulator: str = ""
    model: str = ""
    free: tuple[str, ...] = ()
    actuators: Mapping[str, Any] = field(default_factory=dict)
    observe: tuple[str, ...] = ()
    error_channel: str = ""
    ranges: tuple[str, ...] = ("in", "wide")
    targets: int = 20
    seeds: int = 1
    budget: int = 100
    negligible_error: float = 1e-3
    same_targets_as: str = ""
    training_budget: int = 1600
    timeout: float = 3600.0
    memory: int = 0
    noise: Mapping[str, float] = field(default_factory=dict)
    resolution: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    world: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, FixedOrRange] = field(default_factory=dict)
    parameters: Mapping[str, ParameterOverride] = field(default_factory=dict)
    nuisance: Mapping[str, Range] = field(default_factory=dict)
    initial: Mapping[str, FixedOrRange] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    held_out: HeldOutConfig | None = None
    identifiability: bool = True
    recording: RecordingSource | None = None
    calibration: CalibrationConfig | None = None
    shot: Mapping[str, Any] = field(default_factory=dict)
    diagnosis: Mapping[str, Any] = field(default_factory=dict)
    isolation: str = "run"
    trusted: bool = False
    salt: str = ""
    salt_sha256: str = ""
    sweep: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    experiments: tuple[str, ...] = ()
    suite: str = ""
    problem_hashes: Mapping[str, str] = field(default_factory=dict)
    tuners: tuple[TunerEntry, ...] = ()

    def __post_init__(self) -> None:
        """Check all values of the experiment that can be checked without its simulator.

        Raises:
            InputError: a value is not valid, or two values contradict each other.
        """
        subject = f"experiment {self.name}"
        for key in ("targets", "seeds", "budget"):
            count = getattr(self, key)
            if count < 1:
                raise InputError(f"{subject}: {key} must be at least 1, found {count}")
        if self.training_budget < 0:
            raise make_error(subject, "training_budget", "at least 0", self.training_budget)
        self._check_words(subject)
        self._check_numbers(subject)
        for entry in self.tuners:
            if entry.randomised and not self.nuisance and not self.experiments:
                expected = "a [nuisance] table of effects to train over"
                raise InputError(
                    f"{subject}: tuner {entry.label} is randomised: expected {expected}"
                )
        if self.memory < 0 or not self.timeout > 0:  # negated, so that NaN is refused too
            raise InputError(f"{subject}: expected timeout > 0 and memory >= 0")
        if self.memory > _MAX_MEMORY_MIB or _MAX_TIMEOUT_SECONDS < self.timeout < math.inf:
            expected = (
                f"timeout of at most {_MAX_TIMEOUT_SECONDS:g} s and "
                f"memory of at most {_MAX_MEMORY_MIB:g} MiB"
            )
            raise InputError(f"{subject}: expected {expected}")
        check_known_names("range", self.ranges, RANGES)
        if not self.ranges or len(set(self.ranges)) < len(self.ranges):
            raise make_error(subject, "ranges", "one or more, each once", list(self.ranges))
        check_known_names("isolation", [self.isolation], ISOLATION_MODES)
        check_commitment(subject, self.salt, self.salt_sha256)
        # The range 'real' needs a recording and no other range; other ranges must not have one.
        is_real = "real" in self.ranges
        if is_real != (self.recording is not None) or (is_real and len(self.ranges) != 1):
            raise InputError(f"{subject}: range 'real' and a [recording] go together, and alone")
        if self.held_out and (self.recording or self.held_out.scenarios < 1):
            expected = "simulated targets and scenarios of at least 1"
            raise InputError(f"{subject}: [held_out] needs {expected}")
        self._check_calibration(subject)

    def _check_calibration(self, subject: str) -> None:
        """Raise an error if the calibration has no runs to fit, or is not applicable.

        The table [calibration] has runs of the true system to which the simulator is fitted first;
        `held_out` of them are not used in the fit.

        Args:
            subject: Name of the experiment's file for the message.
        """
        if self.calibration is None:
            return
        runs, held_out = self.calibration.runs, self.calibration.held_out
        if not 0 <= held_out < runs:
            raise make_error(
                subject, "calibration.held_out", f"fewer than the {runs} runs", held_out
            )
        if self.recording or self.shot:
            raise InputError(f"{subject}: [calibration] needs simulated targets, and no shot")

    def _check_words(self, subject: str) -> None:
        """Raise an error for texts that do not fit into figures, tables or paths.

        Args:
            subject: Name of the experiment's file for the message.
        """
        check_text(subject, "title", self.title)
        check_text(subject, "says", self.says, max_length=MAX_DESCRIPTION_LENGTH)
        check_text(subject, "identifiable", self.identifiable, max_length=MAX_DESCRIPTION_LENGTH)
        check_text(subject, "suite", self.suite, max_length=MAX_NAME_LENGTH)
        check_text(subject, "same_targets_as", self.same_targets_as)
        check_text(subject, "model", self.model, max_length=MAX_DESCRIPTION_LENGTH)
        for parameter_name in self.free:
            check_text(subject, "free", parameter_name, max_length=MAX_NAME_LENGTH)
        for experiment_name in self.experiments:
            check_text(subject, "experiments", experiment_name)
        check_text(subject, "tags", ", ".join(self.tags), max_length=MAX_DESCRIPTION_LENGTH)
        for entry in self.tuners:
            check_text(subject, "tuners: label", entry.label, max_length=MAX_NAME_LENGTH)

    def _check_numbers(self, subject: str) -> None:
        """Raise an error for numbers that are not finite or out of range.

        Args:
            subject: Name of the experiment's file for the message.
        """
        if not 0 <= check_finite(subject, "negligible_error", self.negligible_error) < 1:
            expected = "a share of the training range, from 0 to below 1"
            raise make_error(subject, "negligible_error", expected, self.negligible_error)
        rate = check_finite(subject, "sampling.rate", self.sampling.rate)
        if not 0 < rate <= MAX_SAMPLING_RATE_HZ or self.sampling.samples < 1:
            expected = (
                f"a rate above 0 Hz and up to {MAX_SAMPLING_RATE_HZ:g} Hz, "
                "and at least 1 of samples"
            )
            raise make_error(subject, "sampling", expected, asdict(self.sampling))
        for name, sigma in self.noise.items():
            if check_finite(subject, f"noise.{name}", sigma) < 0:
                raise make_error(subject, f"noise.{name}", "at least 0", sigma)
        for name, step in self.resolution.items():
            if not check_finite(subject, f"resolution.{name}", step) > 0:
                raise make_error(subject, f"resolution.{name}", "more than 0", step)
        held_out_initial = self.held_out.initial if self.held_out else {}
        calibrated = self.calibration.initial if self.calibration else {}
        for table_name, values in (
            ("initial", self.initial),
            ("constants", self.constants),
            ("held_out.initial", held_out_initial),
            ("calibration.initial", calibrated),
        ):
            # A value is a number, or a range (low, high).
            for name, value in values.items():
                for number in value if isinstance(value, tuple) else (value,):
                    check_finite(subject, f"{table_name}.{name}", number)

    def document(self) -> dict[str, Any]:
        """Return the whole configuration as TOML tables, the inverse of `parse_experiment`.

        Keys without a value are left out, as are rare keys at their default.
        """
        document = {key: value for key, value in asdict(self).items() if value is not None}
        del document["name"]
        for rare in _RARE_KEYS:
            if not document[rare]:
                del document[rare]
        document["tuners"] = {entry.label: entry.to_table() for entry in self.tuners}
        return document

    @property
    def fixed(self) -> dict[str, float]:
        """Constants that are equal in every scenario."""
        constants = self.constants.items()
        return {name: value for name, value in constants if not isinstance(value, tuple)}

    def chosen(self, **changes: Any) -> Experiment:
        """Return this experiment with the given fields replaced if they are not None."""
        # None means that an option is not given on the command line.
        return replace(self, **{k: v for k, v in changes.items() if v is not None})

    def with_seeds(self, seeds: int) -> Experiment:
        """Return this experiment with a number of seeds.

        Entries of tuners with fewer seeds keep their number.
        """
        entries = []
        for entry in self.tuners:
            # An entry without a number keeps following the experiment's number.
            fewer = min(entry.seeds, seeds) if entry.seeds else None
            entries.append(replace(entry, seeds=fewer))
        return replace(self, seeds=seeds, tuners=tuple(entries))

    def with_tuners(self, labels: Sequence[str]) -> Experiment:
        """Return this experiment with only the given tuners, in this order.

        A registered name that has no entry gets a new one.
        """
        entries = {entry.label: entry for entry in self.tuners}
        entries_in_order = tuple(entries.get(label, TunerEntry(label, label)) for label in labels)
        return replace(self, tuners=entries_in_order)


def list_experiment_names() -> list[str]:
    """Return the names of the experiments that come with the project."""
    folder = resources.files("bench.experiments")
    files = [file.name for file in folder.iterdir() if file.name.endswith(".toml")]
    return sorted(name.removesuffix(".toml") for name in files)


def load_experiment(name_or_path: str) -> Experiment:
    """Load an experiment of the project by name, or a user's experiment by its TOML file.

    Raises:
        InputError: there is no such experiment, or its file has an error.
    """
    path = find_experiment_file(name_or_path)
    return parse_experiment(path.stem, read_toml(path), path)


def find_experiment_file(name_or_path: str) -> Path:
    """Find the file of an experiment of the project, or of a user.

    Args:
        name_or_path: Name of an experiment of the project, or path of a TOML file.

    Raises:
        InputError: there is no such experiment.
    """
    if name_or_path in list_experiment_names():
        return Path(str(resources.files("bench.experiments").joinpath(f"{name_or_path}.toml")))
    if name_or_path.endswith(".toml"):
        return Path(name_or_path)
    error = make_unknown_name_error("experiment", name_or_path, list_experiment_names())
    raise InputError(f"{error} (or give the path of a .toml file)")


def parse_experiment(name: str, document: Mapping[str, Any], path: Path) -> Experiment:
    """Check the tables of an experiment file and convert them to an experiment.

    Relative paths are made absolute, and names of tuners and swept values are checked.

    Args:
        name: name of the experiment.
        document: tables of the file.
        path: path of the file, for messages and for relative paths.

    Raises:
        InputError: there is an unknown key or a value of a wrong type; names file and key.
    """
    # The keys of a file are the fields of an experiment; their types are checked below.
    hints = {key: hint for key, hint in get_type_hints_of(Experiment).items() if key != "name"}
    check_known_names(f"entry of {path}", document, hints)
    tuners = _parse_tuner_entries(path, document.get("tuners", {}))
    entries = {key: value for key, value in document.items() if key != "tuners"}
    fields = check_entries(path, "", entries, hints)
    _complete_simulator_fields(fields, path)
    # Paths are made absolute here: workers and result folders do not know this file's location.
    if "recording" in fields:
        fields["recording"] = RecordingSource(
            resolve_recording_path(fields["recording"].path, path)
        )
    try:
        experiment = Experiment(name=name, tuners=tuners, **fields)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    _expand_combinations(experiment, path)  # an error in a swept value is an error of this file
    # A suite, a versioned set of problems, states their hashes; one of questions to diagnosers has
    # a single hash for all of them. The stored configuration of a
    # result states none, because it may select some of the questions.
    if experiment.suite and experiment.diagnosis and experiment.problem_hashes:
        question_hash = _hash_tables(
            {k: document["diagnosis"].get(k) for k in ("seed", "questions")}
        )
        _check_problem_hash(experiment.suite, experiment.problem_hashes, "questions", question_hash)
    return experiment


def _complete_simulator_fields(fields: dict[str, Any], path: Path) -> None:
    """Check and complete the fields of an experiment file that say what is simulated.

    It is a robot's model file, or a registered simulator, or those of named experiments; only a
    comparison of diagnosers needs none. Relative paths are made absolute, and a robot without a
    name is named after its model file.

    Args:
        fields: fields of the experiment that the file has, changed in place.
        path: path of the file, for messages and for relative paths.

    Raises:
        InputError: nothing is named, or the fields contradict each other.
    """
    if model := fields.get("model"):
        fields["model"] = resolve_model_path(model, path)
        fields.setdefault("simulator", check_name(Path(model).stem))
        if (simulator_name := fields["simulator"]) != check_name(simulator_name):
            raise make_error(
                path, "simulator", "letters, digits and _ . + - for a robot", simulator_name
            )
    elif fields.get("free") or fields.get("actuators"):
        raise InputError(f'{path}: free and actuators are of a robot: expected model = "FILE"')
    if fields.get("experiments"):
        fields["experiments"] = tuple(
            _resolve_experiment_path(named_experiment, path)
            for named_experiment in fields["experiments"]
        )
    elif not fields.get("simulator") and not fields.get("diagnosis"):
        raise InputError(f'{path}: expected simulator = "NAME" or model = "FILE", found none')


def resolve_model_path(model: str, experiment: Path) -> str:
    """Return the path of a model file, made absolute if the file is next to the experiment file."""
    file = experiment.parent / model
    return str(file.resolve()) if is_existing_file(file) else model


def _resolve_experiment_path(name: str, experiment: Path) -> str:
    """Return a name, or the path of an experiment file, made absolute if it is next to this one."""
    file = experiment.parent / name
    return str(file.resolve()) if name.endswith(".toml") and is_existing_file(file) else name


def check_name(text: str) -> str:
    """Convert a text to a name that is valid in tables, file names and command lines."""
    return _INVALID_CHARACTERS.sub("_", text)[:60] or "robot"


def _parse_tuner_entries(path: Path, value: Any) -> tuple[TunerEntry, ...]:
    """Parse the tuner entries of an experiment file, in the order of the file.

    Args:
        path: experiment file.
        value: value of the key ``tuners``: a table of tables by label, or a list of registered
            names and of tables that name their tuner.

    Raises:
        InputError: the value is not valid.
    """
    if isinstance(value, dict):
        tables = value.items()
        return tuple(
            _parse_tuner_table(path, f"tuners.{label}", label, table) for label, table in tables
        )
    if not isinstance(value, list):
        raise make_error(path, "tuners", "a list of names or a table for each tuner", value)
    entries: list[TunerEntry] = []
    for index, item in enumerate(value):
        entry = _parse_list_item(path, f"tuners[{index}]", item)
        # Tables and figures distinguish tuners by label; TOML keys cannot occur twice, list items
        # can.
        if entry.label in [listed_entry.label for listed_entry in entries]:
            problem = f"{entry.label} is listed twice; give one of them a label"
            raise InputError(f"{path}: tuners: {problem}")
        entries.append(entry)
    return tuple(entries)


def _parse_list_item(path: Path, key: str, item: Any) -> TunerEntry:
    """Parse one element of a list of tuners: a name, or a table with the key ``tuner``.

    The label, under which results are listed, is the key ``label``, or else the name of the tuner.

    Args:
        path: path of the experiment file, for messages.
        key: key of the list.
        item: the element.
    """
    if isinstance(item, str):
        return TunerEntry(item, item)
    if not isinstance(item, dict):
        raise make_error(path, key, "a name or a table", item)
    table = dict(item)  # a copy, so that the parsed document is not changed
    label = table.pop("label", table.get("tuner"))
    if not isinstance(label, str):
        raise make_error(path, key, 'a table with tuner = "NAME"', item)
    return _parse_tuner_table(path, key, label, table)


def _parse_tuner_table(path: Path, entry_key: str, label: str, value: Any) -> TunerEntry:
    """Parse the table of one tuner; a table without the key ``tuner`` uses its label as the name.

    Args:
        path: path of the experiment file, for messages.
        entry_key: key of the table in the file, for messages.
        label: label under which results are listed.
        value: the table.
    """
    # The keys of the table are the fields of `TunerEntry`, except for the label.
    hints = {key: hint for key, hint in get_type_hints_of(TunerEntry).items() if key != "label"}
    table = check_entries(path, entry_key, value, hints)
    for key in ("seeds", "budget"):
        if table.get(key, 1) < 1:
            raise make_error(path, f"{entry_key}.{key}", "at least 1", table[key])
    return TunerEntry(label, table.pop("tuner", label), **table)


def expand_sweep(experiment: Experiment) -> list[Experiment]:
    """Expand an experiment into the experiments that its file describes.

    A sweep gives one experiment for each combination of its values, named ``NAME[budget=10]``. All
    have the same targets, because target seeds depend on the file's name alone. A file that names
    other experiments gives these, with its own numbers and tuners. Any other experiment gives
    itself.
    """
    if experiment.experiments:
        return [
            expanded
            for name in experiment.experiments
            for expanded in _load_named_experiments(experiment, name)
        ]
    return _expand_combinations(experiment, Path(f"{experiment.name}.toml"))


def _load_named_experiments(suite: Experiment, name: str) -> list[Experiment]:
    """Load one of the experiments that a suite names, with the numbers and tuners of the suite.

    This is how one file runs many problems with the same settings. If the suite has a name and a
    version (`suite.suite`), it states a hash of each problem, which is compared with its file.

    Args:
        suite: experiment that names others.
        name: one of these, a name or the path of a file.

    Returns:
        The experiment; one for each combination if it sweeps over values.

    Raises:
        InputError: the named experiment names others itself, or it is not the suite's version.
    """
    experiment = load_experiment(name)
    if experiment.experiments:
        raise InputError(f"experiment {suite.name}: {name} names experiments itself")
    if suite.suite:
        file = find_experiment_file(name)
        problem_hash = compute_problem_hash(file, frozenset(_UNHASHED_KEYS))
        _check_problem_hash(suite.suite, suite.problem_hashes, experiment.name, problem_hash)
    # Numbers such as budget and seeds are those of the suite. Its tuners, if it names any, replace
    # all others: options of one experiment may be invalid in the other.
    shared = {key: getattr(suite, key) for key in SHARED_KEYS if key != "tuners" or suite.tuners}
    return expand_sweep(experiment.chosen(**shared))


def _expand_combinations(experiment: Experiment, path: Path) -> list[Experiment]:
    """Expand a sweep to one experiment for each combination of values.

    A sweep lists several values of one or more keys. Each combination is named
    ``NAME[key=value,...]``.

    Args:
        experiment: experiment that may have a sweep.
        path: path of its file, for messages.

    Returns:
        The experiments without a sweep. An experiment that has none, or that names other
        experiments, which are expanded elsewhere, is returned alone.
    """
    if not experiment.sweep or experiment.experiments:
        return [experiment]
    document = experiment.document()
    del document["sweep"]
    # All combinations have the same targets, so that only the swept values make a difference.
    document["same_targets_as"] = experiment.same_targets_as or experiment.name
    experiments = []
    for label, changed in _iterate_swept_documents(path, document, experiment.sweep):
        if experiment.title:
            values = label.replace("=", " = ").replace(",", ", ")
            changed["title"] = f"{experiment.title} ({values})"
        experiments.append(parse_experiment(f"{experiment.name}[{label}]", changed, path))
    return experiments


def _iterate_swept_documents(
    path: Path, document: Mapping[str, Any], swept: Mapping[str, Sequence[Any]]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Expand a sweep: yield the tables of an experiment for each combination of the swept values.

    The values of the last key change fastest.

    Args:
        path: experiment file, for messages.
        document: tables of the experiment without a sweep.
        swept: values by key; a key within a table is joined by dots.

    Yields:
        The label, as ``budget=10,noise.x=0.1``, and the tables with these values inserted.

    Raises:
        InputError: a key has no values, two values have the same label, or there are too many
            combinations.
    """
    count = prod(len(values) for values in swept.values())
    if count > MAX_EXPERIMENTS:
        raise InputError(
            f"{path}: sweep: expected at most {MAX_EXPERIMENTS:,} experiments, "
            f"found {count:.3g} combinations; sweep over fewer values, or divide the file"
        )
    for key, values in swept.items():
        _check_sweep_values(path, f"sweep.{key}", values)
    for values in product(*swept.values()):
        # A copy is needed, because tables within the document are changed.
        changed = deepcopy(dict(document))
        parts = []
        for key, value in zip(swept, values, strict=True):
            _insert_value(path, changed, key, value)
            parts.append(f"{key}={_format_swept_value(path, key, value)}")
        yield ",".join(parts), changed


def _check_sweep_values(path: Path, key: str, values: Sequence[Any]) -> None:
    """Raise an error for a key of a sweep that has no values, or the same value twice.

    Args:
        path: path of the experiment file, for messages.
        key: key in the file, such as ``sweep.budget``, for messages.
        values: values of the key.
    """
    if not values:
        raise make_error(path, key, "at least one value", values)
    texts = [_format_swept_value(path, key, value) for value in values]
    for text in texts:
        if texts.count(text) > 1:  # two experiments would share one folder
            raise InputError(f"{path}: {key}: {text} is given twice")


def _format_swept_value(path: Path, key: str, value: Any) -> str:
    """Return a swept value as text, for the name of its experiment and thus for its folder.

    Characters that do not fit into a folder name become hyphens.

    Args:
        path: path of the experiment file, for messages.
        key: key of the sweep.
        value: the value.

    Raises:
        InputError: the value is a table.
    """
    if isinstance(value, dict):
        raise make_error(path, key, "strings, numbers, booleans or lists of them", value)
    if isinstance(value, list | tuple):
        return "_".join(_format_swept_value(path, key, item) for item in value)
    if isinstance(value, bool):  # as TOML writes it
        return str(value).lower()
    return _INVALID_CHARACTERS.sub("-", str(value))


def _insert_value(path: Path, document: dict[str, Any], key: str, value: Any) -> None:
    """Insert a value at the position that a key such as ``noise.q`` names; tables are created.

    Names that contain dots themselves are recognised if the table has them already.

    Args:
        path: path of the experiment file, for messages.
        document: content of the file, changed in place.
        key: key with dots.
        value: the value.
    """
    table, remaining_key = document, key
    while (name := _get_first_key(table, remaining_key)) != remaining_key:
        table, remaining_key = table.setdefault(name, {}), remaining_key[len(name) + 1 :]
        if not isinstance(table, dict):
            raise InputError(f"{path}: sweep.{key}: {name} is not a table, so it has no entries")
    table[remaining_key] = value


def _get_first_key(table: Mapping[str, Any], key: str) -> str:
    """Return the first part of a key with dots, the name of an entry of the table.

    It ends at the first dot, unless the table has a longer matching name: effect names can contain
    dots.
    """
    matching_names = [name for name in table if key == name or key.startswith(f"{name}.")]
    # A part that is not in the table is a new table, or a key that later checks refuse.
    return max(matching_names, key=len, default=key.partition(".")[0])


def compute_problem_hash(path: Path, ignored_keys: frozenset[str]) -> str:
    """Compute the hash of a problem of a suite.

    Args:
        path: experiment file of the problem.
        ignored_keys: keys of the file that do not belong to the problem.

    Returns:
        First 16 hexadecimal digits of the SHA-256.
    """
    tables = read_toml(path)
    definition = {key: value for key, value in tables.items() if key not in ignored_keys}
    # Line ends depend on the settings of a version-control system.
    files = [f.read_bytes().replace(b"\r\n", b"\n") for f in _list_referenced_files(path, tables)]
    return _hash_tables(definition, *files)


def _hash_tables(tables: Mapping[str, Any], *contents: bytes) -> str:
    """Compute the hash of tables and of the contents of files.

    Returns:
        First 16 hexadecimal digits of the SHA-256.
    """
    text = json.dumps(tables, sort_keys=True, default=list)
    return hashlib.sha256(b"".join([text.encode(), *contents])).hexdigest()[:16]


def _list_referenced_files(path: Path, tables: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the model file and the recording, if they come with the project or the problem.

    Args:
        path: path of the problem's file.
        tables: its content.
    """
    model = str(tables.get("model", ""))
    if model.startswith(_OWN_PACKAGE):
        yield Path(str(resources.files("bench").joinpath(model.removeprefix(_OWN_PACKAGE))))
    elif model and (path.parent / model).is_file():
        yield path.parent / model
    recording = str(tables.get("recording", {}).get("path", ""))
    if recording and (path.parent / recording).is_file():
        yield path.parent / recording
        # The description of a recording is next to its table.
        yield (path.parent / recording).with_suffix(".toml")


def _check_problem_hash(
    suite: str, expected: Mapping[str, str], name: str, computed_hash: str
) -> None:
    """Raise an error if a problem is not the one that belongs to a suite's version.

    Args:
        suite: name and version of the suite.
        expected: hash of each problem by its name, as the file of the suite states them.
        name: name of the problem.
        computed_hash: hash of the problem's present files.

    Raises:
        InputError: the hash is another one, or the suite states none.
    """
    if expected.get(name) != computed_hash:
        raise InputError(
            f"suite {suite}: problem {name} has the hash {computed_hash}, expected "
            f"{expected.get(name, 'one in [problem_hashes]')}; a changed problem needs a new "
            'version: raise the number in suite = "..." and write the new hash'
        )


def list_effect_names(*settings: Mapping[str, Any]) -> list[str]:
    """Return the sorted names of registered effects in ``effects`` and ``fixed`` of settings."""
    return sorted(find_named_effects(*settings) & set(effects.list_names()))


def find_named_effects(*settings: Mapping[str, Any]) -> set[str]:
    """Return all effect names in settings, also those that a plugin may define later.

    Args:
        settings: Settings of simulators: ``effects`` are names of effects whose coefficients are
            tuned, ``fixed`` has fixed coefficients by name of the effect.
    """
    names: set[str] = set()
    for table in settings:
        for key in ("effects", "fixed"):
            value = table.get(key, ())
            # Values of a wrong type are reported by the simulator.
            if isinstance(value, Mapping | Sequence) and not isinstance(value, str):
                # `viscous@elbow` is the effect `viscous` at one joint of a robot.
                names.update(name.partition("@")[0] for name in value if isinstance(name, str))
    return names
