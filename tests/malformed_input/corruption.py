"""Corrupt values, bytes, tables and documents."""

from __future__ import annotations

import copy
import datetime

import tomli_w
from hypothesis import strategies as st

HUGE = (10**9, 10**18, 10**30, -(10**400), 2**63, 1e308, -1e308, 5e-324, 1e-12)
JUNK = st.one_of(
    st.booleans(), st.integers(-3, 60), st.sampled_from(HUGE),
    st.sampled_from([float("nan"), float("inf"), float("-inf"), -0.0, 0.0, 1e6, 1e-9]),
    st.sampled_from(["", "x", "nan", "a\nb", "\x1b[31m", "\u2028", "spring", "pendulum", "ball",
    "random", "[]", "sine:1", "sine:1:0", "steps:1:1e-9", "real", "public", "x" * 5000, "0/0",
    "../up", "/", "é" * 300, "\u202eabc", "q", "qd", "mujoco", "tuner"]),
    st.sampled_from([[], [1, 2], [2, 1], [1, 1], ["x", "x"], [[1]], [True], {}, {"x": 1},
    {"x": {"y": 1}}, {"": ""}, [{}], [0.5, float("nan")], {"q": [1, 0]}, {"q": "x"},
    datetime.date(2020, 1, 1)]),
    st.text(max_size=5), st.floats(),
).map(copy.deepcopy)  # fmt: skip
BYTES = (b"\x00", b"\xff\xfe", b"'", b'"""', b"\n[", b"=", b"\xef\xbb\xbf", b"\r", b",", b"\n\n",
         b"[[a]]", b"\xc3(", b"a=1\n", b"-", b"e9")  # fmt: skip


def paths(document, prefix=()):
    """Yield every key of a nested document as a tuple of keys."""
    for key, value in document.items():
        yield (*prefix, key)
        if isinstance(value, dict):
            yield from paths(value, (*prefix, key))


@st.composite
def documents(draw, valid, more=(), junk=JUNK):
    """Draw a TOML document with one to three errors, as bytes.

    Args:
        valid: valid document.
        more: further keys that an error may add.
        junk: strategy of wrong values.
    """
    document = copy.deepcopy(valid)
    for _ in range(draw(st.integers(1, 3))):
        ways = [*paths(document), *((name,) for name in more)]
        key_path = draw(st.sampled_from(ways)) if ways else ("oops",)
        place = document
        for key in key_path[:-1]:
            place = place[key]
        act = draw(st.integers(0, 4))
        if act == 0:
            place.pop(key_path[-1], None)
        elif act == 1 and isinstance(place.get(key_path[-1]), dict):
            place[key_path[-1]][draw(st.sampled_from(["x", "oops", "", "a b", "é"]))] = draw(junk)
        elif act == 2 and isinstance(place.get(key_path[-1]), list) and place[key_path[-1]]:
            held = list(place[key_path[-1]])
            held[draw(st.integers(0, len(held) - 1))] = draw(junk)
            place[key_path[-1]] = held
        else:
            place[key_path[-1]] = draw(junk)
    try:
        data = tomli_w.dumps(document).encode("utf-8", "replace")
    except (TypeError, ValueError):
        data = repr(document).encode("utf-8", "replace")
    return draw(corrupted(data))


@st.composite
def corrupted(draw, data, rarity=12):
    """Draw the bytes, sometimes cut off or with inserted bytes."""
    act, place = draw(st.integers(0, rarity)), draw(st.integers(0, max(len(data), 1)))
    if act == 0:
        return data[:place]
    if act == 1:
        return data[:place] + draw(st.binary(max_size=5)) + data[place:]
    if act == 2:
        return data[:place] + draw(st.sampled_from(BYTES)) + data[place:]
    return data


CELLS = st.sampled_from([
    "", "nan", "inf", "-inf", "x", "1e308", "-1e308", "1e400", "1_0", "0x1", "1,5", " 1", "1 ",
    "9" * 40, "-1", "0", "-0", "1e-320", "True", '"', '"a', "\u2028", "\x1b[31m", "é", "１２",
    "1.5", "1e15", "run", "None", "=1+1", "\t", "'", "1e5",
])  # fmt: skip


@st.composite
def tables(draw, valid, cells=CELLS):
    """Draw a CSV file with one to three errors, as bytes.

    Args:
        valid: valid file.
        cells: strategy of wrong cells.
    """
    rows = [line.split(",") for line in valid.decode().splitlines()]
    for _ in range(draw(st.integers(1, 3))):
        act = draw(st.integers(0, 7))
        row = draw(st.integers(0, len(rows) - 1)) if rows else 0
        if act <= 3 and rows:
            cell = draw(st.integers(0, max(len(rows[row]) - 1, 0)))
            rows[row][cell : cell + 1] = [draw(cells)]
        elif act == 4 and rows:
            rows.insert(draw(st.integers(0, len(rows))), rows[row])
        elif act == 5 and rows:
            del rows[row : row + draw(st.integers(1, 30))]
        elif act == 6 and rows:
            column, value = draw(st.integers(0, max(len(rows[0]) - 1, 0))), draw(cells)
            rows = [[*r[:column], value, *r[column + 1 :]] if i else r for i, r in enumerate(rows)]
        elif rows:
            rows[row].append(draw(cells))
    text = "".join(",".join(row) + "\n" for row in rows)
    return draw(corrupted(text.encode("utf-8", "replace")))


@st.composite
def bytes_of(draw, valid):
    """Draw a binary file that is damaged at one place."""
    act = draw(st.integers(0, 5))
    place = draw(st.integers(0, max(len(valid) - 1, 0)))
    if act == 0:
        return valid[:place]
    if act == 1:
        return draw(
            st.sampled_from([b"", b"{}", b"[]", b"null", b"PAR1PAR1", b"PK\x05\x06" + bytes(18)])
        )
    length = draw(st.sampled_from([1, 1, 2, 4, 30, 900]))
    byte = draw(st.integers(0, 255))
    return valid[:place] + bytes([byte]) * length + valid[place + length :]
