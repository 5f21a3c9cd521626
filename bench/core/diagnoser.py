"""Interface of diagnosers: a recording in, a verdict with named causes out.

A diagnoser says what a simulation gets wrong on a recording. It is a class with a name and one
method::

    class Whiteness(Diagnoser):
        name = "whiteness"

        def diagnose(self, case):
            ...
            return "adequate"

Its input is what a user has (`DiagnosisCase`): the recording, the simulator, the library of
effects, the noise if it is stated, and held-out runs. It never gets the true causes, nor anything
from which they follow. It returns an `Answer`, a word of `VERDICTS`, or a dictionary like
verdict.json.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from sims import effects as effects_library
from sims.core.effect import Effect
from sims.core.simulation_counter import SIMULATION_COUNTER
from sims.core.simulator import Array, InputError, Scenario
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

VERDICTS = ("adequate", "named", "ambiguous", "partial", "unknown", "unidentifiable")
"""Possible verdicts; see docs/verdict.md."""
_MAX_CAUSES = 20
"""Maximum number of causes in an answer."""
_MAX_ALTERNATIVES = 200
"""Maximum number of alternative effects of one cause in an answer."""


@dataclass(frozen=True)
class NamedCause:
    """Cause that a diagnoser names.

    Attributes:
        effect: name of the effect in the library.
        alternatives: effects that would explain the recording as well.
        coefficients: 95 % intervals (low, high) by name; an end is None if it is open.
        p_value: p-value under the hypothesis that the effect is absent; None if the method gives
            none.
    """

    effect: str
    alternatives: tuple[str, ...] = ()
    coefficients: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    p_value: float | None = None

    def document(self) -> dict[str, Any]:
        """Convert to a JSON document like verdict.json."""
        return {
            "effect": self.effect,
            "alternatives": list(self.alternatives),
            "coefficients": _convert_intervals(self.coefficients),
            "p_value": self.p_value,
        }


@dataclass(frozen=True)
class Answer:
    """Conclusion of a diagnoser.

    Attributes:
        verdict: one of `VERDICTS`.
        causes: missing effects; each is one effect, or a set of effects that the data cannot
            distinguish.
        parameters: 95 % intervals (low, high) of the system's own parameters, by name.
        p_value: p-value under the hypothesis that nothing is missing; None if the method gives
            none.
    """

    verdict: str
    causes: tuple[NamedCause, ...] = ()
    parameters: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    p_value: float | None = None

    @classmethod
    def of(cls, given: object) -> Answer:
        """Convert what a diagnoser returned into an answer.

        Args:
            given: Answer, verdict alone, or mapping with the keys of an answer.

        Raises:
            InputError: it is not a valid answer.
        """
        if isinstance(given, Answer):  # a plugin may have filled it with invalid values
            return cls.of(given.document())
        if isinstance(given, str):
            given = {"verdict": given}
        if not isinstance(given, Mapping):
            raise InputError(f"an answer: expected an Answer or a verdict, found {given!r:.80}")
        verdict = given.get("verdict")
        if verdict not in VERDICTS:
            raise InputError(f"verdict: expected one of {', '.join(VERDICTS)}, found {verdict!r}")
        causes = _check_list("causes", given.get("causes") or [], _MAX_CAUSES)
        parameters = _read_intervals("parameters", given.get("parameters") or {})
        p_value = _convert_p_value(given.get("p_value"))
        named_causes = tuple(_convert_cause(cause) for cause in causes)
        return cls(str(verdict), named_causes, parameters, p_value)

    def document(self) -> dict[str, Any]:
        """Convert to a JSON document with the keys of verdict.json that a diagnoser provides."""
        return {
            "verdict": self.verdict,
            "causes": [cause.document() for cause in self.causes],
            "parameters": _convert_intervals(self.parameters),
            "p_value": self.p_value,
        }


@dataclass(frozen=True)
class DiagnosisCase:
    """Input of a diagnoser.

    Attributes:
        path: CSV file of the recording; its description is in the same folder, which the diagnoser
            may write to.
        recording: the recording as an object: runs for fitting and held-out runs, constants, stated
            noise.
        kind: class of the simulator; all its simulations are counted.
        library: effects that may be missing, by name: those whose signals are recorded.
        rng: the only source of random numbers.
        budget: maximum number of simulations.
        seconds: maximum time.
        learned: trained arrays by name, from the method `train`.
        start_time: start of the diagnosis, on the clock of `time.perf_counter`.
    """

    path: Path
    recording: Recording
    kind: type[SystemSimulator]
    library: Mapping[str, type[Effect]]
    rng: np.random.Generator
    budget: int
    seconds: float
    learned: Mapping[str, Array] = field(default_factory=dict)
    start_time: float = field(default_factory=perf_counter)

    @property
    def used(self) -> int:
        """Number of simulations made so far."""
        return SIMULATION_COUNTER.used

    @property
    def left(self) -> float:
        """Remaining time in seconds."""
        return self.start_time + self.seconds - perf_counter()

    def simulate(
        self,
        run: Run,
        parameters: Mapping[str, float] | None = None,
        effects: Mapping[str, Sequence[float]] | None = None,
        initial: Mapping[str, float] | None = None,
    ) -> dict[str, Array]:
        """Simulate one run.

        Args:
            run: its times, inputs and initial states are used.
            parameters: parameters of the system by name; nominal values for the others.
            effects: coefficients by name of the effects that act.
            initial: initial states by name. They replace those of the run, and these the defaults
                of the system.

        Returns:
            Recorded channels (T,) by name.
        """
        recorded = [channel.name for channel in self.kind.channels if channel.name in run.channels]
        fixed = {name: list(coefficients) for name, coefficients in (effects or {}).items()}
        constants = {**self.recording.constants, **run.constants}
        # A robot's simulator, for example, has its own engine; others use the batch engine.
        engine = None if self.kind.own_engine else "batch"
        simulator = self.kind(constants, recorded, engine=engine, fixed=fixed)
        values = parameters or {}
        theta = [
            values.get(parameter.name, parameter.nominal) for parameter in simulator.parameters
        ]
        initial_states = {**self.kind.states, **run.initial, **(initial or {})}
        scenario = Scenario(run.times, initial_states, dict(run.inputs))
        try:
            observed = simulator.simulate(np.array([theta]), scenario)[0]
        finally:
            simulator.close()
        return dict(zip(recorded, observed.T, strict=True))


@dataclass(frozen=True)
class DiagnoserTrainingTask:
    """Training task of a diagnoser: a system and a budget of simulations.

    Attributes:
        kind: class of the simulator.
        library: effects that may be missing.
        rng: the only source of random numbers.
        budget: maximum number of simulations; they are counted and reported separately.
    """

    kind: type[SystemSimulator]
    library: Mapping[str, type[Effect]]
    rng: np.random.Generator
    budget: int


class Diagnoser(ABC):
    """Base class of diagnosers, which say what a simulation gets wrong on a recording.

    Attributes:
        name: registered name.
        learned: whether `train` must be called before `diagnose`.
        requires: packages that it needs in addition to those of simgap.
        known_failures: conformance checks that fail on purpose, each with the reason.
    """

    name: ClassVar[str]
    learned: ClassVar[bool] = False
    requires: ClassVar[tuple[str, ...]] = ()
    known_failures: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def diagnose(self, case: DiagnosisCase) -> Answer | str | Mapping[str, Any]:
        """Diagnose what is missing in the simulation of a recording."""

    def cannot(self, kind: type[SystemSimulator]) -> str:  # noqa: ARG002
        """Return why recordings of a simulator are not supported; empty if they are.

        Such cases count as skipped and not as failed. The method does not see any recording, so
        that no diagnoser can select its cases.
        """
        return ""

    def train(self, task: DiagnoserTrainingTask) -> Mapping[str, Array]:  # noqa: ARG002
        """Train once for a system, before any recording is available.

        Returns:
            Trained arrays by name; they are passed on in `DiagnosisCase.learned`.
        """
        return {}


def list_observable_effects(
    kind: type[SystemSimulator], recording: Recording
) -> dict[str, type[Effect]]:
    """Return the effects of the library that a recording can show, by name.

    An effect that changes one signal only, as the gain of a sensor, needs this channel or input.

    Args:
        kind: class of the simulator.
        recording: recorded runs, with their channels, inputs and constants.
    """
    signals = {*recording.runs[0].channels, *(channel.name for channel in kind.inputs)}
    usable = effects_library.list_effects_for(kind.system)
    return {
        name: effect
        for name, effect in usable.items()
        if not effect.signal or effect.signal in signals
    }


def list_named_sets(answer: Answer) -> list[tuple[str, ...]]:
    """List the sets of effects that an answer names."""
    return [(cause.effect, *cause.alternatives) for cause in answer.causes]


def _convert_cause(cause: object) -> NamedCause:
    """Convert one cause of a diagnoser's answer to a `NamedCause`.

    `cause` is the name of an effect, or a mapping with the key ``effect`` and optionally
    ``alternatives``, ``coefficients`` and ``p_value``. It may come from a plugin, so it can be
    anything.

    Raises:
        InputError: it has another form, which the message states.
    """
    if isinstance(cause, str):
        cause = {"effect": cause}
    if not isinstance(cause, Mapping) or not isinstance(cause.get("effect"), str):
        raise InputError(f"causes: expected effects' names, found {cause!r:.80}")
    alternatives = _check_list("alternatives", cause.get("alternatives") or [], _MAX_ALTERNATIVES)
    if not all(isinstance(name, str) for name in alternatives):
        raise InputError(f"alternatives: expected effects' names, found {alternatives!r:.80}")
    return NamedCause(
        cause["effect"],
        tuple(alternatives),
        _read_intervals("coefficients", cause.get("coefficients") or {}),
        _convert_p_value(cause.get("p_value")),
    )


def _check_list(key: str, values: object, max_count: int) -> list[Any]:
    if not isinstance(values, list | tuple) or len(values) > max_count:
        raise InputError(f"{key}: expected a list of up to {max_count}, found {values!r:.80}")
    return list(values)


def _convert_p_value(p_value: object) -> float | None:
    """Convert a p-value of a diagnoser's answer; None stays None (no p-value given).

    Raises:
        InputError: it is not a number from 0 to 1; NaN is refused too.
    """
    if p_value is None:
        return None
    value = float(p_value) if isinstance(p_value, int | float | np.floating) else math.nan
    if not 0.0 <= value <= 1.0:
        raise InputError(f"p_value: expected a number from 0 to 1, found {p_value!r:.80}")
    return value


def _read_intervals(key: str, intervals: object) -> dict[str, tuple[float | None, float | None]]:
    if not isinstance(intervals, Mapping):
        raise InputError(f"{key}: expected intervals by name, found {intervals!r:.80}")
    return {str(name): _convert_interval(key, value) for name, value in intervals.items()}


def _convert_interval(key: str, interval: object) -> tuple[float | None, float | None]:
    """Convert a confidence interval of a diagnoser's answer to (low, high).

    `interval` is a pair, or a mapping with the keys ``low`` and ``high``. An end that is missing or
    infinite becomes None: the interval is open on this side. `key` names the value in errors.
    """
    if isinstance(interval, Mapping):
        interval = (interval.get("low"), interval.get("high"))
    limits = _check_list(key, interval, 2)
    if len(limits) != 2:
        raise InputError(f"{key}: expected (low, high), found {interval!r:.80}")
    low, high = (
        float(end) if isinstance(end, int | float | np.floating) and math.isfinite(end) else None
        for end in limits
    )
    return low, high


def _convert_intervals(
    intervals: Mapping[str, tuple[float | None, float | None]],
) -> dict[str, dict[str, float | None]]:
    return {name: {"low": low, "high": high} for name, (low, high) in intervals.items()}
