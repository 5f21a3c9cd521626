"""Parse the tuners of an experiment file: a list, or a table for each tuner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sims.base import InputError
from sims.user_toml import entries, fault, hints_of


@dataclass(frozen=True)
class Entry:
    """One tuner of a comparison: its registered name, options, and seeds or budget where they
    differ; `randomised` where it trains over the experiment's ``[nuisance]``.
    """

    label: str
    tuner: str
    options: Mapping[str, Any] = field(default_factory=dict)
    seeds: int | None = None
    budget: int | None = None
    randomised: bool = False

    def table(self) -> dict[str, Any]:
        """Return the entry as the table ``[tuners.LABEL]``."""
        given = {key: value for key, value in asdict(self).items() if value is not None}
        del given["label"]
        if not self.randomised:
            del given["randomised"]
        return given


def entries_of(path: Path, value: Any) -> tuple[Entry, ...]:
    """Parse the tuner entries of an experiment file, in the order of the file.

    Args:
        path: experiment file.
        value: value of the key ``tuners``: a table of tables by label, or a list of registered
            names and of tables that name their tuner.

    Raises:
        InputError: the value is not valid.
    """
    if isinstance(value, dict):
        tables = value.items()
        return tuple(_entry(path, f"tuners.{label}", label, own) for label, own in tables)
    if not isinstance(value, list):
        raise fault(path, "tuners", "a list of names or a table for each tuner", value)
    listed: list[Entry] = []
    for place, item in enumerate(value):
        entry = _listed(path, f"tuners[{place}]", item)
        # Tables and figures distinguish tuners by label; TOML keys cannot occur twice, list items
        # can.
        if entry.label in [other.label for other in listed]:
            twice = f"{entry.label} stands twice; give one of them a label"
            raise InputError(f"{path}: tuners: {twice}")
        listed.append(entry)
    return tuple(listed)


def _listed(path: Path, where: str, item: Any) -> Entry:
    if isinstance(item, str):
        return Entry(item, item)
    if not isinstance(item, dict):
        raise fault(path, where, "a name or a table", item)
    own = dict(item)  # a copy, so that the parsed document is not changed
    label = own.pop("label", own.get("tuner"))
    if not isinstance(label, str):
        raise fault(path, where, 'a table with tuner = "NAME"', item)
    return _entry(path, where, label, own)


def _entry(path: Path, where: str, label: str, value: Any) -> Entry:
    hints = {key: hint for key, hint in hints_of(Entry).items() if key != "label"}
    own = entries(path, where, value, hints)
    for key in ("seeds", "budget"):
        if own.get(key, 1) < 1:
            raise fault(path, f"{where}.{key}", "at least 1", own[key])
    return Entry(label, own.pop("tuner", label), **own)
