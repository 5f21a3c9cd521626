"""Every question that can be drawn, whatever it is about: ball, pendulum and slider by scipy and
MuJoCo (`bench.diagnosis.worlds.items`), a servo and an arm of two joints by equations of their own
(`bench.diagnosis.worlds.machines`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from bench.diagnosis.worlds import items
from bench.diagnosis.worlds.item import Item
from bench.diagnosis.worlds.machines import causes
from bench.diagnosis.worlds.machines import items as machines
from bench.diagnosis.worlds.settings import ANY, Circumstances
from bench.diagnosis.worlds.world import FOREIGN, SIMULATORS
from sims import effects as library
from sims.servo.simulator import Servo

SYSTEMS = (*items.SYSTEMS, *machines.SYSTEMS)
"""What can be asked about."""
USUAL = items.SYSTEMS
"""What is asked about where an experiment names no systems."""


class Texts(NamedTuple):
    """A recording as texts of files.

    Attributes:
        table: CSV.
        description: TOML.
        beside: other files, by name.
    """

    table: str
    description: str
    beside: Mapping[str, str]


def draw(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    asked: Circumstances = ANY,
) -> Item | None:
    """An item, or None where what is recorded cannot show it; see
    `bench.diagnosis.worlds.items.draw`.
    """
    by = machines.draw if system in machines.SYSTEMS else items.draw
    return by(kind, system, seed, effect, size, asked)


def hidden_in(system: str) -> list[str]:
    """Effects of the library that can be hidden."""
    if system in machines.SYSTEMS:
        return list(causes.EFFECTS[system])
    return sorted(library.library(SIMULATORS[system].system))


def foreign_to(system: str) -> list[str]:
    """Causes that the library does not have."""
    return list(causes.FOREIGN if system in machines.SYSTEMS else FOREIGN[system])


def same_class(item: Item, effect: str) -> frozenset[str]:
    """The effect and all that are equivalent to it in an item's recording."""
    if item.system in machines.SYSTEMS:
        return machines.same_class(item.system, effect)
    return items.same_class(item.system, item.driven, effect)


def coefficients_of(system: str, name: str) -> list[str]:
    """Names of an effect's coefficients, in the order of an item's numbers."""
    effect = library.get(name.partition("@")[0])
    if system == "arm2":
        return [coefficient.name for coefficient in effect.coefficients]
    of = Servo.system if system == "servo" else SIMULATORS[system].system
    return [coefficient.name for coefficient in effect.on(of)]


def texts_of(item: Item) -> Texts:
    """The recording of an item."""
    with tempfile.TemporaryDirectory() as folder:
        if item.system in machines.SYSTEMS:
            path = machines.written(item, Path(folder))
        else:
            path = items.realise(item, folder, truth=False)
        description = path.with_suffix(".toml")
        others = [one for one in sorted(Path(folder).iterdir()) if one not in (path, description)]
        beside = {one.name: one.read_text("utf-8") for one in others}
        return Texts(path.read_text("utf-8"), description.read_text("utf-8"), beside)
