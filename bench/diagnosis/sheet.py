"""The sheet of questions that an experiment asks: what is hidden in which circumstances, and the
seed from which all else is drawn.

With the public salt a question's seed is a small number that everybody knows. With a secret one it
is a part of a hash of salt and question, which says nothing of either.
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
"""Drawings of one question, if what is drawn cannot show what it hides."""
_APART = 1000
"""Seeds of two public exams of one form are so far apart, and those of two questions ten."""


@dataclass(frozen=True)
class Question:
    """What to draw.

    Attributes:
        kind: clean, single, double or foreign.
        system: its name.
        effect: what is hidden; of two the first; None where it is drawn.
        size: in units of the noise; None where it is drawn.
        asked: circumstances that are not drawn.
        index: tells questions of one sort apart.
    """

    kind: str
    system: str
    effect: str | None
    size: float | None
    asked: Circumstances
    index: int

    @property
    def name(self) -> str:
        """Unique in a sheet."""
        words = [self.kind, self.system]
        words += [self.effect] if self.effect else []
        words += [f"{self.size:g}"] if self.size else []
        words += [str(part) for part in self.asked if part is not None]
        return "/".join([*words, str(self.index)])

    def json(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    @classmethod
    def of(cls, document: dict[str, Any]) -> Question:
        """A question from its JSON."""
        return cls(**{**document, "asked": Circumstances(*document["asked"])})

    def drawn(self, seed: int, salt: str = PUBLIC) -> Item | None:
        """The first of several drawings that shows what it hides; None where none does.

        Args:
            seed: of the public questions.
            salt: secret, or `PUBLIC`.
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
        # Spaced, as the public ones are, for the further attempts.
        return 10 * int(hashlib.sha256(text.encode()).hexdigest()[:14], 16)


def sheet(settings: Settings) -> list[Question]:
    """All questions, in an order that does not depend on the table's.

    Raises:
        InputError: an effect that a system cannot hide.
    """
    numbers: dict[tuple[Any, ...], int] = {}
    questions = []
    for asked in settings.asked:
        for kind, system, effect, size, circumstances in _combined(asked):
            key = kind, system, effect, size, circumstances
            # Sizes are no part of it: questions of two sizes are not of one draw.
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
    """What questions hide; None where it is drawn."""
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
