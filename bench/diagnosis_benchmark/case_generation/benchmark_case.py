"""A case of the diagnosers' benchmark: hidden causes, their size, its name and random streams."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import EffectCoefficients
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    RequestedConditions,
)
from sims.core.json_documents import Document
from sims.recording.recording import DeclaredSignals, Recording

MIN_DISTINCT_SIZE = 1.0
"""Minimum RMS residual that a wrong answer must leave, in units of the noise.

A wrong answer is one of two hidden effects alone, or library effects for an unmodelled cause.
"""

MIN_SIMPLER_RESIDUAL = 0.4
"""Minimum RMS residual that the simpler form of an effect must leave, in units of the noise.

Below it, the simpler form is a correct answer.
"""

CASE_KINDS = ("clean", "single", "double", "foreign")
"""Kinds of cases: nothing hidden, one effect, two effects, or a cause outside the library."""


@dataclass(frozen=True)
class BenchmarkCase(Document):
    """Benchmark case.

    Attributes:
        name: composed of kind, system, requested values and seed.
        system: one of `bench.diagnosis_benchmark.case_set.ALL_SYSTEMS`.
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

    def hide(
        self,
        causes: Sequence[str],
        size: float,
        find_coefficients: Callable[[str], tuple[float, ...] | None],
        compute_unexplained: Callable[[EffectCoefficients], float | None],
    ) -> BenchmarkCase | None:
        """Hide causes in a case, unless a wrong answer would explain the recording as well.

        A wrong answer is the simpler form of a single effect, one of two effects, or the best
        effect of the library for an unmodelled cause (one that no effect describes). The residual
        that it leaves must be at least `MIN_SIMPLER_RESIDUAL` for a simpler form, otherwise
        `MIN_DISTINCT_SIZE`.

        Args:
            causes: names of the causes.
            size: size of each cause alone, in units of the noise.
            find_coefficients: finds the coefficients of a cause with this size; None if it
                finds none.
            compute_unexplained: computes, from the coefficients of the causes by name, the RMS
                residual that the best wrong answer leaves, or None without such an answer.

        Returns:
            The case; None if it is rejected or no coefficients give this size.
        """
        effects = {}
        for name in causes:
            coefficients = find_coefficients(name)
            if coefficients is None:
                return None
            effects[name] = coefficients
        # A lag of the input comes last: nonlinear input effects act on the command.
        effects = {
            name: effects[name] for name in sorted(effects, key=lambda name: name == "input.lag")
        }
        beyond = compute_unexplained(effects)
        least = MIN_SIMPLER_RESIDUAL if self.kind == "single" else MIN_DISTINCT_SIZE
        if beyond is not None and beyond < least:
            return None
        return replace(self, effects=effects, size=size, beyond=beyond)


class RecordedCase(NamedTuple):
    """Recording of a case.

    Attributes:
        recording: the recording; the path of a model file is its name.
        declared: system, for the units.
        extra_files: texts of other files, by file name.
    """

    recording: Recording
    declared: DeclaredSignals
    extra_files: Mapping[str, str] = {}


def name_case(
    kind: str,
    system: str,
    effect: str,
    size: float | None,
    requested: RequestedConditions,
    number: int,
    separator: str = "-",
) -> str:
    """Compose the name of a case or of its specification, such as ``single-ball-wind-3``.

    Parts that are empty, or None because they are drawn, are left out.

    Args:
        kind: one of `CASE_KINDS`.
        system: name of the system.
        effect: hidden effect, or a word for it; left out if empty.
        size: requested size; None leaves it out of the name.
        requested: requested recording conditions; those that are drawn are left out.
        number: number that distinguishes the case from others.
        separator: text between the parts.
    """
    # The values of `requested` are rate, number of runs and kind of noise.
    parts = [kind, system, effect, f"{size:g}" if size else "", *requested, number]
    return separator.join(str(part) for part in parts if part not in ("", None))


def draw_size(kind: str, size: float | None, rng: np.random.Generator) -> float:
    """Return the size of the hidden causes in units of the noise; draw it unless it is requested.

    It is log-uniform from 1 to 10, or from 3 for cases of kind double (two effects) and foreign (a
    cause that no effect of the library describes), which must be clearly visible.

    Args:
        kind: kind of the case: clean, single, double or foreign.
        size: requested size; None to draw it.
        rng: random generator.
    """
    low = 3.0 if kind in ("double", "foreign") else 1.0
    return size or float(np.exp(rng.uniform(np.log(low), np.log(10.0))))


def make_case_rng(name: str, purpose: str) -> np.random.Generator:
    """Return the random generator of a case for one purpose, such as its noise.

    The stream follows from both names alone, so the recording of a case can be simulated again and
    need not be stored.
    """
    return np.random.default_rng(list(f"{name} {purpose}".encode()))
