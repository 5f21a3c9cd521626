"""Parse the tuners of an experiment file: a list, or a table for each tuner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sims.core.simulator import InputError
from sims.core.toml_validation import check_entries, get_type_hints_of, make_error


@dataclass(frozen=True)
class TunerEntry:
    """One tuner of a comparison: registered name, options, seeds and budget.

    Seeds and budget are given where they differ from those of the experiment. If `randomised`, the
    tuner trains with domain randomisation over the experiment's ``[nuisance]``.
    """

    label: str
    tuner: str
    options: Mapping[str, Any] = field(default_factory=dict)
    seeds: int | None = None
    budget: int | None = None
    randomised: bool = False

    def to_table(self) -> dict[str, Any]:
        """Return the entry as the table ``[tuners.LABEL]``."""
        table = {key: value for key, value in asdict(self).items() if value is not None}
        del table["label"]
        if not self.randomised:
            del table["randomised"]
        return table


def parse_entries(path: Path, value: Any) -> tuple[TunerEntry, ...]:
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
        return tuple(
            _parse_tuner_table(path, f"tuners.{label}", label, table) for label, table in tables
        )
    if not isinstance(value, list):
        raise make_error(path, "tuners", "a list of names or a table for each tuner", value)
    entries: list[TunerEntry] = []
    for index, item in enumerate(value):
        entry = _parse_list_item(path, f"tuners[{index}]", item)
        # Tables and figures distinguish tuners by label; TOML keys cannot occur twice, list items
        # can.
        if entry.label in [listed_entry.label for listed_entry in entries]:
            problem = f"{entry.label} is listed twice; give one of them a label"
            raise InputError(f"{path}: tuners: {problem}")
        entries.append(entry)
    return tuple(entries)


def _parse_list_item(path: Path, key: str, item: Any) -> TunerEntry:
    """Parse one element of a list of tuners: a name, or a table with the key ``tuner``.

    The label, under which results are listed, is the key ``label``, or else the name of the tuner.
    """
    if isinstance(item, str):
        return TunerEntry(item, item)
    if not isinstance(item, dict):
        raise make_error(path, key, "a name or a table", item)
    table = dict(item)  # a copy, so that the parsed document is not changed
    label = table.pop("label", table.get("tuner"))
    if not isinstance(label, str):
        raise make_error(path, key, 'a table with tuner = "NAME"', item)
    return _parse_tuner_table(path, key, label, table)


def _parse_tuner_table(path: Path, entry_key: str, label: str, value: Any) -> TunerEntry:
    """Parse the table of one tuner; a table without the key ``tuner`` uses its label as the name.

    `path` and `entry_key` (file and key) are for error messages, `value` is the table.
    """
    hints = {key: hint for key, hint in get_type_hints_of(TunerEntry).items() if key != "label"}
    table = check_entries(path, entry_key, value, hints)
    for key in ("seeds", "budget"):
        if table.get(key, 1) < 1:
            raise make_error(path, f"{entry_key}.{key}", "at least 1", table[key])
    return TunerEntry(label, table.pop("tuner", label), **table)
