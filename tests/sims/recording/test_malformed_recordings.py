"""Tests of thousands of malformed recordings: each gives one clear message or a valid recording,
never a traceback or an endless loop.
"""

import csv
import datetime
import io
from collections import Counter

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sims.core.simulator import Channel, Constant, InputError, Simulator
from sims.recording.recording import read_recording
from sims.recording.unit_conversion import compute_unit_scale

EXAMPLES = 2000
SETTINGS = settings(
    max_examples=EXAMPLES,
    deadline=4000,  # milliseconds; a few are normal
    derandomize=True,
    database=None,
    suppress_health_check=[
        HealthCheck.function_scoped_fixture,
        HealthCheck.too_slow,
        HealthCheck.data_too_large,
    ],
)
HEADER = ["run", "t", "u", "q", "qd"]
ROWS = [
    [str(run), f"{0.1 * i:.1f}", "0.5", f"{run + i}", "" if i == 2 else "1e-3"]
    for run in (1, 2, 3)
    for i in range(5)
]
TOML = {
    "system": "swing",
    "title": "as it should be",
    "channels": {"q": {"unit": "rad", "noise": 0.01}, "qd": {"unit": "deg/s"}},
    "inputs": {"u": {"unit": "N*m"}},
    "constants": {"mass": 1.5},
    "runs": {"2": {"held_out": True, "mass": 2.0, "initial": {"q": 0.5}}},
}
JUNK = [
    "", " ", "abc", "nan", "NaN", "inf", "-Infinity", "1e999", "1,5", '"', '"1', '1"', "1_000",
    "٣", "\x00", "0x10",
    "1e", "--1", "true", "None", "1 2", "9" * 400, "x" * 200_000, "#", "=1+1", "\u2028", "é",
    "\ufeff1", "a\nb", "1\n",
    "\x1b[31m",
]  # fmt: skip
UNITS = [
    "", "deg", "radians", "m", "kg*m", "rad/s", "°", "turn", "furlong", "wibble", "9**9**9",
    "m**-1000", "((((", "m)(",
    "1/0", "rad rad", "deg/s", "Hz", "rpm", "degC", "dB", "N·m", "Nm", "mN*m", "%", "1",
    "import os", "\n", "q" * 300,
    "π", "rad^",
]  # fmt: skip


class Swing(Simulator):
    name = "swing"
    channels = (Channel("q", "rad"), Channel("qd", "rad/s"))
    inputs = (Channel("u", "N*m"),)
    constants = (Constant("mass", "kg", 1.0, positive=True),)
    states = {"q": 0.0, "qd": 0.0}  # noqa: RUF012


def table(header, rows, mark=",", end="\n"):
    text = io.StringIO()
    csv.writer(text, delimiter=mark, lineterminator=end).writerows([header, *rows])
    return text.getvalue()


cells = st.one_of(st.sampled_from(JUNK), st.text(max_size=6), st.floats().map(repr))
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
    st.sampled_from(UNITS + JUNK[:-12]),
    st.just(10**400), st.just(datetime.date(2020, 2, 29)),
)  # fmt: skip
values = st.recursive(
    leaves,
    lambda v: st.lists(v, max_size=2) | st.dictionaries(st.text(max_size=4), v, max_size=2),
    max_leaves=4,
)


@st.composite
def spoilt_tables(draw):
    """Return a table with one to three errors, as bytes."""
    header, rows = list(HEADER), [list(row) for row in ROWS]
    mark, end = ",", "\n"
    for _ in range(draw(st.integers(1, 3))):
        column, row = (
            draw(st.integers(0, len(header) - 1)),
            draw(st.integers(0, len(rows) - 1)) if rows else 0,
        )
        act = draw(st.integers(0, 15))
        if act == 0 and len(header) > 1:
            del header[column]
            rows = [r[:column] + r[column + 1 :] for r in rows]
        elif act == 1:
            header.insert(column, header[-1])
            rows = [[*r[:column], r[-1] if r else "", *r[column:]] for r in rows]
        elif act == 2:
            header[column] = draw(cells)
        elif act in (3, 4, 5) and rows and column < len(rows[row]):
            rows[row][column] = draw(cells)
        elif act == 6 and rows:
            rows.insert(draw(st.integers(0, len(rows))), rows.pop(row))
        elif act == 7 and rows:
            rows.insert(row, list(rows[row]))
        elif act == 8:
            rows = rows[: draw(st.integers(0, 3))]
        elif act == 9 and rows:
            rows[row] = rows[row][: draw(st.integers(0, 4))]
        elif act == 10 and rows:
            rows[row] = rows[row] + [draw(cells)] * draw(st.integers(1, 3))
        elif act == 11:
            same = draw(st.sampled_from(JUNK[:8]))
            rows = [[*r[:column], same, *r[column + 1 :]] for r in rows]
        elif act == 12:
            mark = draw(st.sampled_from([",", ";", "\t", "|", " "]))
        elif act == 13:
            end = draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n", " \n", ",\n", "\n\r"]))
        elif act == 14:
            rows = rows * draw(st.integers(0, 3))
        elif act == 15:
            rows.sort(key=lambda r: r[1] if len(r) > 1 else "")
    return spoilt_bytes(draw, table(header, rows, mark, end))


def spoilt_bytes(draw, text):
    """Return the text in some encoding, possibly truncated or with wrong bytes."""
    encoding = draw(
        st.sampled_from(
            ["utf-8"] * 8 + ["utf-8-sig", "utf-16", "utf-16-le", "latin-1", "cp1252", "utf-32"]
        )
    )
    data = text.encode(encoding, errors="replace")
    act = draw(st.integers(0, 12))
    if act == 0:
        data = data[: draw(st.integers(0, len(data)))]
    elif act == 1:
        place = draw(st.integers(0, len(data)))
        data = data[:place] + draw(st.binary(max_size=6)) + data[place:]
    elif act == 2:
        place = draw(st.integers(0, len(data)))
        data = (
            data[:place]
            + draw(st.sampled_from([b'"', b"\x00", b"\xff", b"\n", b",", b"\xef\xbb\xbf"]))
            + data[place:]
        )
    return data


@st.composite
def spoilt_descriptions(draw):
    """Return a description with one to three errors, as bytes."""
    document = {k: v if isinstance(v, str) else {**v} for k, v in TOML.items()}
    document["channels"] = {k: {**v} for k, v in TOML["channels"].items()}
    document["runs"] = {"2": {**TOML["runs"]["2"]}}
    for _ in range(draw(st.integers(1, 3))):
        act = draw(st.integers(0, 7))
        key = draw(st.sampled_from(sorted(document))) if document else "x"
        inner = document.get(key)
        if act == 0:
            document.pop(key, None)
        elif act == 1:
            document[draw(st.sampled_from([key, "oops", "a\nb", "Channels"]))] = draw(values)
        elif act in (2, 3) and isinstance(document.get("channels"), dict):
            channel = draw(st.sampled_from(["q", "qd", "nope"]))
            document["channels"][channel] = {
                "unit": draw(st.sampled_from(UNITS) | st.text(max_size=12))
            }
        elif act == 4 and isinstance(inner, dict) and inner:
            inner[draw(st.sampled_from([*map(str, inner), "mass", "held_out", "initial", "7"]))] = (
                draw(values)
            )
        elif act == 5 and isinstance(inner, dict) and inner:
            inner.pop(draw(st.sampled_from(sorted(map(str, inner)))), None)
        elif act == 6 and isinstance(document.get("channels"), dict):
            document["channels"]["q"] = {"unit": "rad", "noise": draw(values)}
        elif act == 7:
            document["runs"] = {draw(st.sampled_from(["1", "2", "3", "9", ""])): draw(values)}
    try:
        text = tomli_w.dumps(without_none(document))
    except (TypeError, ValueError):  # values that TOML cannot represent
        text = repr(document)
    return spoilt_bytes(draw, text)


def without_none(value):
    if isinstance(value, dict):
        return {k: without_none(v) for k, v in value.items() if v is not None}
    return [without_none(v) for v in value if v is not None] if isinstance(value, list) else value


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    compute_unit_scale("deg", "rad")  # import pint here, outside the deadline of an example
    return tmp_path_factory.mktemp("spoilt")


def outcome(folder, table_bytes, description_bytes):
    """Read the recording; return the error message, or the data as plain values."""
    (folder / "log.csv").write_bytes(table_bytes)
    (folder / "log.toml").write_bytes(description_bytes)
    try:
        recording = read_recording(folder / "log.csv", Swing)
    except InputError as error:
        message = str(error)
        assert message.isprintable(), "one line, and nothing in it that a terminal would obey"
        assert str(folder / "log.csv") in message or str(folder / "log.toml") in message
        assert len(message) < 600
        return message
    finally:
        assert sorted(p.name for p in folder.iterdir()) == ["log.csv", "log.toml"]
        assert (folder / "log.csv").read_bytes() == table_bytes
        assert (folder / "log.toml").read_bytes() == description_bytes
    assert recording.training()
    for run in recording.runs:
        assert run.times.size >= 2
        assert np.isfinite(run.times).all()
        assert (run.times[1:] > run.times[:-1]).all()
        assert set(run.channels) <= {"q", "qd"}
        assert not any(np.isinf(v).any() for v in run.channels.values())
        assert all(np.isfinite(v).all() for v in run.inputs.values())
        assert all(k == "mass" and v > 0 for k, v in run.constants.items())
    runs = [
        (
            r.name,
            r.held_out,
            *(v.tolist() for v in (r.times, *r.channels.values(), *r.inputs.values())),
        )
        for r in recording.runs
    ]
    return repr((recording.system, recording.constants, recording.noise, runs))


GOOD_TABLE, GOOD_TOML = table(HEADER, ROWS).encode(), tomli_w.dumps(TOML).encode()
seen: Counter[str] = Counter()


def test_undamaged_it_is_valid(folder):
    assert outcome(folder, GOOD_TABLE, GOOD_TOML).startswith("('swing', {'mass': 1.5}, {'q': 0.01}")


@pytest.mark.slow
@SETTINGS
@given(data=spoilt_tables())
def test_damaged_tables(folder, monkeypatch, data):
    monkeypatch.setattr("sims.recording.csv_table.MIN_FAST_PARSE_BYTES", 1 << 20)
    slow = outcome(folder, data, GOOD_TOML)
    monkeypatch.setattr("sims.recording.csv_table.MIN_FAST_PARSE_BYTES", 0)
    assert outcome(folder, data, GOOD_TOML) == slow, "the fast reader differs"
    seen["sound" if slow.startswith("('swing'") else "refused"] += 1


@pytest.mark.slow
@settings(SETTINGS, max_examples=EXAMPLES // 2)
@given(data=spoilt_descriptions())
def test_damaged_descriptions(folder, data):
    outcome(folder, GOOD_TABLE, data)


@settings(SETTINGS, max_examples=EXAMPLES // 8)
@given(data=st.binary(max_size=400), text=st.text(max_size=200))
def test_files_of_anything(folder, data, text):
    outcome(folder, data, GOOD_TOML)
    outcome(folder, GOOD_TABLE, data)
    outcome(folder, text.encode("utf-8", "replace"), GOOD_TOML)
    outcome(folder, GOOD_TABLE, text.encode("utf-8", "replace"))


def test_most_of_the_damaged_tables_are_invalid():
    if not seen:
        pytest.skip("needs test_damaged_tables before it")
    assert seen.total() >= EXAMPLES
    assert seen["refused"] > 0.6 * seen.total()
    assert seen["sound"] > 0.01 * seen.total()


@pytest.mark.parametrize("size", [0, 1, 3_000_000])
def test_huge_and_empty_files(folder, size):
    for piece in (b"1,0,0,0,0\n", b"\x00", b'"', b",", b"\n", b"run,t,u,q,qd\n", b"9", b"["):
        data = piece * (size // len(piece))
        assert "log.csv" in outcome(folder, data, GOOD_TOML)
        if piece != b"[" or size < 10:
            outcome(folder, GOOD_TABLE, data[: size // 10])
    assert "row 3, column t" in outcome(
        folder, b"run,t,u,q,qd\n" + b"1,0,0,0,0\n" * 300_000, GOOD_TOML
    )
