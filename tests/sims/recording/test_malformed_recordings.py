"""Tests of hundreds of malformed recordings: each gives one clear message or a valid recording,
never a traceback or an endless loop.
"""

from collections import Counter

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sims.core.simulator import Channel, Constant, InputError, Simulator
from sims.recording.recording import read_recording
from sims.recording.unit_conversion import compute_unit_scale
from tests.malformed_input import corruption

EXAMPLES = 600
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


GOOD_TABLE = "\n".join(",".join(row) for row in (HEADER, *ROWS)).encode() + b"\n"
GOOD_TOML = tomli_w.dumps(TOML).encode()
CELLS = st.one_of(st.sampled_from(JUNK), st.text(max_size=6), st.floats().map(repr))
VALUES = st.one_of(corruption.JUNK, st.sampled_from(UNITS + JUNK[:-12]), st.just(10**400))
DESCRIPTIONS = corruption.documents(TOML, ("oops", "a\nb", "Channels"), VALUES)


@st.composite
def corrupted_tables(draw):
    """Return a table with wrong cells and rows, or another layout or encoding, as bytes."""
    data = draw(corruption.tables(GOOD_TABLE, CELLS))
    act, column = draw(st.integers(0, 9)), draw(st.integers(0, len(HEADER) - 1))
    if act == 0:
        return data.replace(b",", draw(st.sampled_from([b";", b"\t", b"|", b" "])))
    if act == 1:
        ends = [b"\r\n", b"\r", b"\n\n", b" \n", b",\n", b"\n\r"]
        return data.replace(b"\n", draw(st.sampled_from(ends)))
    if act == 2:
        codes = ["utf-8-sig", "utf-16", "utf-16-le", "latin-1", "cp1252", "utf-32"]
        return data.decode("utf-8", "replace").encode(draw(st.sampled_from(codes)), "replace")
    rows = [row.split(b",") for row in data.split(b"\n")]
    if act == 3:
        rows = [[*row[:column], *row[column + 1 :]] for row in rows]
    elif act == 4:
        rows = [[*row[:column], row[-1], *row[column:]] for row in rows]
    elif act == 5:
        rows.sort(key=lambda row: row[1:2])
    return b"\n".join(b",".join(row) for row in rows)


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


seen: Counter[str] = Counter()


def test_undamaged_it_is_valid(folder):
    assert outcome(folder, GOOD_TABLE, GOOD_TOML).startswith("('swing', {'mass': 1.5}, {'q': 0.01}")


@pytest.mark.slow
@SETTINGS
@given(data=corrupted_tables())
def test_damaged_tables(folder, monkeypatch, data):
    monkeypatch.setattr("sims.recording.csv_table.MIN_FAST_PARSE_BYTES", 1 << 20)
    slow = outcome(folder, data, GOOD_TOML)
    monkeypatch.setattr("sims.recording.csv_table.MIN_FAST_PARSE_BYTES", 0)
    assert outcome(folder, data, GOOD_TOML) == slow, "the fast reader differs"
    seen["sound" if slow.startswith("('swing'") else "refused"] += 1


@pytest.mark.slow
@settings(SETTINGS, max_examples=EXAMPLES // 2)
@given(data=DESCRIPTIONS)
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
