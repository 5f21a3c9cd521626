"""The description of a recording, `NAME.toml`: what its columns are, in which units, and what is
known of each run.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from sims.base import InputError, Simulator, unknown
from sims.recording.table import shown
from sims.recording.units import Scale, scale
from sims.system import System

if sys.version_info >= (3, 11):
    import tomllib as tomllib  # others have it from here
else:
    import tomli as tomllib

Declared: TypeAlias = type[Simulator] | type[System]
"""What a recording is checked against: channels, inputs, constants and states of a system."""


@dataclass(frozen=True)
class RunMarks:
    """What the description says of one run; `held_out` is None where it says nothing."""

    constants: Mapping[str, float]
    initial: Mapping[str, float]
    held_out: bool | None


@dataclass(frozen=True)
class Description:
    """A checked description.

    Attributes:
        system: name of the system.
        title: one line.
        channels: how each channel's column becomes SI.
        inputs: the same for each input's.
        noise: each channel's noise where stated, 1 sigma, SI units.
        constants: known numbers, SI units.
        runs: by name, only those the description mentions.
        extra: units of columns that belong to no channel or input, as written.
    """

    system: str
    title: str
    channels: Mapping[str, Scale]
    inputs: Mapping[str, Scale]
    noise: Mapping[str, float]
    constants: Mapping[str, float]
    runs: Mapping[str, RunMarks]
    extra: Mapping[str, str]


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: the file is missing, unreadable or not TOML.
    """
    if not path.is_file():
        raise InputError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text ({error.reason} at byte {error.start})"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return tomllib.loads(text)
    except ValueError as error:  # bad TOML, or a date or number that cannot be
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: not valid TOML: nested too deeply") from None


def system_of(path: str | Path) -> str:
    """The name of the system that a recording's description states.

    Args:
        path: the recording's table, `NAME.csv`.

    Raises:
        InputError: the description is missing or malformed, or states none.
    """
    description = description_of(Path(path))
    return _system(description, read_toml(description))


def description_of(table: Path) -> Path:
    """`NAME.toml` beside the table.

    Raises:
        InputError: `table` cannot be the name of one.
    """
    if not table.name or table.suffix == ".toml":
        raise InputError(f"expected a recording's table, NAME.csv, found '{table}'")
    return table.with_suffix(".toml")


def read_description(path: Path, declared: Declared) -> Description:
    """Read `NAME.toml` and check it against the system's channels, inputs, constants and states.

    Raises:
        InputError: anything malformed, in one line.
    """
    meta = read_toml(path)
    _known(path, "", meta, ("system", "title", "channels", "inputs", "constants", "runs", "extra"))
    title = meta.get("title", path.stem)
    if not isinstance(title, str):
        raise InputError(f"{path}: title: expected text, found {shown(title)}")
    channels = _columns(path, "channel", meta, {c.name: c.unit for c in declared.channels})
    inputs = _columns(path, "input", meta, {c.name: c.unit for c in declared.inputs})
    if not channels:
        raise InputError(f"{path}: expected at least one [channels.NAME] table, found none")
    noise = {
        n: abs(s.gain) * _noise(path, n, e["noise"])
        for n, (s, e) in channels.items()
        if "noise" in e
    }
    constants = _numbers(
        path, "constants", _section(path, meta, "constants"), [c.name for c in declared.constants]
    )
    _positive(path, "constants", constants, declared)
    runs = {
        name: _run(path, name, own, declared) for name, own in _section(path, meta, "runs").items()
    }
    of_channels, of_inputs = (
        {n: s for n, (s, _) in columns.items()} for columns in (channels, inputs)
    )
    extra = _extra(
        path, meta, ["run", "t", *(c.name for c in (*declared.channels, *declared.inputs))]
    )
    return Description(
        _system(path, meta), title, of_channels, of_inputs, noise, constants, runs, extra
    )


def check_names(path: Path, marked: Iterable[str], there: Iterable[str]) -> None:
    """Check that the description marks only runs which the table has.

    Raises:
        InputError: it marks another.
    """
    _known(path, "runs", marked, list(there))


def _system(path: Path, meta: dict[str, Any]) -> str:
    system = meta.get("system")
    if not isinstance(system, str):
        raise InputError(f'{path}: expected system = "NAME", found {shown(system)}')
    return system


def _columns(
    path: Path, kind: str, meta: dict[str, Any], units: Mapping[str, str]
) -> dict[str, tuple[Scale, dict[str, Any]]]:
    """Each column's scale and table; `units` are the system's."""
    result = {}
    for name, entry in _section(path, meta, f"{kind}s").items():
        if name not in units:
            raise unknown(f"{kind} in {path}", name, list(units) or ["none"])
        if not isinstance(entry, dict):
            raise InputError(
                f'{path}: {kind} {name}: expected a table with unit = "{units[name]}", found {shown(entry)}'
            )
        _known(
            path, f"{kind}s.{name}", entry, ("unit", "noise") if kind == "channel" else ("unit",)
        )
        unit = entry.get("unit")
        if not isinstance(unit, str):
            raise InputError(
                f'{path}: {kind} {name}: expected unit = "{units[name]}" or one that converts to it, '
                f"found {shown(unit)}"
            )
        try:
            result[name] = scale(unit, units[name]), entry
        except InputError as error:
            raise InputError(f"{path}: {kind} {name}: {error}") from None
    return result


def _extra(path: Path, meta: dict[str, Any], taken: Collection[str]) -> dict[str, str]:
    """Units of the columns that are no channel or input; `taken` are names that they cannot have."""
    result = {}
    for name, entry in _section(path, meta, "extra").items():
        if name in taken:
            raise InputError(
                f"{path}: extra.{name}: is a column of its own right; declare it as channel or input"
            )
        unit = entry.get("unit") if isinstance(entry, dict) else None
        if not isinstance(unit, str):
            raise InputError(
                f'{path}: extra {name}: expected a table with unit = "TEXT", found {shown(entry)}'
            )
        _known(path, f"extra.{name}", entry, ("unit",))
        result[name] = unit
    return result


def _noise(path: Path, name: str, value: Any) -> float:
    noise = _number(path, f"channels.{name}.noise", value)
    if noise <= 0:
        raise InputError(
            f"{path}: channels.{name}.noise: expected more than 0 (leave it out if unknown), found {value}"
        )
    return noise


def _run(path: Path, name: str, own: Any, declared: Declared) -> RunMarks:
    where = f"runs.{name}"
    if not isinstance(own, dict):
        raise InputError(f"{path}: {where}: expected a table, found {shown(own)}")
    allowed = [c.name for c in declared.constants]
    _known(path, where, own, ("constants", "initial", "held_out", *allowed))
    held_out = own.get("held_out")
    if not isinstance(held_out, bool | None):
        raise InputError(
            f"{path}: {where}.held_out: expected true or false, found {shown(held_out)}"
        )
    constants = _numbers(path, f"{where}.constants", own.get("constants", {}), allowed)
    direct = _numbers(path, where, {k: v for k, v in own.items() if k in allowed}, allowed)
    for twice in constants.keys() & direct.keys():
        raise InputError(f"{path}: {where}: constant {twice} stands twice")
    constants |= direct
    _positive(path, where, constants, declared)
    initial = _numbers(path, f"{where}.initial", own.get("initial", {}), list(declared.states))
    return RunMarks(constants, initial, held_out)


def _section(path: Path, meta: dict[str, Any], name: str) -> dict[str, Any]:
    section = meta.get(name, {})
    if not isinstance(section, dict):
        raise InputError(f"{path}: expected a table [{name}], found {shown(section)}")
    return section


def _known(path: Path, where: str, found: Iterable[str], allowed: Collection[str]) -> None:
    for name in found:
        if name not in allowed:
            raise unknown(
                f"entry {f'in [{where}] ' if where else ''}of {path}",
                name,
                list(allowed) or ["none"],
            )


def _number(path: Path, where: str, value: Any) -> float:
    try:
        number = (
            math.nan
            if isinstance(value, bool) or not isinstance(value, int | float)
            else float(value)
        )
    except OverflowError:  # TOML's whole numbers have no end
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{path}: {where}: expected a number, found {shown(value)}")
    return number


def _numbers(path: Path, where: str, values: Any, allowed: Collection[str]) -> dict[str, float]:
    if not isinstance(values, dict):
        raise InputError(f"{path}: {where}: expected a table of numbers, found {shown(values)}")
    _known(path, where, values, allowed)
    return {name: _number(path, f"{where}.{name}", value) for name, value in values.items()}


def _positive(path: Path, where: str, constants: Mapping[str, float], declared: Declared) -> None:
    for c in declared.constants:
        if c.positive and constants.get(c.name, 1.0) <= 0:
            raise InputError(
                f"{path}: {where}.{c.name}: expected more than 0 {c.unit}, found {constants[c.name]:g}"
            )
