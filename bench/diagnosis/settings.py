"""The ``[diagnosis]`` table of an experiment: diagnosers and cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bench.diagnosis.worlds.item import KINDS
from bench.diagnosis.worlds.questions import SYSTEMS, USUAL
from bench.diagnosis.worlds.settings import NOISES
from bench.problem.experiment import Experiment
from sims.base import InputError
from sims.user_toml import entries, fault, hints_of, known

LARGEST = 30.0
"""Maximum size of a hidden effect, in units of the noise."""
_MOST = 10_000
"""Maximum number of cases per combination of conditions."""


@dataclass(frozen=True)
class Asked:
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
    systems: tuple[str, ...] = USUAL
    effects: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    rates: tuple[int, ...] = ()
    runs: tuple[int, ...] = ()
    noises: tuple[str, ...] = ()
    count: int = 1


@dataclass(frozen=True)
class Settings:
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
    def asked(self) -> tuple[Asked, ...]:
        """Case specifications, with validated keys."""
        return tuple(
            Asked(**entries("experiment", "diagnosis.questions", one, hints_of(Asked)))
            for one in self.questions
        )


def settings_of(experiment: Experiment) -> Settings:
    """Read and validate the ``[diagnosis]`` table of an experiment.

    Raises:
        InputError: a key or value is not allowed.
    """
    who = f"experiment {experiment.name}"
    given = entries(who, "diagnosis", dict(experiment.diagnosis), hints_of(Settings))
    settings = Settings(**given)
    if not settings.diagnosers:
        raise fault(who, "diagnosis.diagnosers", "one or more names", "none")
    if not settings.questions:
        raise fault(who, "diagnosis.questions", "one or more tables", "none")
    if len(set(settings.diagnosers)) < len(settings.diagnosers):
        raise fault(who, "diagnosis.diagnosers", "each once", list(settings.diagnosers))
    if settings.sample < 0 or settings.seed < 0:
        raise InputError(f"{who}: diagnosis: expected seed and sample of at least 0")
    for one in settings.asked:
        known("kind", [one.kind], KINDS)
        known("system", one.systems, SYSTEMS)
        known("noise", one.noises, NOISES)
        if not 1 <= one.count <= _MOST:
            raise fault(who, "diagnosis.questions.count", f"1 to {_MOST}", one.count)
        if not all(0.0 < size <= LARGEST for size in one.sizes):
            raise fault(who, "diagnosis.questions.sizes", f"above 0, up to {LARGEST:g}", one.sizes)
        if not all(10 <= rate <= 1000 for rate in one.rates):
            raise fault(who, "diagnosis.questions.rates", "10 to 1000 Hz", one.rates)
        if not all(2 <= runs <= 6 for runs in one.runs):
            raise fault(who, "diagnosis.questions.runs", "2 to 6", one.runs)
    return settings
