"""Tests of text tables of any layout: comments, units, decimal commas, names next to numbers, and
one-line errors with the row.
"""

import re

import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.recording.log_formats.log_files import read_log

ROWS = [(0.0, 1.5, -2.25), (0.01, 1.25, -2.5), (0.02, 1.0, -2.75)]


def table(separator=",", head="t,q1,q2", above="", comma=False):
    lines = [above.rstrip("\n")] * bool(above) + [head.replace(",", separator)] * bool(head)
    for row in ROWS:
        cells = [f"{x:.3f}".replace(".", ",") if comma else f"{x:.3f}" for x in row]
        lines.append(separator.join(cells))
    return "\n".join(lines) + "\n"


def read(tmp_path, text, name="log.csv", encoding="utf-8"):
    (tmp_path / name).write_bytes(text.encode(encoding))
    return read_log(tmp_path / name)


def rows(log):
    return np.column_stack([log.get_column(name) for name in log.list_columns()]).tolist()


LAYOUTS = {
    "commas": table(),
    "semicolons and decimal commas": table(";", comma=True),
    "tabs and decimal commas": table("\t", comma=True),
    "bars": table("|"),
    "blanks": table(" "),
    "several blanks": table("   "),
    "a comment above": table(";", above="# exported 26.11.2026", comma=True),
    "comments of other kinds": table(above="// robot 7\n% rate 100, 3 joints\n#"),
    "notes above": table(";", above="Robot log 7\nRate;100;\n\n", comma=True),
    "notes as wide as the table": table(";", above="Robot;7;\nRate;100;", comma=True),
    "a header that is a comment": table(head="# t,q1,q2"),
    "a header of other separators": table(" ", head="# t, q1, q2"),
    "a header of blanks, as NumPy has it": table().replace("t,q1,q2", "# t q1 q2"),
    "comments between the rows": table().replace("0.010", "# lap 2\n0.010"),
    "separators at the end": table().replace("\n", ",\n"),
    "quoted decimal commas": '"t","q1","q2"\n' + "".join(
        ",".join(f'"{x:.2f}"'.replace(".", ",") for x in row) + "\n" for row in ROWS),
    "a mark in a note": table(above='# the "old robot'),
}  # fmt: skip


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_table_of_any_layout_is_read(name, tmp_path):
    log = read(tmp_path, LAYOUTS[name])
    seen = [name for name in log.list_columns() if np.isfinite(log.get_column(name)).any()]
    assert seen == ["t", "q1", "q2"]
    np.testing.assert_array_equal(np.array(rows(log))[:, :3], ROWS)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_a_table_of_another_encoding_is_read(encoding, tmp_path):
    log = read(tmp_path, table("\t", head="Zeit,Arm [°],q2", comma=True), encoding=encoding)
    assert log.list_columns() == ["Zeit", "Arm [°]", "q2"]


def test_a_row_of_units_is_no_row_of_numbers(tmp_path):
    log = read(tmp_path, table(";", head="t,q1,q2").replace("q2\n", "q2\n[s];(deg);mrad\n"))
    assert log.units == {"t": "s", "q1": "deg", "q2": "mrad"}
    assert rows(log) == [list(row) for row in ROWS]


def test_thousands_are_distinguished_from_decimals(tmp_path):
    log = read(tmp_path, "t;q\n999,5;1,5\n1.000,5;2,25\n1.001,5;3\n")
    assert log.get_column("t").tolist() == [999.5, 1000.5, 1001.5]
    log = read(tmp_path, 't,q\n"1,000.5",1\n"1,001.5",2\n')
    assert log.get_column("t").tolist() == [1000.5, 1001.5]


def test_blanks_within_lists_do_not_divide_cells(tmp_path):
    rows = "".join(f'CONTROL,{t},"[{a}, {b}, {a}, {b}]"\n' for t, a, b in ROWS)
    log = read(tmp_path, "type,timestamp,positions\n" + rows)
    assert log.list_columns() == ["timestamp", *(f"positions[{k}]" for k in range(4))]
    assert log.texts == ("type",)


def test_instants_are_seconds(tmp_path):
    log = read(tmp_path, "when,q\n2026-11-26 10:00:00.000,1\n2026-11-26 10:00:00.250,2\n")
    assert np.diff(log.get_column("when")).tolist() == [0.25]


def test_a_file_without_a_header_has_no_row_of_data_for_names(tmp_path):
    log = read(tmp_path, table(head=""))
    assert not log.named
    assert log.list_columns() == ["column 1", "column 2", "column 3"]
    assert rows(log) == [list(row) for row in ROWS]


@pytest.mark.parametrize("head", ["0,1,2", ",0,1,2"])
def test_columns_that_pandas_numbered_have_a_header(head, tmp_path):
    first = "0,0.1,2.5\n" if head == "0,1,2" else "0,0.0,0.1,2.5\n"
    log = read(tmp_path, head + "\n" + first + first.replace("0.1", "0.2"))
    assert log.named
    assert {"0", "1", "2"} <= set(log.list_columns())


def test_numbers_have_the_names_next_to_them_row_by_row(tmp_path):
    head = "%time,field.name0,field.name1,field.position0,field.position1,field.velocity0\n"
    text = head + "1,knee,hip,0.5,0.25,3\n2,hip,knee,0.125,0.75,4\n"
    log = read(tmp_path, text)
    assert log.get_column("field.position.knee").tolist() == [0.5, 0.75]
    assert log.get_column("field.position.hip").tolist() == [0.25, 0.125]
    # The numbered columns are available on request.
    assert "field.position0" not in log.list_columns()
    assert log.get_column("field.position0").tolist() == [0.5, 0.125]
    # One velocity of two has no name.
    assert "field.velocity0" in log.list_columns()


@pytest.mark.parametrize("style", ["name_{}", "/js/name[{}]", "name.{}", "joint_names{}"])
def test_names_stand_in_columns_of_any_style(style, tmp_path):
    position = re.sub(r"(joint_)?names?(?=\W|_|{)", "position", style)
    columns = [form.format(k) for form in (style, position) for k in (1, 2)]
    log = read(tmp_path, ",".join(["t", *columns]) + "\n1,knee,hip,0.5,0.25\n2,knee,hip,0.5,0.75\n")
    (hip,) = (name for name in log.list_columns() if name.endswith(".hip"))
    assert log.get_column(hip).tolist() == [0.25, 0.75]


def test_names_stand_in_lists_and_in_arrays(tmp_path):
    text = "t,name,position\n0,\"['knee', 'hip']\",\"(0.5, 0.25)\"\n"
    log = read(tmp_path, text + "1,\"['hip', 'knee']\",\"(0.125, 0.75)\"\n")
    assert log.get_column("position.knee").tolist() == [0.5, 0.75]
    q = np.array([[0.5, 0.25], [0.75, 0.125]])
    np.savez(tmp_path / "log.npz", t=[0, 1], q=q, joint_names=np.array(["knee", "hip"]))
    log = read_log(tmp_path / "log.npz")
    assert log.list_columns() == ["t", "q.knee", "q.hip"]
    assert log.get_column("q.hip").tolist() == log.get_column("q[1]").tolist() == [0.25, 0.125]


INVALID_TABLES = {
    "a row too short": ("t,q1,q2\n0,1,2\n\n1,2\n2,3,4\n", r"row 4: expected 3 cells as in the "
                        r"header, row 1, found 2; correct or delete this row"),
    "a row too long": ("# a\nt,q1\n0,1\n1,2,3\n2,3\n", r"row 4: expected 2 cells as in the header, "
                       r"row 2, found 3; correct or delete this row"),
    "a last row cut off": ("t,q1,q2\n0,1,2\n1,2,3\n2,3", r"row 4: .*found 2; the log is truncated "
                           r"there: delete this row"),
    "a footer": ("t,q1\n0,1\n1,2\nend of log\n", r"row 4: expected 2 cells"),
    "a cell": ("# a\nt,q1\n0,1\n1,2\n\n2,x\n3,4\n", r"row 6, column q1: expected a number, found "
               r"'x'"),
    "a cell of the first row": ("t,q1\n0,x\n1,2\n2,3\n", r"row 2, column q1: expected a number, "
                                r"found 'x'"),
    "a name too few": ("t,q1\n0,1,2\n1,2,3\n", r"row 1: expected 3 names, one for each cell of row "
                       r"2, found 2; give each column a name"),
    "a mark without end": ('t,q1\n0,1\n1,"2\n2,3\n', r"row 3: a quotation mark opens a cell and "
                           r"none closes it"),
    "commas of two meanings": ('t,q1\n"1,001","1,500"\n"1,002","2,250"\n', r"row 2, column t: "
                               r"expected a number with a decimal point, found '1,001'; its comma "
                               r"may divide decimals or thousands"),
    "points and commas": ("t;q1\n0,5;1,5\n0,6;1.6\n", r"row 3, column q1: expected a decimal comma,"
                          r" found '1.6'; other cells of this column have decimal commas"),
    "no table": ("hello world\n", r"expected columns of numbers, found none"),
    "nothing": ("\n\n", r"expected a table with a header and rows, found an empty file"),
    "bytes": ("t,q\n0,\0\n", r"expected a table of text, found binary data"),
}  # fmt: skip


@pytest.mark.parametrize("name", INVALID_TABLES)
def test_a_fault_is_one_line_that_says_the_row(name, tmp_path):
    text, message = INVALID_TABLES[name]
    with pytest.raises(InputError, match=message) as error:
        read(tmp_path, text)
    assert "\n" not in str(error.value)
    assert "tokeniz" not in str(error.value).lower()
