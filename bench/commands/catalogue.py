"""What `simgap list` prints."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from bench.problem import experiment
from bench.problem.robots import missing
from bench.registry import SkippedError, simulators, tuners
from sims import effects
from sims.base import Channel, Simulator
from sims.system import KINDS


def lines(what: str) -> list[str]:
    """The lines for tuners, simulators, systems, effects or experiments."""
    kinds: dict[str, Callable[[], list[str]]] = {
        "tuners": lambda: [f"{name:18} {tuners.describe(name)}" for name in tuners.names()],
        "simulators": lambda: [
            f"{name:18} {simulators.describe(name)}" for name in simulators.names()
        ],
        "systems": _systems,
        "effects": _effects,
        "experiments": _experiments,
    }
    return kinds[what]()


def _experiments() -> list[str]:
    """Every experiment that comes with the project: its sentence, then its tags."""
    loaded = [experiment.load(name) for name in experiment.names()]
    return [f"{each.name:22} {_says(each)} [{', '.join(each.tags)}]" for each in loaded]


def _says(each: experiment.Experiment) -> str:
    """Its sentence, and why it cannot be used here, where a robot's file is missing."""
    reason = missing(each)
    return f"skipped: {reason}. {each.says}" if reason else each.says


def _systems() -> list[str]:
    """Every simulator's declaration: parameters, constants, inputs, states and channels with units
    and ranges.
    """
    result = []
    for name in simulators.names():
        try:
            result += _system(simulators.get(name))
        except SkippedError as error:
            result.append(f"{name}: skipped: {error.reason}")
    return result


def _system(kind: type[Simulator]) -> list[str]:
    result = [f"{kind.name}: {kind.says}"]
    for p in kind.parameters:
        low, high = p.bounds
        inner = f", training {p.training[0]:g} to {p.training[1]:g}" if p.training else ""
        result.append(
            f"  parameter {p.name:18} {p.unit:12} {low:g} to {high:g}{inner}; nominal "
            f"{p.nominal:g}  {p.says}"
        )
    result += [f"  constant  {c.name:18} {c.unit:12} {c.value:g}  {c.says}" for c in kind.constants]
    result += _channels("input", kind.inputs)
    result += [f"  state     {name:18} {value:>12g}" for name, value in kind.states.items()]
    return result + _channels("channel", kind.channels)


def _channels(what: str, channels: Iterable[Channel]) -> list[str]:
    return [f"  {what:9} {c.name:18} {c.unit:12} {c.says}".rstrip() for c in channels]


def _effects() -> list[str]:
    """Every effect: its sentence, then each coefficient with unit and plausible range on each kind
    of system.
    """
    result = []
    for name in effects.names():
        try:
            effect = effects.get(name)
        except SkippedError as error:
            result.append(f"{name}: skipped: {error.reason}")
            continue
        result.append(f"{name} ({effect.hook}): {effect.says}")
        for c in effect.coefficients:
            for kind in KINDS:
                if (unit := c.unit(kind)) is not None:
                    low, high = c.range(kind)
                    result.append(f"  {c.name:14} {kind:7} {unit:18} {low:g} to {high:g}")
    return result
