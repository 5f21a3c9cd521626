"""The contract of diagnosers: a recording in, a verdict out.

A diagnoser says what a simulation gets wrong on a recording. It is a class with a name and one
method::

    class Whiteness(Diagnoser):
        name = "whiteness"

        def diagnose(self, case):
            ...
            return "adequate"

It gets what a user has (`Case`): the recording, the simulator, the library of effects, the noise
where it is stated, runs that are held out. It never gets the truth, nor anything that leads to it.
It answers with an `Answer`, with a word of `VERDICTS`, or with a dictionary as verdict.json has it.
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
from sims.base import Array, InputError, Scenario
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated
from sims.system import Effect
from sims.tally import TALLY

VERDICTS = ("adequate", "named", "ambiguous", "partial", "unknown", "unidentifiable")
"""What may be concluded; see docs/verdict.md."""
_MOST_CAUSES = 20
_MOST_ALTERNATIVES = 200


@dataclass(frozen=True)
class Named:
    """A cause that a diagnoser names.

    Attributes:
        effect: its name in the library.
        alternatives: effects that would explain the same as well.
        coefficients: by name (lowest, highest) of a 95 % interval, an end None where it is open.
        p_value: chance of such evidence if it were not there; None where the method gives none.
    """

    effect: str
    alternatives: tuple[str, ...] = ()
    coefficients: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    p_value: float | None = None

    def document(self) -> dict[str, Any]:
        """As in verdict.json."""
        return {
            "effect": self.effect,
            "alternatives": list(self.alternatives),
            "coefficients": _intervals(self.coefficients),
            "p_value": self.p_value,
        }


@dataclass(frozen=True)
class Answer:
    """What a diagnoser concludes.

    Attributes:
        verdict: one of `VERDICTS`.
        causes: what is missing, each a set of one effect or of several that the data cannot tell
            apart.
        parameters: 95 % intervals of the system's own parameters, as those of coefficients.
        p_value: chance of evidence like this if nothing were missing; None where the method gives
            none.
    """

    verdict: str
    causes: tuple[Named, ...] = ()
    parameters: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    p_value: float | None = None

    @classmethod
    def of(cls, given: object) -> Answer:
        """An answer from what a diagnoser returned.

        Raises:
            InputError: it is none.
        """
        if isinstance(given, Answer):
            return cls.of(given.document())
        if isinstance(given, str):
            given = {"verdict": given}
        if not isinstance(given, Mapping):
            raise InputError(f"an answer: expected an Answer or a verdict, found {given!r:.80}")
        verdict = given.get("verdict")
        if verdict not in VERDICTS:
            raise InputError(f"verdict: expected one of {', '.join(VERDICTS)}, found {verdict!r}")
        causes = _list("causes", given.get("causes") or [], _MOST_CAUSES)
        parameters = _read_intervals("parameters", given.get("parameters") or {})
        p = _probability(given.get("p_value"))
        return cls(str(verdict), tuple(_named(cause) for cause in causes), parameters, p)

    def document(self) -> dict[str, Any]:
        """As in verdict.json, as far as a diagnoser says it."""
        return {
            "verdict": self.verdict,
            "causes": [cause.document() for cause in self.causes],
            "parameters": _intervals(self.parameters),
            "p_value": self.p_value,
        }


@dataclass(frozen=True)
class Case:
    """What a diagnoser gets.

    Attributes:
        path: the recording's table, with its description beside it, in a folder of the diagnoser's
            own that it may write to.
        recording: the same, read: runs for fitting and runs held out, constants, stated noise.
        kind: the simulator's class; every simulation that it makes is counted.
        library: the effects that may be missing, by name: those whose signals are recorded.
        rng: the only source of chance.
        budget: simulations that may be made.
        seconds: that it may take.
        learned: arrays by name that its `train` has learned.
    """

    path: Path
    recording: Recording
    kind: type[Simulated]
    library: Mapping[str, type[Effect]]
    rng: np.random.Generator
    budget: int
    seconds: float
    learned: Mapping[str, Array] = field(default_factory=dict)
    begun: float = field(default_factory=perf_counter)

    @property
    def used(self) -> int:
        """Simulations made so far."""
        return TALLY.used

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.begun + self.seconds - perf_counter()

    def simulate(
        self,
        run: Run,
        parameters: Mapping[str, float] | None = None,
        effects: Mapping[str, Sequence[float]] | None = None,
        initial: Mapping[str, float] | None = None,
    ) -> dict[str, Array]:
        """Channels (T,) by name of one run, simulated.

        Args:
            run: says when, under which inputs, from where.
            parameters: of the system; nominal where not given.
            effects: coefficients by name of the effects that act.
            initial: initial states; the system's defaults where neither this nor the run says.
        """
        recorded = [c.name for c in self.kind.channels if c.name in run.channels]
        fixed = {name: list(c) for name, c in (effects or {}).items()}
        constants = {**self.recording.constants, **run.constants}
        engine = None if self.kind.own_engine else "batch"
        made = self.kind(constants, recorded, engine=engine, fixed=fixed)
        given = parameters or {}
        theta = [given.get(p.name, p.nominal) for p in made.parameters]
        begin = {**self.kind.states, **run.initial, **(initial or {})}
        scenario = Scenario(run.times, begin, dict(run.inputs))
        try:
            observed = made.simulate(np.array([theta]), scenario)[0]
        finally:
            made.close()
        return dict(zip(recorded, observed.T, strict=True))


@dataclass(frozen=True)
class Lesson:
    """What a diagnoser learns from: a system, and simulations of its own making.

    Attributes:
        kind: the simulator's class.
        library: the effects that may be missing.
        rng: the only source of chance.
        budget: simulations that may be made; they are counted, and shown apart.
    """

    kind: type[Simulated]
    library: Mapping[str, type[Effect]]
    rng: np.random.Generator
    budget: int


class Diagnoser(ABC):
    """Says what a simulation gets wrong on a recording.

    Attributes:
        name: under which it is registered.
        learned: whether `train` is to be called before.
        requires: packages that it needs beside simgap's own.
        known_failures: checks of its conformance suite that fail on purpose, each with the reason.
    """

    name: ClassVar[str]
    learned: ClassVar[bool] = False
    requires: ClassVar[tuple[str, ...]] = ()
    known_failures: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def diagnose(self, case: Case) -> Answer | str | Mapping[str, Any]:
        """What is missing from the simulation of this recording."""

    def cannot(self, kind: type[Simulated]) -> str:  # noqa: ARG002
        """Why it cannot be asked about recordings of a simulator at all; empty where it can.

        It then counts as skipped there, and not as failed. It sees no recording: nobody chooses his
        questions.
        """
        return ""

    def train(self, lesson: Lesson) -> Mapping[str, Array]:  # noqa: ARG002
        """Learn once for a system, before any recording is seen; what is learned, as arrays."""
        return {}


def library_of(kind: type[Simulated], recording: Recording) -> dict[str, type[Effect]]:
    """The effects that a recording of a system could show, by name."""
    signals = {*recording.runs[0].channels, *(channel.name for channel in kind.inputs)}
    usable = effects_library.library(kind.system)
    return {n: e for n, e in usable.items() if not e.signal or e.signal in signals}


def names_in(answer: Answer) -> list[tuple[str, ...]]:
    """The sets of effects that an answer names."""
    return [(cause.effect, *cause.alternatives) for cause in answer.causes]


def _named(given: object) -> Named:
    if isinstance(given, str):
        given = {"effect": given}
    if not isinstance(given, Mapping) or not isinstance(given.get("effect"), str):
        raise InputError(f"causes: expected effects' names, found {given!r:.80}")
    others = _list("alternatives", given.get("alternatives") or [], _MOST_ALTERNATIVES)
    if not all(isinstance(name, str) for name in others):
        raise InputError(f"alternatives: expected effects' names, found {others!r:.80}")
    return Named(
        given["effect"],
        tuple(others),
        _read_intervals("coefficients", given.get("coefficients") or {}),
        _probability(given.get("p_value")),
    )


def _list(what: str, given: object, most: int) -> list[Any]:
    if not isinstance(given, list | tuple) or len(given) > most:
        raise InputError(f"{what}: expected a list of up to {most}, found {given!r:.80}")
    return list(given)


def _probability(given: object) -> float | None:
    if given is None:
        return None
    value = float(given) if isinstance(given, int | float | np.floating) else math.nan
    if not 0.0 <= value <= 1.0:
        raise InputError(f"p_value: expected a number from 0 to 1, found {given!r:.80}")
    return value


def _read_intervals(what: str, given: object) -> dict[str, tuple[float | None, float | None]]:
    if not isinstance(given, Mapping):
        raise InputError(f"{what}: expected intervals by name, found {given!r:.80}")
    return {str(name): _interval(what, value) for name, value in given.items()}


def _interval(what: str, given: object) -> tuple[float | None, float | None]:
    if isinstance(given, Mapping):
        given = (given.get("low"), given.get("high"))
    ends = _list(what, given, 2)
    if len(ends) != 2:
        raise InputError(f"{what}: expected (low, high), found {given!r:.80}")
    low, high = (
        float(end) if isinstance(end, int | float | np.floating) and math.isfinite(end) else None
        for end in ends
    )
    return low, high


def _intervals(
    given: Mapping[str, tuple[float | None, float | None]],
) -> dict[str, dict[str, float | None]]:
    return {name: {"low": low, "high": high} for name, (low, high) in given.items()}
