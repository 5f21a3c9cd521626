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

from bench.diagnosis.settings import Asked, Settings
from bench.diagnosis.worlds.item import Item
from bench.diagnosis.worlds.questions import SYSTEMS, draw, foreign_to, hidden_in
from bench.diagnosis.worlds.settings import Circumstances
from bench.problem.salt import PUBLIC
from bench.problem.seeds import rng_for
from sims import effects as library
from sims.base import InputError, unknown

ATTEMPTS = 8
"""Maximum number of attempts to draw a case in which the hidden cause is observable."""
_APART = 1000
"""Difference between the first seeds of two public case sets; seeds of two cases differ by ten."""


@dataclass(frozen=True)
class Question:
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
    asked: Circumstances
    index: int

    @property
    def name(self) -> str:
        """Name of the case, unique in a case set."""
        words = [self.kind, self.system]
        words += [self.effect] if self.effect else []
        words += [f"{self.size:g}"] if self.size else []
        words += [str(part) for part in self.asked if part is not None]
        return "/".join([*words, str(self.index)])

    def json(self) -> dict[str, Any]:
        """Convert to plain values for JSON."""
        return asdict(self)

    @classmethod
    def of(cls, document: dict[str, Any]) -> Question:
        """Restore a case specification from its JSON document."""
        return cls(**{**document, "asked": Circumstances(*document["asked"])})

    def drawn(self, seed: int, salt: str = PUBLIC) -> Item | None:
        """Draw the case; make several attempts if the hidden cause is not observable.

        Args:
            seed: seed of the public case set.
            salt: secret salt, or `PUBLIC`.

        Returns:
            The first case whose hidden cause is observable; None if all attempts fail.
        """
        first = self._first(seed, salt)
        items = (
            draw(self.kind, self.system, first + k, self.effect, self.size, self.asked)
            for k in range(ATTEMPTS)
        )
        return next((item for item in items if item is not None), None)

    def _first(self, seed: int, salt: str) -> int:
        if salt in ("", PUBLIC):
            return _APART * seed + 10 * self.index
        text = "\x1f".join([salt, self.name])
        # Multiples of ten, as for the public seeds, leave room for the seeds of further attempts.
        return 10 * int(hashlib.sha256(text.encode()).hexdigest()[:14], 16)


def sheet(settings: Settings) -> list[Question]:
    """Build the list of all cases of a comparison.

    The order of the tables in the experiment determines the order of the cases; with `sample`, a
    random subset is selected.

    Raises:
        InputError: an effect cannot be hidden in a system.
    """
    numbers: dict[tuple[Any, ...], int] = {}
    questions = []
    for asked in settings.asked:
        for kind, system, effect, size, circumstances in _combined(asked):
            key = kind, system, effect, size, circumstances
            # Sizes are not part of the key, so cases of two sizes have different seeds.
            for _ in range(asked.count):
                group = kind, system, effect
                numbers[group] = numbers.get(group, -1) + 1
                questions.append(Question(*key, index=numbers[group]))
    if not settings.sample or settings.sample >= len(questions):
        return questions
    rng = rng_for("diagnosis", "sample", settings.seed)
    chosen = rng.choice(len(questions), settings.sample, replace=False)
    return [questions[i] for i in sorted(chosen.tolist())]


def _combined(asked: Asked) -> Iterator[tuple[str, str, str | None, float | None, Circumstances]]:
    for system in asked.systems:
        effects = _effects(asked, system)
        combinations = product(
            effects,
            asked.sizes or (None,),
            asked.rates or (None,),
            asked.runs or (None,),
            asked.noises or (None,),
        )
        for effect, size, rate, runs, noise in combinations:
            yield asked.kind, system, effect, size, Circumstances(rate, runs, noise)


def _effects(asked: Asked, system: str) -> list[str | None]:
    """List the effects that cases of one system hide; None stands for an effect that is drawn.

    Raises:
        InputError: an effect is unknown, or effects are named for clean or double cases.
    """
    if asked.kind in ("clean", "double"):
        if asked.effects:
            raise InputError(f"diagnosis.questions: of {asked.kind} questions no effects are named")
        return [None]
    foreign = asked.kind == "foreign"
    there = foreign_to(system) if foreign else hidden_in(system)
    every = (
        {n for s in SYSTEMS for n in foreign_to(s)} if foreign else set(library.registry.names())
    )
    for name in asked.effects:
        if name not in every:
            raise unknown("foreign cause" if foreign else "effect", name, there)
    return [name for name in there if not asked.effects or name in asked.effects]
