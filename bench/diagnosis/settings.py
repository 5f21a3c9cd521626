"""What an experiment of diagnosers asks, as its ``[diagnosis]`` table says it."""

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
"""Sizes up to which effects are hidden, in units of the noise."""
_MOST = 10_000
"""Questions of an experiment at most."""


@dataclass(frozen=True)
class Asked:
    """Questions of one sort.

    Attributes:
        kind: clean, single, double or foreign.
        systems: each of them.
        effects: each of them; empty for all that can be hidden. Of double and clean questions
            none: what is hidden is drawn.
        sizes: each of them, in units of the noise; empty for one that is drawn.
        rates: each of them, Hz; empty for one that is drawn.
        runs: likewise, numbers of runs.
        noises: likewise, white, ar1 or quantised.
        count: how many of each combination.
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
        diagnosers: registered names.
        seed: of the public questions; another one gives another exam of the same form.
        sample: ask only so many of the questions, chosen at random; 0 for all.
        questions: what is asked.
    """

    diagnosers: tuple[str, ...] = ()
    seed: int = 0
    sample: int = 0
    questions: tuple[Mapping[str, Any], ...] = field(default_factory=tuple)

    @property
    def asked(self) -> tuple[Asked, ...]:
        """The questions, checked."""
        return tuple(
            Asked(**entries("experiment", "diagnosis.questions", one, hints_of(Asked)))
            for one in self.questions
        )


def settings_of(experiment: Experiment) -> Settings:
    """The table of an experiment.

    Raises:
        InputError: a key or value that it cannot have.
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
