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
                    "experiment", "diagnosis.questions", table, get_type_hints_of(CaseRequest)
                )
            )
            for table in self.questions
        )


def read_config(experiment: Experiment) -> BenchmarkConfig:
    """Read and validate the ``[diagnosis]`` table of an experiment.

    Raises:
        InputError: a key or value is not allowed.
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
        if not all(10 <= rate <= 1000 for rate in request.rates):
            raise make_error(subject, "diagnosis.questions.rates", "10 to 1000 Hz", request.rates)
        if not all(2 <= runs <= 6 for runs in request.runs):
            raise make_error(subject, "diagnosis.questions.runs", "2 to 6", request.runs)
    return settings
