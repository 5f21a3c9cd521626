"""Tests of the page table: it writes the same CSV as pandas, without pandas."""

from io import StringIO

import numpy as np
import pandas as pd
import pytest

from bench.pages.page_table import DataGrid, GridColumn, Table, select_initial_rows

COLUMNS = {
    "text": ['a "quoted", one', "b", "=c", "", "two\nlines"],
    "number": [0.1 + 0.2, float("nan"), -1e-300, np.float64(2.5), 1e22],
    "gain": [0.5, None, 0.25, None, 1.0],
    "count": [3, 1, 2, 5, 4],
}


@pytest.mark.parametrize("style", [None, "%.6g"])
def test_it_writes_the_csv_that_pandas_writes(style):
    written = Table(COLUMNS).to_csv(float_format=style)
    assert written == pd.DataFrame(COLUMNS).to_csv(index=False, float_format=style)
    again = pd.read_csv(StringIO(written))
    assert again["count"].tolist() == COLUMNS["count"]
    assert again["gain"].isna().tolist() == [False, True, False, True, False]


def test_rows_and_columns_lead_to_each_other():
    table = Table(COLUMNS)
    assert len(table) == 5
    assert Table.from_rows(table.rows())["text"] == COLUMNS["text"]
    assert table.without(["text", "gain", "not there"]).columns == ("number", "count")
    assert Table.from_rows([]).columns == ()
    with pytest.raises(ValueError, match=r"one length, found lengths \[1, 2\]"):
        Table({"a": [1], "b": [1, 2]})


@pytest.mark.parametrize("sort", ["number,down", "number", "text", "gain,down"])
def test_a_grid_shows_the_same_rows_of_either_kind_of_table(sort):
    ties = {name: values * 2 for name, values in COLUMNS.items()} | {"place": list(range(10))}
    grid = DataGrid("g", "title", "t", tuple(GridColumn(name) for name in ties), sort=sort)
    frame = pd.DataFrame(ties)
    name, _, way = sort.partition(",")
    order = frame.sort_values(name, kind="stable", ascending=way != "down")["place"]
    for table in (Table(ties), frame):
        assert [row["place"] for row in select_initial_rows(grid, table)] == order.tolist()
