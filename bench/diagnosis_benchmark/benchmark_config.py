"""The ``[diagnosis]`` table of an experiment: diagnosers and cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bench.benchmark.problem.experiment import Experiment
from bench.diagnosis_benchmark.case_catalogue import ALL_SYSTEMS, DEFAULT_SYSTEMS
from bench.diagnosis_benchmark.case_generation.benchmark_case import CASE_KINDS
from bench.diagnosis_benchmark.case_generation.recording_conditions import NOISE_KINDS
from sims.core.simulator import InputError
from sims.core.toml_validation import (
    check_entries,
    check_known_names,
    get_type_hints_of,
    make_error,
)

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
                    "experiment", "diagnosis.questions", one, get_type_hints_of(CaseRequest)
                )
            )
            for one in self.questions
        )


def read_config(experiment: Experiment) -> BenchmarkConfig:
    """Read and validate the ``[diagnosis]`` table of an experiment.

    Raises:
        InputError: a key or value is not allowed.
    """
    who = f"experiment {experiment.name}"
    given = check_entries(
        who, "diagnosis", dict(experiment.diagnosis), get_type_hints_of(BenchmarkConfig)
    )
    settings = BenchmarkConfig(**given)
    if not settings.diagnosers:
        raise make_error(who, "diagnosis.diagnosers", "one or more names", "none")
    if not settings.questions:
        raise make_error(who, "diagnosis.questions", "one or more tables", "none")
    if len(set(settings.diagnosers)) < len(settings.diagnosers):
        raise make_error(who, "diagnosis.diagnosers", "each once", list(settings.diagnosers))
    if settings.sample < 0 or settings.seed < 0:
        raise InputError(f"{who}: diagnosis: expected seed and sample of at least 0")
    for one in settings.case_requests:
        check_known_names("kind", [one.kind], CASE_KINDS)
        check_known_names("system", one.systems, ALL_SYSTEMS)
        check_known_names("noise", one.noises, NOISE_KINDS)
        if not 1 <= one.count <= _MAX_CASES:
            raise make_error(who, "diagnosis.questions.count", f"1 to {_MAX_CASES}", one.count)
        if not all(0.0 < size <= MAX_EFFECT_SIZE for size in one.sizes):
            raise make_error(
                who, "diagnosis.questions.sizes", f"above 0, up to {MAX_EFFECT_SIZE:g}", one.sizes
            )
        if not all(10 <= rate <= 1000 for rate in one.rates):
            raise make_error(who, "diagnosis.questions.rates", "10 to 1000 Hz", one.rates)
        if not all(2 <= runs <= 6 for runs in one.runs):
            raise make_error(who, "diagnosis.questions.runs", "2 to 6", one.runs)
    return settings
