"""What a robot feels of its commands, step by step."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sims.base import Array, Scenario
from sims.plan import Plan, Runs, felt_inputs
from sims.robot.acting import part_of
from sims.robot.midway import Mask, Places
from sims.system import Acting, Input

INSTANT = 1e-6
"""Share of a step that is as good as its beginning."""
SHARE = 1e-6
"""Of a step by which a run may exceed a whole number of them."""
PARTS: Array = np.array([0.25, 0.5, 0.75, 1.0])
"""Shares of a step at which it is divided, to see where in it a command changes."""
KEPT = 64 * 2**20
"""Bytes of answers that are kept."""
PLAIN: Array = np.array([1.0])
"""The same of a step that is not divided."""
OWN = "u"
"""What an input is called that is looked at for itself."""
TOGETHER = 128
"""Lanes of inputs that are looked at together, at most."""


class _Known:
    """Answers by what was asked, the last ones."""

    def __init__(self) -> None:
        self._kept: dict[tuple[object, ...], Array] = {}
        self._bytes = 0

    def get(self, key: tuple[object, ...], make: Callable[[], Array]) -> Array:
        """The answer, made if it is not known."""
        if key not in self._kept:
            made = make()
            self._bytes += made.nbytes
            if self._bytes > KEPT:
                self._kept.clear()
                self._bytes = made.nbytes
            self._kept[key] = made
        return self._kept[key]


_known = _Known()
"""What is felt where nothing acts: thousands of simulations are given the same commands."""


def _digest(times: Array, signal: Array) -> bytes:
    """Of a signal and its instants."""
    digest = hashlib.blake2b(times.tobytes(), digest_size=16)
    digest.update(signal.tobytes())
    return digest.digest()


def felt(
    step: float,
    scenario: Scenario,
    commands: Mapping[str, Array],
    acting: Acting,
    n: int,
    steps: int,
    share: float = 1.0,
) -> dict[str, Array]:
    """What n lanes feel of each input over the steps, (n, S) by name: as a step has to be given
    it, or as it is in the first share of each.
    """
    times = scenario.times - scenario.times[0] + scenario.offset
    # Where commands change with the steps a mean says all of them.
    places = times / step
    aligned = bool((np.abs(places - np.rint(places)) < SHARE).all())
    seen = np.zeros(steps + 1, dtype=bool)
    seen[np.clip(np.rint(places).astype(np.intp), 0, steps)] = True
    usual = PLAIN if aligned else PARTS
    if share < 1.0:
        usual = np.array([share, 1.0])
    felt: dict[str, Array] = {}
    asked: list[_Asked] = []
    for name, signal in commands.items():
        earlier = scenario.before[name].tobytes() if name in scenario.before else b""
        read = name in scenario.linear, scenario.offset, earlier
        key = step, steps, usual.tobytes(), *read, _digest(scenario.times, signal)
        bare = _Asked(name, signal, np.zeros(1, dtype=np.intp), ())
        plain = _known.get(key, partial(_given, step, scenario, [bare], steps, seen, usual))
        felt[name] = np.repeat(plain, n, axis=0)
        passed = tuple((e, c) for e, c in acting if isinstance(e, Input) and e.signal == name)
        # What is given to a lane must not hang on the company that it is in.
        asked += [_Asked(name, signal, *part) for part in _by_kinds(passed, n)]
    cuts = PARTS if usual is PLAIN else usual
    for group in _groups(asked):
        values = _given(step, scenario, group, steps, seen, cuts)
        ends = np.cumsum([one.lanes.size for one in group])
        for one, rows in zip(group, np.split(values, ends[:-1]), strict=True):
            felt[one.name][one.lanes] = rows
    return felt


class _Asked(NamedTuple):
    """One input, what it is told, and the lanes in which effects act on it."""

    name: str
    signal: Array
    lanes: Places
    acting: Acting


def _alone(scenario: Scenario, name: str) -> Scenario:
    """What is known of one input, under the name `OWN`."""
    return replace(
        scenario,
        inputs={},
        linear=frozenset({OWN} if name in scenario.linear else ()),
        before={OWN: scenario.before[name]} if name in scenario.before else {},
    )


def _by_kinds(passed: Acting, n: int) -> Iterator[tuple[Places, Acting]]:
    """Lanes in which the same effects act, and what acts there."""
    there = np.array([(c != 0).any(axis=(0, 2)) for _, c in passed], dtype=bool).reshape(-1, n)
    kinds, of = np.unique(there, axis=1, return_inverse=True)
    for number, kind in enumerate(kinds.T):
        if kind.any():
            lanes = np.flatnonzero(of.ravel() == number)
            yield lanes, part_of(passed, lanes)


def _groups(asked: Sequence[_Asked]) -> Iterator[list[_Asked]]:
    """Those on whose ways the same kinds of effects lie, in the same order: what remembers is
    stepped, and a step costs alike for few lanes and for many.
    """
    alike: dict[tuple[str, ...], list[_Asked]] = {}
    for one in asked:
        alike.setdefault(tuple(e.of or e.name for e, _ in one.acting), []).append(one)
    for group in alike.values():
        sizes = np.cumsum([one.lanes.size for one in group])
        parts = (sizes - 1) // TOGETHER
        for part in np.unique(parts):
            yield [group[k] for k in np.flatnonzero(parts == part)]


def _together(asked: Sequence[_Asked]) -> Acting:
    """What lies on the ways of a group, for its lanes one after the other."""
    first = [effect for effect, _ in asked[0].acting]
    rows = zip(*([c for _, c in one.acting] for one in asked), strict=True)
    return tuple((effect, np.concatenate(c, axis=1)) for effect, c in zip(first, rows, strict=True))


def _given(
    step: float,
    scenario: Scenario,
    asked: Sequence[_Asked],
    steps: int,
    seen: Mask,
    cuts: Array,
) -> Array:
    """(N, S) what the lanes that are asked for are given in steps that are divided at `cuts`."""
    acting = _together(asked)
    of = np.repeat(np.arange(len(asked)), [one.lanes.size for one in asked])
    runs = Runs(tuple(_alone(scenario, one.name) for one in asked), of)
    plan = _parts_of_steps(step, steps, of.size, cuts, alike=not acting)
    commands = [{OWN: one.signal} for one in asked]
    values = felt_inputs(plan, runs, commands, acting)[OWN]
    parts = values.reshape(of.size, steps, cuts.size)
    return parts[:, :, 0] if cuts.size < PARTS.size else moments_kept(parts, seen)


def _parts_of_steps(step: float, steps: int, n: int, cuts: Array, alike: bool) -> Plan:
    """Steps divided at these shares of them."""
    begins: Array = step * np.arange(float(steps))
    ends = (begins[:, None] + step * cuts).ravel()
    lengths = np.diff(ends, prepend=0.0)
    rows = np.zeros((n, 1), dtype=np.intp)
    shape = n, ends.size
    whole = np.broadcast_to(lengths, shape), np.broadcast_to(ends, shape)
    return Plan(*whole, 1, rows, alike=alike)


def moments_kept(parts: Array, seen: Mask) -> Array:
    """(n, S) what to give over each step, of means (n, S, 4) over its quarters.

    A step of length h takes one control. With m its mean and D its first moment about the middle,

        D = 1 / h^2 times the integral of (s - h / 2) u(s)                                 (1)

    the pair that a command asks for is given by -D in the step and +D in the next one (or in the
    step before and in this one, where a sample lies between: between samples nobody looks). A
    command that changes within a step is then neither early nor late by a share of it.

    Args:
        parts: (n, S, 4).
        seen: (S + 1,) at which ends of steps a sample lies.
    """
    weights = (np.arange(4.0) + 0.5) / 4.0 - 0.5
    moments = (parts * weights).mean(axis=2)  # (1)
    given: Array = parts.mean(axis=2)
    last = parts.shape[1] - 1
    for way, allowed in ((1, ~seen[1:]), (-1, seen[1:] & ~seen[:-1])):
        steps = np.flatnonzero(allowed)
        steps = steps[(steps + way >= 0) & (steps + way <= last)]
        given[:, steps] -= way * moments[:, steps]
        given[:, steps + way] += way * moments[:, steps]
    return given
