"""The ``[diagnosis]`` table of an experiment, and the set of cases that it specifies.

With the public salt, the seed of a case is a small number that everybody can compute. With a secret
salt, it is a part of a hash of salt and case name, which reveals neither.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from bench.benchmark.problem.experiment_config import Experiment
from bench.core.random_streams import PUBLIC_SALT, make_rng
from bench.diagnosis_benchmark.case_generation import case_sampling
from bench.diagnosis_benchmark.case_generation.benchmark_case import (
    CASE_KINDS,
    BenchmarkCase,
    name_case,
)
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    NOISE_KINDS,
    SIMULATORS,
    RequestedConditions,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import UNMODELLED_CAUSES
from bench.diagnosis_benchmark.machine_cases import machine_case_sampling as machines
from bench.diagnosis_benchmark.machine_cases import machine_effect_coefficients
from sims import effects as library
from sims.core.files import Content, write_files
from sims.core.json_documents import Document
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import (
    check_entries,
    check_known_names,
    get_type_hints_of,
    make_error,
)
from sims.recording.recording_writer import format_description, format_table

ALL_SYSTEMS = (*case_sampling.SYSTEMS, *machines.MACHINE_NAMES)
"""Names of all systems."""
DEFAULT_SYSTEMS = case_sampling.SYSTEMS
"""Systems that are used if an experiment does not name any."""


class RecordingFiles(NamedTuple):
    """Recording as texts of files.

    Attributes:
        table: CSV text.
        description: TOML text.
        extra_files: texts of other files, by file name.
    """

    table: str
    description: str
    extra_files: Mapping[str, str]


def draw_case(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    requested: RequestedConditions = ANY_CONDITIONS,
) -> BenchmarkCase | None:
    """Draw a case, a recording with known hidden causes, from the generator of its system.

    Args:
        kind: number and origin of the hidden causes: clean (none), single, double, or foreign (one
            that no effect of the library describes).
        system: one of `ALL_SYSTEMS`.
        seed: seed of the case.
        effect: hidden effect; None to draw it.
        size: size in units of the noise; None to draw it.
        requested: recording conditions that are given; those that are None are drawn.

    Returns:
        The case, or None if the hidden cause is not observable.
    """
    draw = machines.draw_case if system in machines.MACHINE_NAMES else case_sampling.draw_case
    return draw(kind, system, seed, effect, size, requested)


def list_hideable_effects(system: str) -> list[str]:
    """List the effects of the library that can be hidden in a system."""
    if system in machines.MACHINE_NAMES:
        return list(machine_effect_coefficients.EFFECTS_BY_MACHINE[system])
    return sorted(library.list_effects_for(SIMULATORS[system].system))


def list_unmodelled_causes(system: str) -> list[str]:
    """List the causes for a system that the library does not contain."""
    return list(
        machine_effect_coefficients.UNMODELLED_CAUSES
        if system in machines.MACHINE_NAMES
        else UNMODELLED_CAUSES[system]
    )


def render_recording(case: BenchmarkCase) -> RecordingFiles:
    """Render the recording of a case as texts, for the process of a diagnoser.

    The process receives these texts and no path, so that it cannot find other files of the case.

    Args:
        case: the case; its true causes are not among the texts.
    """
    record = (
        machines.record_case if case.system in machines.MACHINE_NAMES else case_sampling.record_case
    )
    # `declared` states the units of the signals.
    recording, declared, extra_files = record(case)
    table = format_table(recording.runs, _TABLE_DIGITS)
    # The model file of a robot lies in the folder of the description, so its path is its name.
    description = format_description(recording, declared, Path())
    return RecordingFiles(table, description, extra_files)


def write_case(case: BenchmarkCase, folder: Path, truth: bool = True) -> Path:
    """Write the recording of a case as NAME.csv and NAME.toml.

    Args:
        case: case of the benchmark: its recording conditions and hidden causes.
        folder: folder for the files.
        truth: whether to write the case with its true causes to NAME.truth.json too.

    Returns:
        Path of the CSV file.
    """
    texts, path = render_recording(case), folder / f"{case.name}.csv"
    contents: dict[Path, Content] = {
        path: texts.table,
        path.with_suffix(".toml"): texts.description,
        **{folder / name: text for name, text in texts.extra_files.items()},
    }
    if truth:
        truth_text = json.dumps(case.to_document(), indent=1) + "\n"
        contents[path.with_suffix(".truth.json")] = truth_text
    write_files(contents)
    return path


_TABLE_DIGITS = 9
"""Number of significant digits of the recordings."""
MAX_EFFECT_SIZE = 30.0
"""Maximum size of a hidden effect, in units of the noise."""
_MAX_CASES = 10_000
"""Maximum number of cases per combination of conditions."""


@dataclass(frozen=True)
class CaseRequest:
    """Specification of cases of one kind.

    Every combination of the listed values is used. A field that is empty is drawn at random, except
    effects: they are then all effects that can be hidden.

    Attributes:
        kind: clean, single, double or foreign.
        systems: names of the systems.
        effects: hidden effects; empty for all that can be hidden. Not allowed for clean and double
            cases, whose effects are drawn.
        sizes: sizes of the hidden effect, in units of the noise.
        rates: sampling rates, Hz.
        runs: numbers of runs.
        noises: kinds of noise: white, ar1 or quantised.
        count: number of cases per combination.
    """

    kind: str
    systems: tuple[str, ...] = DEFAULT_SYSTEMS
    effects: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    rates: tuple[int, ...] = ()
    runs: tuple[int, ...] = ()
    noises: tuple[str, ...] = ()
    count: int = 1


@dataclass(frozen=True)
class BenchmarkConfig:
    """The ``[diagnosis]`` table.

    Attributes:
        diagnosers: registered names of diagnosers.
        seed: seed of the public cases; another seed gives another case set of the same form.
        sample: number of cases that are selected at random; 0 for all.
        questions: tables that specify the cases.
    """

    diagnosers: tuple[str, ...] = ()
    seed: int = 0
    sample: int = 0
    questions: tuple[Mapping[str, Any], ...] = field(default_factory=tuple)

    @property
    def case_requests(self) -> tuple[CaseRequest, ...]:
        """Case specifications, with validated keys."""
        return tuple(
            CaseRequest(
                **check_entries(
                    "experiment", "diagnosis.questions", table, get_type_hints_of(CaseRequest)
                )
            )
            for table in self.questions
        )


def read_config(experiment: Experiment) -> BenchmarkConfig:
    """Read and validate the ``[diagnosis]`` table of an experiment.

    It states the diagnosers, the tables of cases (``questions``), the random seed and the size of a
    sample.

    Args:
        experiment: configuration whose table is read.

    Raises:
        InputError: a key or value is not allowed; the message names it and what is allowed.
    """
    subject = f"experiment {experiment.name}"
    entries = check_entries(
        subject, "diagnosis", dict(experiment.diagnosis), get_type_hints_of(BenchmarkConfig)
    )
    settings = BenchmarkConfig(**entries)
    if not settings.diagnosers:
        raise make_error(subject, "diagnosis.diagnosers", "one or more names", "none")
    if not settings.questions:
        raise make_error(subject, "diagnosis.questions", "one or more tables", "none")
    if len(set(settings.diagnosers)) < len(settings.diagnosers):
        raise make_error(subject, "diagnosis.diagnosers", "each once", list(settings.diagnosers))
    if settings.sample < 0 or settings.seed < 0:
        raise InputError(f"{subject}: diagnosis: expected seed and sample of at least 0")
    for request in settings.case_requests:
        check_known_names("kind", [request.kind], CASE_KINDS)
        check_known_names("system", request.systems, ALL_SYSTEMS)
        check_known_names("noise", request.noises, NOISE_KINDS)
        if not 1 <= request.count <= _MAX_CASES:
            raise make_error(
                subject, "diagnosis.questions.count", f"1 to {_MAX_CASES}", request.count
            )
        if not all(0.0 < size <= MAX_EFFECT_SIZE for size in request.sizes):
            raise make_error(
                subject,
                "diagnosis.questions.sizes",
                f"above 0, up to {MAX_EFFECT_SIZE:g}",
                request.sizes,
            )
        # Sampling rates in Hz for which cases can be drawn.
        if not all(10 <= rate <= 1000 for rate in request.rates):
            raise make_error(subject, "diagnosis.questions.rates", "10 to 1000 Hz", request.rates)
        if not all(2 <= runs <= 6 for runs in request.runs):
            raise make_error(subject, "diagnosis.questions.runs", "2 to 6", request.runs)
    return settings


MAX_DRAW_ATTEMPTS = 8
"""Maximum number of attempts to draw a case in which the hidden cause is observable."""
_SEED_STRIDE = 1000
"""Difference between the first seeds of two public case sets; seeds of two cases differ by ten."""


@dataclass(frozen=True)
class CaseSpec(Document):
    """Specification from which a case is drawn.

    Attributes:
        kind: clean, single, double or foreign.
        system: name of the system.
        effect: hidden effect (the first one of a double case); None to draw it.
        size: size of the effect in units of the noise; None to draw it.
        asked: recording conditions that are specified and not drawn.
        index: number that distinguishes cases of the same specification.
    """

    kind: str
    system: str
    effect: str | None
    size: float | None
    asked: RequestedConditions
    index: int

    @property
    def name(self) -> str:
        """Name of the case, unique in a case set."""
        effect = self.effect or ""
        return name_case(self.kind, self.system, effect, self.size, self.asked, self.index, "/")

    def draw_case(self, seed: int, salt: str = PUBLIC_SALT) -> BenchmarkCase | None:
        """Draw the case; make several attempts if the hidden cause is not observable.

        Args:
            seed: seed of the public case set.
            salt: secret salt, or `PUBLIC_SALT`.

        Returns:
            The first case whose hidden cause is observable; None if all attempts fail.
        """
        first_seed = self._get_first_seed(seed, salt)
        for attempt in range(MAX_DRAW_ATTEMPTS):
            case = draw_case(
                self.kind, self.system, first_seed + attempt, self.effect, self.size, self.asked
            )
            if case is not None:
                return case
        return None

    def _get_first_seed(self, seed: int, salt: str) -> int:
        """Return the seed of the first attempt to draw the case; attempt k uses this seed plus k.

        Seeds are multiples of ten, so that the attempts of two cases share no seed.

        Args:
            seed: seed of the public case set; unused with a secret salt.
            salt: secret salt, or `PUBLIC_SALT`. With a secret salt the seed is a part of the
                SHA-256 hash of salt and name, so that the case cannot be computed without the salt.
        """
        if salt in ("", PUBLIC_SALT):
            return _SEED_STRIDE * seed + 10 * self.index
        text = "\x1f".join([salt, self.name])
        # Multiples of ten, as for the public seeds, leave room for the seeds of further attempts.
        # 14 hexadecimal digits are 56 bits, too many to be guessed.
        return 10 * int(hashlib.sha256(text.encode()).hexdigest()[:14], 16)


def build_case_set(settings: BenchmarkConfig) -> list[CaseSpec]:
    """Build the list of all cases of a comparison.

    The order of the tables in the experiment determines the order of the cases; with `sample`, a
    random subset is selected. Cases that hide the same effect in the same system get the numbers
    0, 1, ... (`index`), from which their seeds follow.

    Args:
        settings: the ``[diagnosis]`` table: requests of cases, seed, and size of the sample.

    Raises:
        InputError: an effect cannot be hidden in a system.
    """
    last_index_by_group: dict[tuple[Any, ...], int] = {}
    questions = []
    for request in settings.case_requests:
        for kind, system, effect, size, conditions in _iterate_combinations(request):
            # The size is not part of the group, so cases of two sizes have different seeds.
            group = kind, system, effect
            for _ in range(request.count):
                index = last_index_by_group.get(group, -1) + 1
                last_index_by_group[group] = index
                questions.append(CaseSpec(kind, system, effect, size, conditions, index=index))
    if not settings.sample or settings.sample >= len(questions):
        return questions
    rng = make_rng("diagnosis", "sample", settings.seed)
    chosen_indices = rng.choice(len(questions), settings.sample, replace=False)
    # Sorted, so that a sample keeps the order of the experiment.
    return [questions[i] for i in sorted(chosen_indices.tolist())]


def _iterate_combinations(
    request: CaseRequest,
) -> Iterator[tuple[str, str, str | None, float | None, RequestedConditions]]:
    """Yield every combination of the values that one table of the experiment lists.

    A list that is empty gives None, which means that the value is drawn at random; effects are then
    all that can be hidden.

    Args:
        request: content of the table: kind of the cases, and lists of values.

    Yields:
        Kind, system, effect, size, and recording conditions.
    """
    for system in request.systems:
        effects = _list_hidden_effects(request, system)
        combinations = product(
            effects,
            request.sizes or (None,),
            request.rates or (None,),
            request.runs or (None,),
            request.noises or (None,),
        )
        for effect, size, rate, runs, noise in combinations:
            yield request.kind, system, effect, size, RequestedConditions(rate, runs, noise)


def _list_hidden_effects(request: CaseRequest, system: str) -> list[str | None]:
    """List the effects that cases of one system hide; None stands for an effect that is drawn.

    Args:
        request: kind and number of cases, and the effects that the experiment names; if it names
            none, all that can be hidden in the system are listed.
        system: name of the system, such as ``pendulum``.

    Raises:
        InputError: an effect is unknown, or effects are named for clean or double cases.
    """
    if request.kind in ("clean", "double"):
        if request.effects:
            raise InputError(
                f"diagnosis.questions: of {request.kind} questions no effects are named"
            )
        return [None]
    # A foreign case hides a cause that no effect of the library describes. A name is unknown only
    # if no system has it: a table may list effects that not all of its systems have.
    is_foreign = request.kind == "foreign"
    if is_foreign:
        available_effects = list_unmodelled_causes(system)
        known_effects = {name for other in ALL_SYSTEMS for name in list_unmodelled_causes(other)}
    else:
        available_effects = list_hideable_effects(system)
        known_effects = set(library.registry.names())
    for name in request.effects:
        if name not in known_effects:
            raise make_unknown_name_error(
                "foreign cause" if is_foreign else "effect", name, available_effects
            )
    return [name for name in available_effects if not request.effects or name in request.effects]
