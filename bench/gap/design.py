"""Design of the next recording: commands that decide what the present recording leaves open.

Runs that an experimenter could make (`rig.plans`), within the limits of the rig (`rig.limits`), are
simulated and ranked by their value (`rig.worth`). The best plans are then varied, one property at a
time.
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
"""Maximum number of rounds in which the best plans are varied."""
VARIED = 2
"""Number of plans that are varied in each round."""
LENGTHENED = 8
"""Maximum number of plans that are also tested with a longer run."""


@dataclass(frozen=True)
class Design:
    """Design of the next recording.

    Attributes:
        says: Commands in words.
        by: Criterion: ``T`` if the run distinguishes models, ``D`` if it narrows parameters.
        gain: For ``D``, (2) of `rig.worth`, the logarithm of the factor by which the volume of the
            confidence region shrinks; for ``T``, the smallest value of `told`.
        effect: Effect of the present model that is to be distinguished; empty for ``D``.
        told: Discrimination, (1) of `rig.worth`, from each alternative effect; empty for ``D``.
        times: (T,) sample times in seconds.
        inputs: (T,) values by input, each held until the next sample.
        initial: Initial states by name.
        constants: Constants of the run that differ from those of the first run, by name.
        groups: Effects grouped by those that the run would still not distinguish.
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
        """Alternative effects that the run would distinguish from the present effect."""
        return tuple(name for name, value in self.told.items() if value > SPLITS)

    @property
    def settles(self) -> bool:
        """Return whether the run would distinguish all effects, whichever is true."""
        return len(self.groups) == len(self.told) + 1

    def document(self) -> dict[str, Any]:
        """Return the design as JSON data; the command signals are written as a table instead."""
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
    """Design the best run that could be recorded next.

    Args:
        models: Collection that contains all of the models.
        model: Model of the present diagnosis.
        rivals: Competing models that explain the data as well; empty if there are none.
        seconds: Duration of the run in seconds.
        longest: Maximum duration in seconds, if a run of `seconds` does not decide.

    Returns:
        The design; None if no run can be simulated.
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
    """Return whether a longer run may distinguish models that the best run does not."""
    least = np.minimum(best.values, best.values.T)
    untold = least[(least > 0) & (least <= SPLITS)]
    return times > 1.0 and best.values.ndim == 2 and bool((untold * 2.0 * times > SPLITS).any())


def _asked_in_full(judge: Judge, found: Sequence[Worth]) -> list[Worth]:
    """Sort runs by value, after exact evaluation of the first ones.

    Linearised values tend to be too high.
    """
    ranked = sorted(found, key=by_worth)
    for _ in range(judge.patience):
        first = next((k for k, entry in enumerate(ranked[:VARIED]) if not entry.full), None)
        if first is None or (ranked[0].full and ranked[0].worth >= judge.most):
            break
        ranked[first] = judge.fitted(ranked[first])
        ranked.sort(key=by_worth)
    # Runs that are evaluated exactly come before those that are only linearised.
    return sorted(ranked, key=lambda entry: (not entry.full, *by_worth(entry)))


def _made(models: Models, among: Sequence[Model], rig: Rig, entry: Worth) -> Design:
    """Build the design from the best run."""
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
    """Return the effects that one model has and the other does not have."""
    return " and ".join(name for name in model.names if name not in than.names)


def _groups(names: Sequence[str], least: Array) -> Iterator[tuple[str, ...]]:
    """Yield connected groups of names that are linked by pairs that are not distinguished."""
    left = list(range(len(names)))
    while left:
        group, new = [], [left[0]]
        while new:
            group += new
            left = [place for place in left if place not in new]
            new = [b for b in left if any(least[a, b] <= SPLITS for a in new)]
        yield tuple(names[place] for place in sorted(group))
