"""Set of the cases that an experiment evaluates: hidden cause, conditions and seed of each.

With the public salt, the seed of a case is a small number that everybody can compute. With a secret
salt, it is a part of a hash of salt and case name, which reveals neither.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

from bench.core.random_streams import PUBLIC_SALT, make_rng
from bench.diagnosis_benchmark.benchmark_config import BenchmarkConfig, CaseRequest
from bench.diagnosis_benchmark.case_catalogue import (
    ALL_SYSTEMS,
    draw_case,
    list_hideable_effects,
    list_unmodelled_causes,
)
from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.case_generation.recording_conditions import RequestedConditions
from sims import effects as library
from sims.core.simulator import InputError, make_unknown_name_error

MAX_DRAW_ATTEMPTS = 8
"""Maximum number of attempts to draw a case in which the hidden cause is observable."""
_SEED_STRIDE = 1000
"""Difference between the first seeds of two public case sets; seeds of two cases differ by ten."""


@dataclass(frozen=True)
class CaseSpec:
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
        words = [self.kind, self.system]
        words += [self.effect] if self.effect else []
        words += [f"{self.size:g}"] if self.size else []
        words += [str(part) for part in self.asked if part is not None]
        return "/".join([*words, str(self.index)])

    def to_json(self) -> dict[str, Any]:
        """Convert to plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> CaseSpec:
        """Restore a case specification from its JSON document."""
        return cls(**{**document, "asked": RequestedConditions(*document["asked"])})

    def draw_case(self, seed: int, salt: str = PUBLIC_SALT) -> BenchmarkCase | None:
        """Draw the case; make several attempts if the hidden cause is not observable.

        Args:
            seed: seed of the public case set.
            salt: secret salt, or `PUBLIC_SALT`.

        Returns:
            The first case whose hidden cause is observable; None if all attempts fail.
        """
        first = self._get_first_seed(seed, salt)
        items = (
            draw_case(self.kind, self.system, first + k, self.effect, self.size, self.asked)
            for k in range(MAX_DRAW_ATTEMPTS)
        )
        return next((item for item in items if item is not None), None)

    def _get_first_seed(self, seed: int, salt: str) -> int:
        """Return the seed of the first attempt to draw the case; attempt k uses this seed plus k.

        Args:
            seed: seed of the public case set; unused with a secret salt.
            salt: secret salt, or `PUBLIC_SALT`. With a secret salt the seed is a part of the
                SHA-256 hash
                of salt and name, so that the case cannot be computed without the salt.
        """
        if salt in ("", PUBLIC_SALT):
            return _SEED_STRIDE * seed + 10 * self.index
        text = "\x1f".join([salt, self.name])
        # Multiples of ten, as for the public seeds, leave room for the seeds of further attempts.
        return 10 * int(hashlib.sha256(text.encode()).hexdigest()[:14], 16)


def build_case_set(settings: BenchmarkConfig) -> list[CaseSpec]:
    """Build the list of all cases of a comparison.

    The order of the tables in the experiment determines the order of the cases; with `sample`, a
    random subset is selected.

    Raises:
        InputError: an effect cannot be hidden in a system.
    """
    numbers: dict[tuple[Any, ...], int] = {}
    questions = []
    for request in settings.case_requests:
        for kind, system, effect, size, circumstances in _iterate_combinations(request):
            key = kind, system, effect, size, circumstances
            # Sizes are not part of the key, so cases of two sizes have different seeds.
            for _ in range(request.count):
                group = kind, system, effect
                numbers[group] = numbers.get(group, -1) + 1
                questions.append(CaseSpec(*key, index=numbers[group]))
    if not settings.sample or settings.sample >= len(questions):
        return questions
    rng = make_rng("diagnosis", "sample", settings.seed)
    chosen_indices = rng.choice(len(questions), settings.sample, replace=False)
    return [questions[i] for i in sorted(chosen_indices.tolist())]


def _iterate_combinations(
    request: CaseRequest,
) -> Iterator[tuple[str, str, str | None, float | None, RequestedConditions]]:
    """Yield every combination of the values that one table of the experiment lists.

    A list that is empty gives None, which means that the value is drawn at random; effects are then
    all that can be hidden.

    Args:
        request: the table.

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

    Raises:
        InputError: an effect is unknown, or effects are named for clean or double cases.
    """
    if request.kind in ("clean", "double"):
        if request.effects:
            raise InputError(
                f"diagnosis.questions: of {request.kind} questions no effects are named"
            )
        return [None]
    foreign = request.kind == "foreign"
    available_effects = list_unmodelled_causes(system) if foreign else list_hideable_effects(system)
    known_effects = (
        {n for s in ALL_SYSTEMS for n in list_unmodelled_causes(s)}
        if foreign
        else set(library.registry.names())
    )
    for name in request.effects:
        if name not in known_effects:
            raise make_unknown_name_error(
                "foreign cause" if foreign else "effect", name, available_effects
            )
    return [name for name in available_effects if not request.effects or name in request.effects]
