"""The next recording: commands by which what is open would be settled.

Runs that an experimenter could make (`rig.plans`), within what the rig may do (`rig.limits`), are
simulated and ranked by what they tell (`rig.worth`); the best are varied, one thing at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bench.gap.model.models import Model, Models
from bench.gap.rig.plans import Rig
from bench.gap.rig.worth import SPLITS, Judge, Worth, by_worth
from sims.base import Array

ROUNDS = 2
"""Times that the best plans are varied, while one does not settle it."""
VARIED = 2
"""Plans that are varied each time."""
LENGTHENED = 8
"""Plans of which it is asked what longer runs would be worth."""


@dataclass(frozen=True)
class Design:
    """What to record next.

    Attributes:
        says: the commands, in words.
        by: ``T`` where it tells models apart, ``D`` where it narrows numbers.
        gain: (2) there, the logarithm of the factor by which the volume of the intervals
            shrinks; of ``T`` the least of `told`.
        effect: what stands, if it is to be told from others.
        told: (1) of `rig.worth` of each other effect that would explain the same; empty for ``D``.
        times: (T,) seconds.
        inputs: (T,) by name, each value held until the next.
        initial: states to begin from, by name.
        constants: known numbers of the run that are to differ from the first run's, by name.
        groups: the effects by what would still not be told from each other afterwards.
    """

    says: str
    by: Literal["T", "D"]
    gain: float
    effect: str
    told: Mapping[str, float]
    times: Array
    inputs: Mapping[str, Array]
    initial: Mapping[str, float]
    constants: Mapping[str, float]
    groups: tuple[tuple[str, ...], ...] = ()

    @property
    def split(self) -> tuple[str, ...]:
        """Other effects that would be told from what stands."""
        return tuple(name for name, value in self.told.items() if value > SPLITS)

    @property
    def settles(self) -> bool:
        """Whether nothing would be open afterwards, whatever is true."""
        return len(self.groups) == len(self.told) + 1

    def document(self) -> dict[str, Any]:
        """For programs, without the commands themselves, which are a table."""
        return {
            "says": self.says,
            "by": self.by,
            "gain": self.gain,
            "effect": self.effect,
            "told": dict(self.told),
            "split": self.split,
            "settles": self.settles,
            "seconds": float(self.times[-1]),
            "inputs": list(self.inputs),
            "initial": dict(self.initial),
            "constants": dict(self.constants),
            "groups": self.groups,
        }


def design(
    models: Models, model: Model, rivals: Sequence[Model], seconds: float, longest: float
) -> Design | None:
    """The best run that could be recorded next; None where none can be simulated.

    Args:
        models: among which all of them are.
        model: the one that stands.
        rivals: what would explain the same; none where nothing is open.
        seconds: how long the run is to last.
        longest: how long it may last where that many seconds do not settle it.
    """
    rig = Rig(models.world, seconds)
    judge = Judge(models, [model, *rivals])
    found = judge.judged([rig.run(plan) for plan in rig.basic()])
    asked = {entry.run.plan for entry in found}
    for _ in range(ROUNDS):
        found = _asked_in_full(judge, found)
        if not found or found[0].worth >= judge.most or models.world.watch.left():
            break
        plans = [plan for entry in found[:VARIED] for plan in rig.variants(entry.run.plan)]
        new = [plan for plan in dict.fromkeys(plans) if plan not in asked]
        asked.update(new)
        found = [*found, *judge.judged([rig.run(plan) for plan in new])]
    found = _asked_in_full(judge, found)
    if found and _longer_would(found[0], longest / seconds):
        longer = Rig(models.world, longest)
        long = judge.judged([longer.run(entry.run.plan) for entry in found[:LENGTHENED]])
        found = sorted([found[0], *_asked_in_full(judge, long)[:1]], key=by_worth)
    return _made(models, [model, *rivals], rig, found[0]) if found else None


def _longer_would(best: Worth, times: float) -> bool:
    """Whether a run so many times as long may tell what the best one does not."""
    least = np.minimum(best.values, best.values.T)
    untold = least[(least > 0) & (least <= SPLITS)]
    return times > 1.0 and best.values.ndim == 2 and bool((untold * 2.0 * times > SPLITS).any())


def _asked_in_full(judge: Judge, found: Sequence[Worth]) -> list[Worth]:
    """Runs, the best first, of which the first few are asked in full: first steps flatter."""
    ranked = sorted(found, key=by_worth)
    for _ in range(judge.patience):
        first = next((k for k, entry in enumerate(ranked[:VARIED]) if not entry.full), None)
        if first is None or (ranked[0].full and ranked[0].worth >= judge.most):
            break
        ranked[first] = judge.fitted(ranked[first])
        ranked.sort(key=by_worth)
    # What nobody has asked in full stands behind what has been.
    return sorted(ranked, key=lambda entry: (not entry.full, *by_worth(entry)))


def _made(models: Models, among: Sequence[Model], rig: Rig, entry: Worth) -> Design:
    """The best run as what is to be recorded."""
    run, rivals = entry.run, among[1:]
    told: dict[str, float] = {}
    groups: tuple[tuple[str, ...], ...] = ()
    effect, gain = "", float(entry.values[0]) if not rivals else 0.0
    if rivals:
        least = np.minimum(entry.values, entry.values.T)
        stands = among[0]
        names = [_other(one, stands) for one in rivals]
        effect = _other(stands, rivals[0])
        told = {name: float(value) for name, value in zip(names, least[0, 1:], strict=True)}
        groups = tuple(_groups([effect, *names], least))
        gain = min(told.values())
    constants = dict(run.plan.constants)
    return Design(
        says=run.says,
        by="T" if rivals else "D",
        gain=gain,
        effect=effect,
        told=told,
        times=run.scenario.times,
        inputs=dict(run.scenario.inputs),
        initial=dict(zip(models.world.states, run.states.tolist(), strict=True)),
        constants={k: v for k, v in constants.items() if rig.old.constants.get(k) != v},
        groups=groups,
    )


def _other(model: Model, than: Model) -> str:
    """The effect that a model has and the other has not."""
    return " and ".join(name for name in model.names if name not in than.names)


def _groups(names: Sequence[str], least: Array) -> Iterator[tuple[str, ...]]:
    """Names that hang together by pairs that are not told apart, in their order."""
    left = list(range(len(names)))
    while left:
        group, new = [], [left[0]]
        while new:
            group += new
            left = [place for place in left if place not in new]
            new = [b for b in left if any(least[a, b] <= SPLITS for a in new)]
        yield tuple(names[place] for place in sorted(group))
