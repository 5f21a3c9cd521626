"""Names of the columns of a log, from names of joints in the log.

A message of joint states has a list of names and lists of numbers in the same order, which may
differ from the order of the model: ROS drivers sort names alphabetically. Logs store the names as
columns (``field.name0`` next to ``field.position0`` of ``rostopic echo -p``), as a text in each row
(``['base', 'elbow']``), or as an array of texts (NumPy). A number then gets the name of its joint:
``field.position.base``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from sims.core.simulator import Array, make_read_only

_NAMES_WORD = r"(?:joint[_ ]?|motor[_ ]?)?names?"
_NUMBERED_COLUMN_PATTERN = re.compile(
    r"(?P<stem>.*?)(?P<left>[\[(._]?)(?P<number>\d{1,4})(?P<right>[\])]?)"
)
_NAMES_COLUMN = re.compile(rf"(?:(?P<prefix>.*?)[._/ ])??{_NAMES_WORD}", re.IGNORECASE)
_LIST_OF_TEXTS = re.compile(r"[\[(](?P<inside>.*)[\])]")


def name_numbered_columns(
    columns: Mapping[str, Array], texts: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Array], frozenset[str]]:
    """Name the numbered columns of a table by the columns that hold their names.

    Shapes: T rows.

    ROS logs, for example, have columns ``name[0]``, ``name[1]``, ... with names of joints and
    ``position[0]``, ``position[1]``, ... with numbers. The column of the joint elbow is then
    ``position.elbow``. Names are looked up in each row, because some loggers change their order.
    Columns of names belong to columns of numbers with the same prefix, brackets and numbers.

    Args:
        columns: Numbers (T,) by column name.
        texts: Texts (T,) by column name.

    Returns:
        The numbers (T,) by the new names, and the numbered columns that they replace.
    """
    # Columns of names by their numbers, for each style: prefix, opening and closing bracket.
    name_columns: dict[tuple[str, str, str], dict[int, str]] = {}
    for column in texts:
        match = _NUMBERED_COLUMN_PATTERN.fullmatch(column)
        names_match = _NAMES_COLUMN.fullmatch(match["stem"]) if match else None
        if match and names_match:
            # The prefix includes the character after it, as in `left.` of `left.name[0]`.
            prefix = column[: len(names_match["prefix"]) + 1] if names_match["prefix"] else ""
            style = prefix, match["left"], match["right"]
            name_columns.setdefault(style, {})[int(match["number"])] = column
    named_columns: dict[str, Array] = {}
    replaced: set[str] = set()
    for style, names_by_number in name_columns.items():
        numbers = sorted(names_by_number)
        # (k, T) names, of k columns in T rows.
        names = [list(texts[names_by_number[number]]) for number in numbers]
        for stem, columns_by_number in _group_numbered_columns(columns, *style).items():
            # Without a name for each column, the names belong to other columns.
            if columns_by_number.keys() != names_by_number.keys():
                continue
            values = np.column_stack([columns[columns_by_number[number]] for number in numbers])
            entries = _sort_by_name(values, names, f"{stem}.")
            # A new name must not hide a column of the log.
            if entries and not entries.keys() & columns.keys():
                named_columns |= entries
                replaced |= set(columns_by_number.values())
    return named_columns, frozenset(replaced)


def name_list_entries(
    columns: Mapping[str, Array], texts: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Array], frozenset[str]]:
    """Name the entries of lists by a column that holds a list of names in each row.

    Shapes: T rows.

    A cell of names is ``['base', 'elbow']``. Each column of lists with as many entries is divided
    into columns such as ``position.elbow``; the names are looked up in each row.

    Args:
        columns: Numbers (T,), or (T, k) for lists of k numbers, by column name.
        texts: Texts (T,) by column name.

    Returns:
        The numbers (T,) by the new names, and the columns of lists that they replace.
    """
    named_columns: dict[str, Array] = {}
    replaced: set[str] = set()
    for names_column, cells in texts.items():
        if not _NAMES_COLUMN.fullmatch(names_column):
            continue
        name_lists = [_parse_text_list(cell) for cell in cells]
        # The first row must have names, and all others as many.
        if not name_lists or not name_lists[0] or len(set(map(len, name_lists))) > 1:
            continue
        # (k, T) names, for k entries in T rows.
        names = [list(entry_names) for entry_names in zip(*name_lists, strict=True)]
        for name, values in columns.items():
            if values.ndim == 2 and values.shape[1] == len(names):
                entries = _sort_by_name(values, names, f"{name}.")
                if entries and not entries.keys() & columns.keys():
                    named_columns |= entries
                    replaced.add(name)
    return named_columns, frozenset(replaced)


def name_array_entries(
    columns: Mapping[str, Array], names: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Array], frozenset[str]]:
    """Name the entries of arrays by an array of names of the same length.

    Shapes: T rows.

    Each array (T, k) with as many columns as there are names is divided into columns such as
    ``position.elbow``.

    Args:
        columns: Numbers (T,), or (T, k) for arrays with k columns, by array name.
        names: Texts (k,) by array name.

    Returns:
        The numbers (T,) by the new names, and the arrays that they replace.
    """
    named_columns: dict[str, Array] = {}
    replaced: set[str] = set()
    for array, entry_names in names.items():
        # Other arrays of texts are no names of columns.
        if not re.search(r"name|joint|motor|label", array, re.IGNORECASE):
            continue
        for name, values in columns.items():
            if values.ndim == 2 and values.shape[1] == len(entry_names) == len(set(entry_names)):
                named_columns |= {
                    f"{name}.{entry_name}": make_read_only(values[:, k])
                    for k, entry_name in enumerate(entry_names)
                }
                replaced.add(name)
    return named_columns, frozenset(replaced)


def _group_numbered_columns(
    columns: Mapping[str, Array], prefix: str, opening: str, closing: str
) -> dict[str, dict[int, str]]:
    """Group numbered columns, such as ``position[0]``, by the text before their number.

    Args:
        columns: Numbers by column name.
        prefix: Required beginning of the names.
        opening: Required character before the number, such as ``[``; empty for none.
        closing: Required character after the number; empty for none.

    Returns:
        Column names by number, for each text before the number (without the opening character).
    """
    columns_by_stem: dict[str, dict[int, str]] = {}
    for column, values in columns.items():
        match = _NUMBERED_COLUMN_PATTERN.fullmatch(column)
        if match is None or values.ndim > 1 or not column.startswith(prefix):
            continue
        if (match["left"], match["right"]) == (opening, closing):
            columns_by_stem.setdefault(match["stem"], {})[int(match["number"])] = column
    return columns_by_stem


def _sort_by_name(values: Array, names: Sequence[Sequence[str]], prefix: str) -> dict[str, Array]:
    """Sort numbers into columns by name, looking up the names in each row.

    Args:
        values: Numbers (T, k), k in each of T rows.
        names: Names (k, T), one for each number in each row; some may be empty.
        prefix: Beginning of the names of the new columns.

    Returns:
        Columns (T,) by name, NaN in rows without the name; empty if a row has a name twice, or if
        there are far more different texts than columns, which are then not names.
    """
    distinct_names = list(dict.fromkeys(name for column in names for name in column if name))
    # More than four different texts per column are notes or values, and not names.
    if not distinct_names or len(distinct_names) > 4 * len(names):
        return {}
    table = np.array(names, dtype=object).T
    columns: dict[str, Array] = {}
    for name in distinct_names:
        mask = table == name
        counts = mask.sum(axis=1)
        if (counts > 1).any():
            return {}
        # Each row has one number with this name, or none.
        column = np.where(mask, values, 0.0).sum(axis=1)
        column[counts == 0] = np.nan
        columns[prefix + name] = make_read_only(column)
    return columns


def _parse_text_list(cell: str) -> list[str]:
    """Return the texts of a list that is written in a cell as ``['base', 'elbow']``."""
    match = _LIST_OF_TEXTS.fullmatch(cell.strip())
    if not match:
        return []
    return [part.strip(" '\"") for part in re.split(r"[,;]", match["inside"])]
