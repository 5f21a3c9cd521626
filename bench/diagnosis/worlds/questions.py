"""All cases that can be drawn, dispatched by system.

Ball, pendulum and slider are simulated by scipy and MuJoCo (`bench.diagnosis.worlds.items`), a
servo and a two-joint arm by their own equations of motion (`bench.diagnosis.worlds.machines`).
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
"""Names of all systems."""
USUAL = items.SYSTEMS
"""Systems that are used if an experiment does not name any."""


class Texts(NamedTuple):
    """Recording as texts of files.

    Attributes:
        table: CSV text.
        description: TOML text.
        beside: texts of other files, by file name.
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
    """Draw a case; see `bench.diagnosis.worlds.items.draw`.

    Args:
        kind: one of `KINDS`.
        system: one of `SYSTEMS`.
        seed: seed of the case.
        effect: hidden effect; None to draw it.
        size: size in units of the noise; None to draw it.
        asked: recording conditions that are not drawn.

    Returns:
        The case, or None if the hidden cause is not observable.
    """
    by = machines.draw if system in machines.SYSTEMS else items.draw
    return by(kind, system, seed, effect, size, asked)


def hidden_in(system: str) -> list[str]:
    """List the effects of the library that can be hidden in a system."""
    if system in machines.SYSTEMS:
        return list(causes.EFFECTS[system])
    return sorted(library.library(SIMULATORS[system].system))


def foreign_to(system: str) -> list[str]:
    """List the causes for a system that the library does not contain."""
    return list(causes.FOREIGN if system in machines.SYSTEMS else FOREIGN[system])


def same_class(item: Item, effect: str) -> frozenset[str]:
    """Return an effect and all effects that are equivalent to it in the recording of a case."""
    if item.system in machines.SYSTEMS:
        return machines.same_class(item.system, effect)
    return items.same_class(item.system, item.driven, effect)


def coefficients_of(system: str, name: str) -> list[str]:
    """List the names of an effect's coefficients, in the order of the numbers in a case.

    Args:
        system: name of the system.
        name: name of the effect, with or without a place.
    """
    effect = library.get(name.partition("@")[0])
    if system == "arm2":
        return [coefficient.name for coefficient in effect.coefficients]
    of = Servo.system if system == "servo" else SIMULATORS[system].system
    return [coefficient.name for coefficient in effect.on(of)]


def texts_of(item: Item) -> Texts:
    """Render the recording of a case as texts."""
    with tempfile.TemporaryDirectory() as folder:
        if item.system in machines.SYSTEMS:
            path = machines.written(item, Path(folder))
        else:
            path = items.realise(item, folder, truth=False)
        description = path.with_suffix(".toml")
        others = [one for one in sorted(Path(folder).iterdir()) if one not in (path, description)]
        beside = {one.name: one.read_text("utf-8") for one in others}
        return Texts(path.read_text("utf-8"), description.read_text("utf-8"), beside)
