"""The drive and back-drive diagram: by what force a drive at rest moves a load, holds it, or slips.

With U the force of the motor and P that which it works against, both along the joint, dry friction
holds what pulls less than the limits F of all laws together at rest (M. Duclusaud et al., 2024,
arXiv:2410.08650, section III), which may grow with U and P, and f is what pulls at rest besides:

    U - P + f >  F(U, P)    moves forward                                                       (1)
    U - P + f < -F(U, P)    moves back: where P > 0 the load drives the motor                   (2)

and the joint holds between. The laws are those of the registered effects, asked at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.gap.sheet.subject import Subject
from sims import effects as library
from sims.base import Array
from sims.extended import Extended
from sims.system import Effect, Force, Friction, Hidden, Kind, Moment, System

POINTS = 201
"""Loads of the diagram."""
HALVINGS = 80
"""Of the interval in which a boundary lies."""
FAR = 1e3
"""Forces are looked for up to so many times the reach of the diagram."""
ROUNDING = 1e-12
"""Share of that which is none."""
WIDE = 4.0
"""Without a limit of the drive the diagram reaches so many times the friction without load."""


class _Bench(System):
    """A joint whose drive and load are given."""

    name = "bench"
    says = "a joint between a drive and a load"
    kind: ClassVar[Kind] = "rotary"
    parameters = ()
    channels = ()
    coordinates = ("q",)
    rates = ("qd",)
    states: ClassVar[Mapping[str, float]] = {}
    sensed = ()

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Nothing moves."""
        raise NotImplementedError

    def weight(self, moment: Moment) -> Array:
        """The load pulls back."""
        return -self.passive(moment)

    def drive(self, moment: Moment) -> Array:
        """As given."""
        return moment.inputs["drive"]

    def passive(self, moment: Moment) -> Array:
        """As given."""
        return moment.inputs["load"]

    def observe(self, x: Array, v: Array, a: Array, constants: Any) -> dict[str, Array]:
        """Nothing."""
        raise NotImplementedError


class _Slide(_Bench):
    """The same of a joint that slides."""

    kind: ClassVar[Kind] = "linear"


@dataclass(frozen=True)
class Diagram:
    """The diagram.

    Attributes:
        unit: of all forces.
        load: (N,) what the drive works against.
        forward: (N,) the drive's force above which the joint moves forward; infinite where it locks
            itself.
        back: (N,) that below which it moves back.
        breakaway: the drive's force that moves it without a load.
        backdrive: the load that moves it without a drive; infinite where none does.
        laws: names of the effects in it.
        without: names of those at the joint that have a state of their own, and no law at rest.
        reach: of the axes.
    """

    unit: str
    load: Array
    forward: Array
    back: Array
    breakaway: float
    backdrive: float
    laws: tuple[str, ...]
    reach: float
    without: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """As TOML, with the laws that it rests on."""
        return {
            "unit": self.unit,
            "laws": list(self.laws),
            "breakaway": self.breakaway,
            "backdrive": self.backdrive,
            "load": self.load[:: POINTS // 10].tolist(),
            "forward": self.forward[:: POINTS // 10].tolist(),
            "back": self.back[:: POINTS // 10].tolist(),
        }


def diagram(subject: Subject, extended: Extended, strongest: float | None) -> Diagram:
    """The diagram of a joint.

    Args:
        subject: the joint.
        extended: its model.
        strongest: force of the drive at its limit; None where it has none.
    """
    found = _Joint(subject, extended)
    zero = np.zeros(1)
    alone = float(found.friction(zero, zero)[0])
    reach = strongest or WIDE * alone or 1.0
    load = np.linspace(-reach, reach, POINTS)
    far = FAR * reach

    def ahead(u: Array, p: Array) -> Array:
        return u - p + found.pull(u, p) - found.friction(u, p)  # (1)

    def behind(u: Array, p: Array) -> Array:
        return u - p + found.pull(u, p) + found.friction(u, p)  # (2)

    def unpowered(p: Array) -> Array:
        return -behind(np.zeros_like(p), p)

    return Diagram(
        "N" if found.system.kind == "linear" else "N*m",
        load,
        _root(lambda u: ahead(u, load), far, POINTS),
        _root(lambda u: behind(u, load), far, POINTS),
        float(_root(lambda u: ahead(u, zero), far, 1)[0]),
        float(_root(unpowered, far, 1)[0]),
        found.names,
        reach,
        found.without,
    )


def _root(growing: Callable[[Array], Array], far: float, count: int) -> Array:
    """(N,) where functions that grow pass zero; infinite where they do not within reach."""
    low, high = np.full(count, -far), np.full(count, far)
    never, always = growing(high) <= 0, growing(low) > 0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        above = growing(middle) > 0
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    # What halving leaves of a zero is rounding.
    middle = np.where(np.abs(high) < ROUNDING * far, 0.0, 0.5 * (low + high))
    root: Array = np.where(never, np.inf, np.where(always, -np.inf, middle))
    return root


class _Joint:
    """The laws of a joint, asked at rest."""

    def __init__(self, subject: Subject, extended: Extended) -> None:
        self.system = _Slide() if subject.linear else _Bench()
        self.laws: list[tuple[Effect, Array]] = []
        self.without: tuple[str, ...] = ()
        by_effect: dict[str, dict[str, float]] = {}
        for name, numbers in extended.effects.items():
            for effect, coefficient, number in subject.own(name, numbers):
                by_effect.setdefault(effect, {})[coefficient] = number.value
        for name, values in by_effect.items():
            law = library.get(name.partition("@")[0])
            # What a drive's own law does is in the force that it gives.
            if issubclass(law, Hidden):
                self.without = (*self.without, law.name)
            elif law.at == "joint" and issubclass(law, Friction | Force):
                c = np.array([values.get(one.name, 0.0) for one in law.coefficients])
                self.laws.append((law(), c[:, None, None]))
        stated = subject.stated(f"friction.coulomb@{subject.joint}") if subject.joint else None
        self.stated = 0.0 if stated is None else stated.value
        self.names = tuple(law.name for law, _ in self.laws)

    def friction(self, drive: Array, load: Array) -> Array:
        """(N,) what is held at most."""
        moment = self._moment(drive, load)
        limits = [np.full(len(drive), self.stated)]
        for law, c in self.laws:
            if isinstance(law, Friction):
                limits.append(law.limit(_each(c, drive), moment)[:, 0])
        held: Array = np.maximum(np.sum(limits, axis=0), 0.0)
        return held

    def pull(self, drive: Array, load: Array) -> Array:
        """(N,) what pulls besides."""
        moment = self._moment(drive, load)
        forces = [np.zeros(len(drive))]
        for law, c in self.laws:
            if isinstance(law, Force):
                forces.append(law.force(_each(c, drive), moment)[:, 0])
        pull: Array = np.sum(forces, axis=0)
        return pull

    def _moment(self, drive: Array, load: Array) -> Moment:
        nothing = np.zeros((len(drive), 1))
        given = {"drive": drive[:, None], "load": load[:, None]}
        return Moment(self.system, np.zeros((len(drive), 0)), {}, nothing, nothing, nothing, given)


def _each(c: Array, drive: Array) -> Array:
    """(K, N, 1) coefficients (K, 1, 1) for every force."""
    return np.broadcast_to(c, (len(c), len(drive), 1))
