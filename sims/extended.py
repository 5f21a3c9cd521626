"""Extended simulators on disk: `extended.toml` is written by explain and loads back as a simulator
like any other.

The file names the system, the effects and every number with its interval. Loaded, it is a
registered simulator whose nominal values are the fitted ones, so `compare`, `simulate` and every
tuner take it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sims import effects as library
from sims import files
from sims.base import InputError, Parameter, Simulator, unknown
from sims.simulated import Simulated, effect_parameters
from sims.user_toml import fault, finite, known, names, read_toml, table, text

FORMAT = 1
"""Of the file; a reader refuses any other."""

SPREAD = 0.2
"""The training range of a fitted number reaches at least this share of it to either side."""

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
)
"""What may stand in the file."""


@dataclass(frozen=True)
class Number:
    """A fitted number with its 95 % interval, None where the data do not bound it."""

    value: float
    unit: str
    low: float | None
    high: float | None

    def table(self) -> dict[str, Any]:
        """As TOML, which has no null."""
        interval = (
            {} if self.low is None or self.high is None else {"low": self.low, "high": self.high}
        )
        return {"value": self.value, "unit": self.unit, **interval}


@dataclass(frozen=True)
class Extended:
    """An extended simulator.

    Attributes:
        name: under which it registers.
        system: the system's registered name.
        engine: the engine it was fitted with; None for a simulator that steps itself.
        title: of the recording that it was fitted to.
        parameters: the system's own.
        effects: coefficients by effect, in the order in which a signal passes them.
        constants: as the recording states them, and fitted ones.
        observe: channels that the recording had.
    """

    name: str
    system: str
    engine: str | None
    title: str
    parameters: Mapping[str, Number]
    effects: Mapping[str, Mapping[str, Number]]
    constants: Mapping[str, float]
    observe: Sequence[str]


def write(extended: Extended, path: Path) -> None:
    """Write the file."""
    files.write(path, _written(extended))


def _written(extended: Extended) -> str:
    """The content of the file."""
    import tomli_w

    document = {
        "format": FORMAT,
        "name": extended.name,
        "system": extended.system,
        **({"engine": extended.engine} if extended.engine else {}),
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
    engine = _text(path, "engine", document["engine"]) if "engine" in document else None
    return Extended(
        name=name,
        system=_text(path, "system", document.get("system")),
        engine=engine,
        title=str(document.get("title", "")),
        parameters=_numbers(path, "parameters", document.get("parameters", {})),
        effects=_effects(path, document.get("effects", {})),
        constants=_constants(path, document.get("constants", {})),
        observe=_observe(path, document.get("observe", [])),
    )


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
    bounds = (
        _real(path, f"{where}.{end}", given[end]) if end in given else None
        for end in ("low", "high")
    )
    return Number(fitted, _text(path, "unit", given.get("unit")), *bounds)


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
    places = [p.name for p in kind.parameters]
    for name in extended.parameters:
        if name not in places:
            raise unknown(f"parameter of system {extended.system}", name, places)
    values = _coefficients(extended, kind)
    own = [
        _at(p, extended.parameters[p.name]) if p.name in extended.parameters else p
        for p in kind.parameters
    ]
    names, observed = list(extended.effects), list(extended.observe)
    engine_of: dict[str, Any] = {"engine": extended.engine} if extended.engine else {}
    fresh = kind(extended.constants, observed, effects=names, **engine_of)
    added = [_at(p, n) for p, n in zip(fresh.parameters[len(own) :], values, strict=True)]
    fresh.close()

    def __init__(  # noqa: N807
        self: Simulated,
        constants: Mapping[str, float] | None = None,
        observe: Sequence[str] | None = None,
        **settings: Any,
    ) -> None:
        known = {**extended.constants, **(constants or {})}
        kind.__init__(self, known, observe or observed, effects=names, **{**engine_of, **settings})
        self.parameters = (*own, *added)

    body = {
        "__init__": __init__,
        "system": kind.system,
        "extends": extended.system,
        # All such classes come from this one text and may have one name: their numbers tell them
        # apart, or a tuner trained in the one would be taken for trained in the other.
        "source_digest": hashlib.sha256(_written(extended).encode()).hexdigest(),
        "made_of": tuple(library.get(name) for name in names),
    }
    made: type[Simulated] = type(re.sub(r"\W", "_", extended.name), (kind,), body)
    made.name = extended.name
    made.says = (
        f"{extended.system} with {', '.join(names) or 'nothing added'}, fitted to: {extended.title}"
    )
    made.parameters = (*own, *added)
    return made


def refuse_extended(kind: type[Simulated]) -> None:
    """Raise InputError if a simulator has been extended already: its effects cannot be chosen
    again.
    """
    if hasattr(kind, "extends"):
        raise InputError(
            f"simulator {kind.name} is extended already; name the system it extends, {kind.extends}"
        )


def _coefficients(extended: Extended, kind: type[Simulated]) -> list[Number]:
    """Every coefficient in the simulator's order."""
    values = []
    for name, numbers in extended.effects.items():
        there = library.get(name).on(kind.system)
        for given in numbers:
            if given not in [c.name for c in there]:
                raise unknown(f"coefficient of effect {name}", given, [c.name for c in there])
        for p, c in zip(
            effect_parameters(library.get(name), kind.system, extended.observe), there, strict=True
        ):
            values.append(numbers.get(c.name, Number(0.0, p.unit, None, None)))
    return values


def _at(parameter: Parameter, number: Number) -> Parameter:
    """The parameter with a fitted number for its nominal value, and a training range around it."""
    reach = max(SPREAD * abs(number.value), 1e-12)
    if number.low is not None and number.high is not None:
        reach = max(reach, 3.0 * (number.high - number.low) / 2.0)
    low, high = parameter.bounds
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
        kind = find(extended.system)
        if not issubclass(kind, Simulated):
            raise InputError(f"system {extended.system} takes no effects")
        refuse_extended(kind)
        return extended, kind, simulator_of(extended, kind)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
