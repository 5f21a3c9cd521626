"""Extended simulators on disk: `extended.toml` is written by explain and loads back as a simulator
like any other.

The file names the system, the effects and every number with its interval. Loaded, it is a
registered simulator whose nominal values are the fitted ones, so `compare`, `simulate` and every
tuner take it. That of a robot names its model file in place of a system.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from sims import effects as library
from sims import files
from sims.base import InputError, Parameter, Simulator
from sims.robot import stored
from sims.robot.stored import StoredRobot
from sims.simulated import Simulated, effect_parameters
from sims.user_toml import fault, finite, known, names, read_toml, table, text

FORMAT = 1
"""Of the file; a reader refuses any other."""

SPREAD = 0.2
"""The training range of a fitted number reaches at least this share of it to either side."""

WIDTHS = 3.0
"""It reaches at least this many half widths of the number's interval to either side."""

LONGEST = 40
"""Characters of a system's name in that of its extension."""

_SMALLEST = 1e-12
"""It reaches at least this far, in the number's unit, or it would be empty about 0."""

_KEYS = (
    "format",
    "name",
    "system",
    "engine",
    "title",
    "observe",
    "constants",
    "parameters",
    "effects",
    *stored.KEYS,
)
"""What may stand in the file."""


@dataclass(frozen=True)
class Number:
    """A fitted number with its 95 % interval, None where the data do not bound it.

    Attributes:
        value: the estimate.
        unit: of the estimate and its interval.
        low, high: the 95 % interval.
        at_bound: which end of its range the estimate lies at; None where it lies inside. At a bound
            there is no interval.
        stated: the number of the robot's model file that the estimate changes; None where the file
            has no such number.
        total: the same with the estimate in it.
        total_unit: unit of `stated` and `total`; empty where it is `unit`.
        usual_range: the range in which one expects the estimate; None where it lies inside.
    """

    value: float
    unit: str
    low: float | None
    high: float | None
    at_bound: Literal["low", "high"] | None = None
    stated: float | None = None
    total: float | None = None
    total_unit: str = ""
    usual_range: tuple[float, float] | None = None

    @property
    def is_result(self) -> bool:
        """Whether the data determine the number: it has an interval, or is zero where nothing less
        is possible, such as a friction that does not exist.
        """
        if self.at_bound is not None:
            return self.at_bound == "low" and self.value == 0.0
        return self.low is not None and self.high is not None

    def table(self) -> dict[str, Any]:
        """As TOML, which has no null."""
        stated: dict[str, Any] = {"value": self.value, "unit": self.unit}
        if self.low is not None and self.high is not None:
            stated |= {"low": self.low, "high": self.high}
        return stated


@dataclass(frozen=True)
class Extended:
    """An extended simulator.

    Attributes:
        name: under which it registers.
        system: the system's registered name, or that of the robot.
        engine: the engine it was fitted with; None for a simulator that steps itself.
        title: of the recording that it was fitted to.
        parameters: the system's own.
        effects: coefficients by effect, in the order in which a signal passes them.
        constants: as the recording states them, and fitted ones.
        observe: channels that the recording had.
        kind: the simulator's class of its system, where it is known: what `opened` and explain give
            knows it.
        robot: the model file and what was added to it, where it is of a robot.
    """

    name: str
    system: str
    engine: str | None
    title: str
    parameters: Mapping[str, Number]
    effects: Mapping[str, Mapping[str, Number]]
    constants: Mapping[str, float]
    observe: Sequence[str]
    # No part of what was fitted: a file names the system, and whoever reads it knows the class.
    kind: type[Simulated] | None = field(default=None, compare=False, repr=False)
    robot: StoredRobot | None = None

    def simulator(self) -> Simulated:
        """The fitted simulator, ready to simulate: its parameters' nominal values are the fitted
        ones.

        Raises:
            InputError: the class of its system is not known.
        """
        if self.kind is None:
            remedy = "open its file with sims.extended.opened, or use simulator_of"
            raise InputError(f"{self.name}: the class of system {self.system} is unknown; {remedy}")
        return simulator_of(self, self.kind)()


def name_of(system: str) -> str:
    """The name of what extends a system; that of a robot is its file's, which may hold anything."""
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", system)[:LONGEST]
    return f"{plain if plain[:1].isalpha() else f'robot_{plain}'}_extended"


def robot_of(kind: type[Simulated]) -> StoredRobot | None:
    """What a file names of the robot that a simulator is of; None where it is of a system."""
    robot: Any = kind
    return stored.of(robot) if kind.has_model else None


def write(extended: Extended, path: Path) -> None:
    """Write the file."""
    files.write(path, written(extended, path.parent))


def written(extended: Extended, folder: Path | None = None) -> str:
    """The content of the file.

    Args:
        extended: what was found.
        folder: in which it will lie: from there a robot's model file is named.
    """
    import tomli_w

    if extended.robot is None:
        engine = {"engine": extended.engine} if extended.engine else {}
        of: dict[str, Any] = {"system": extended.system, **engine}
    else:
        of = extended.robot.document(folder)
    document = {
        "format": FORMAT,
        "name": extended.name,
        **of,
        "title": extended.title,
        "observe": list(extended.observe),
        "constants": dict(extended.constants),
        "parameters": {name: number.table() for name, number in extended.parameters.items()},
        "effects": {
            name: {coefficient: number.table() for coefficient, number in numbers.items()}
            for name, numbers in extended.effects.items()
        },
    }
    return tomli_w.dumps(document)


def read(path: Path) -> Extended:
    """Read and check a file.

    Raises:
        InputError: it is missing, malformed, or of another format.
    """
    document = read_toml(path)
    if document.get("format") != FORMAT:
        wanted = f"an extended simulator with format = {FORMAT}"
        raise fault(path, "", wanted, document.get("format"))
    known(f"key of {path}", document, _KEYS)
    name = _name(path, document.get("name"))
    robot = stored.read_stored(path, document) if "model" in document else None
    system, engine = (robot.path.stem, None) if robot else _system(path, document)
    return Extended(
        name=name,
        system=system,
        engine=engine,
        title=str(document.get("title", "")),
        parameters=_numbers(path, "parameters", document.get("parameters", {})),
        effects=_effects(path, document.get("effects", {})),
        constants=_constants(path, document.get("constants", {})),
        observe=_observe(path, document.get("observe", [])),
        robot=robot,
    )


def _system(path: Path, document: Mapping[str, Any]) -> tuple[str, str | None]:
    """The registered system, and the engine that steps it, if that was chosen."""
    for key in document:
        if key in stored.KEYS and key != "engine":
            raise InputError(f"{path}: {key} is for a robot; expected model too, found none")
    engine = _text(path, "engine", document["engine"]) if "engine" in document else None
    return _text(path, "system", document.get("system")), engine


def _name(path: Path, value: Any) -> str:
    """The name under which it registers; a class, a folder and a file are called after it."""
    name = _text(path, "name", value)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_.-]*", name):
        raise fault(path, "name", "letters, digits, '_', '.' and '-'", name)
    return name


def _observe(path: Path, value: Any) -> list[str]:
    wanted = "a list of channel names"
    observe = names(path, "observe", value, wanted)
    if not observe:
        raise fault(path, "observe", wanted, value)
    return list(observe)


def _constants(path: Path, value: Any) -> dict[str, float]:
    given = table(path, "constants", value)
    return {name: _real(path, f"constants.{name}", number) for name, number in given.items()}


def _effects(path: Path, value: Any) -> dict[str, dict[str, Number]]:
    coefficients = {}
    # Their order is kept: a signal passes them one after another.
    for name, numbers in table(path, "effects", value).items():
        table(path, name, numbers)
        coefficients[name] = _numbers(path, f"effects.{name}", numbers)
    return coefficients


def _numbers(path: Path, where: str, value: Any) -> dict[str, Number]:
    given = table(path, where, value)
    return {name: _number(path, f"{where}.{name}", number) for name, number in given.items()}


def _number(path: Path, where: str, value: Any) -> Number:
    given = table(path, where, value, "a table with value and unit")
    fitted = _real(path, f"{where}.value", given.get("value"))
    low, high = (
        _real(path, f"{where}.{end}", given[end]) if end in given else None
        for end in ("low", "high")
    )
    return Number(fitted, _text(path, "unit", given.get("unit")), low, high)


def _text(path: Path, where: str, value: Any) -> str:
    result = text(path, where, value, "a text")
    if not result:
        raise fault(path, where, "a text", value)
    return result


def _real(path: Path, where: str, value: Any) -> float:
    return finite(path, where, value, "a finite number")


def simulator_of(extended: Extended, kind: type[Simulated]) -> type[Simulated]:
    """The extended simulator as a class that registers like any other; made without arguments it is
    the fitted one.

    Args:
        extended: what was read.
        kind: the simulator's class of its system.

    Raises:
        InputError: a parameter, effect, coefficient, constant or channel that does not exist.
    """
    known(f"parameter of system {extended.system}", extended.parameters, _names(kind))
    fitted = extended.parameters
    own = [_at(p, fitted[p.name]) if p.name in fitted else p for p in kind.parameters]
    values = _coefficients(extended, kind)
    # Made once, so that whatever it refuses is refused here; it knows the coefficients' bounds.
    effects, observed = list(extended.effects), list(extended.observe)
    fresh = kind(extended.constants, observed, effects=effects, **_engine(extended))
    added = [_at(p, n) for p, n in zip(fresh.parameters[len(own) :], values, strict=True)]
    fresh.close()
    return _class_of(extended, kind, (*own, *added))


def _engine(extended: Extended) -> dict[str, Any]:
    """The setting that chooses the engine; a simulator that steps itself has no such setting."""
    return {"engine": extended.engine} if extended.engine else {}


def _class_of(
    extended: Extended, kind: type[Simulated], parameters: tuple[Parameter, ...]
) -> type[Simulated]:
    """A class of `kind` with everything that was fitted for its defaults."""
    effects, observed = list(extended.effects), list(extended.observe)

    def __init__(  # noqa: N807
        self: Simulated,
        constants: Mapping[str, float] | None = None,
        observe: Sequence[str] | None = None,
        **settings: Any,
    ) -> None:
        # Engine, sensors and constants may be chosen anew; the effects are what was found.
        stated = {**extended.constants, **(constants or {})}
        chosen = {**_engine(extended), **settings}
        kind.__init__(self, stated, observe or observed, effects=effects, **chosen)
        # An own simulator refuses to have it set twice, as its author might by accident.
        object.__setattr__(self, "parameters", parameters)

    body = {
        "__init__": __init__,
        "system": kind.system,
        "extends": extended.system,
        # All such classes come from this one text and may have one name: their numbers tell them
        # apart, or a tuner trained in the one would be taken for trained in the other.
        "source_digest": hashlib.sha256(written(extended).encode()).hexdigest(),
        # An effect at a place of a robot is made of the one that it is there.
        "made_of": tuple(library.get(name.partition("@")[0]) for name in effects),
    }
    simulator: type[Simulated] = type(re.sub(r"\W", "_", extended.name), (kind,), body)
    # A class of a system takes these from the system when it is made; they are its own.
    simulator.name = extended.name
    what = ", ".join(extended.effects) or "nothing added"
    simulator.says = f"{extended.system} with {what}, fitted to: {extended.title}"
    simulator.parameters = parameters
    return simulator


def _names(kind: type[Simulated]) -> list[str]:
    return [parameter.name for parameter in kind.parameters]


def refuse_extended(kind: type[Simulated]) -> None:
    """Raise InputError if a simulator has been extended already: its effects cannot be chosen
    again.
    """
    if hasattr(kind, "extends"):
        robot: Any = kind
        of = f"system it extends, {robot.extends}"
        if kind.has_model:
            of = f"model file it extends, --model {robot.robot.path}"
        raise InputError(f"simulator {kind.name} is extended already; name the {of}")


def _coefficients(extended: Extended, kind: type[Simulated]) -> list[Number]:
    """Every coefficient in the simulator's order."""
    values = []
    for name, numbers in extended.effects.items():
        effect = library.find(name, kind.system)
        coefficients = effect.on(kind.system)
        known(f"coefficient of effect {name}", numbers, [c.name for c in coefficients])
        parameters = effect_parameters(effect, kind.system, extended.observe)
        for parameter, coefficient in zip(parameters, coefficients, strict=True):
            off = Number(0.0, parameter.unit, None, None)
            values.append(numbers.get(coefficient.name, off))
    return values


def _at(parameter: Parameter, number: Number) -> Parameter:
    """The parameter with a fitted number for its nominal value, and a training range around it."""
    reach = max(SPREAD * abs(number.value), _SMALLEST)
    if number.low is not None and number.high is not None:
        reach = max(reach, WIDTHS * (number.high - number.low) / 2.0)
    low, high = parameter.bounds
    # What was fitted may lie outside what the library holds plausible; the box takes it in.
    low, high = min(low, number.value), max(high, number.value)
    inner = (max(low, number.value - reach), min(high, number.value + reach))
    training = inner if inner[0] < inner[1] else None
    return replace(parameter, nominal=number.value, bounds=(low, high), training=training)


Find = Callable[[str], type[Simulator]]
"""Gives the simulator that is registered under a name."""


def load(path: Path, find: Find) -> type[Simulated]:
    """The extended simulator in a file.

    Args:
        path: extended.toml.
        find: looks up the system that it extends.

    Raises:
        InputError: the file, or the system it names, is not usable.
    """
    return opened(path, find)[2]


def opened(path: Path, find: Find) -> tuple[Extended, type[Simulated], type[Simulated]]:
    """What is in a file, the simulator of its system, and the extended simulator.

    Raises:
        InputError: the file, or the system it names, is not usable.
    """
    extended = read(path)
    try:
        kind = extended.robot.simulator() if extended.robot else find(extended.system)
        if not issubclass(kind, Simulated):
            raise InputError(f"system {extended.system} takes no effects")
        refuse_extended(kind)
        return replace(extended, kind=kind), kind, simulator_of(extended, kind)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
