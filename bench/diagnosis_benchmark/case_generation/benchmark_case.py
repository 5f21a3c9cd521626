"""Benchmark case: recipe of a recording with a hidden cause, and its true causes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    RequestedConditions,
)

CASE_KINDS = ("clean", "single", "double", "foreign")
"""Kinds of cases: nothing hidden, one effect, two effects, or a cause outside the library."""


@dataclass(frozen=True)
class BenchmarkCase:
    """Benchmark case.

    Attributes:
        name: composed of kind, system, requested values and seed.
        system: one of `bench.diagnosis_benchmark.case_catalogue.ALL_SYSTEMS`.
        kind: one of `CASE_KINDS`.
        effects: coefficients of the hidden effects, by name; for an unmodelled cause, its own
            numbers.
        size: RMS of the residual in the runs for fitting after base parameters and initial states
            are refitted, in units of the noise; for two effects, that of each alone.
        noise: white, ar1 or quantised.
        stated: whether the recording states the noise.
        rate: sampling rate, Hz.
        seconds: length of a run.
        runs: number of runs.
        source: how the recording is simulated: scipy, mujoco or own equations.
        driven: whether there is an input.
        channels: recorded channels.
        seed: seed from which the case was drawn.
        parameters: true base parameters.
        beyond: RMS residual, in units of the noise, that the best wrong answer leaves: for an
            unmodelled cause the best effect of the library, for two effects one of them, for an
            effect with a simpler form that form.
        asked: recording conditions that were specified and not drawn.
    """

    name: str
    system: str
    kind: str
    effects: dict[str, tuple[float, ...]]
    size: float
    noise: str
    stated: bool
    rate: int
    seconds: float
    runs: int
    source: str
    driven: bool
    channels: tuple[str, ...]
    seed: int
    parameters: dict[str, float] = field(default_factory=dict)
    beyond: float | None = None
    asked: RequestedConditions = ANY_CONDITIONS

    def to_json(self) -> dict[str, Any]:
        """Convert to plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> BenchmarkCase:
        """Restore a case from its JSON document."""
        effects = {name: tuple(c) for name, c in document["effects"].items()}
        fields = {**document, "effects": effects, "channels": tuple(document["channels"])}
        return cls(**{**fields, "asked": RequestedConditions(*document.get("asked", ()))})


def make_case_rng(name: str, purpose: str) -> np.random.Generator:
    """Return the random generator of a case for one purpose, such as its noise.

    The stream follows from both names alone, so a case needs no stored data.
    """
    return np.random.default_rng(list(f"{name} {purpose}".encode()))
