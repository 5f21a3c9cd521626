"""Tests that the recording reader accepts the example of its page and reports the
listed messages.
"""

import re

import pytest

from bench.logs.recording_summary import format_summary
from sims.core.simulator import InputError
from sims.recording.recording import read_recording, read_system_name
from sims.systems.pendulum import Pendulum
from tests.docs.documentation_pages import blocks, quoted, section, tables, text_of

PAGE = text_of("recording.md")
BLOCKS = dict(blocks(PAGE))
MORE_ERRORS = """
| `swing.csv` | `run,t,` | `run,time,` | `swing.csv: expected column 't', found columns run, time, u, q, temperature` |
| `swing.csv` | `light,0.02,0,19.6,` | `light,0.02,,19.6,` | `swing.csv, row 3, column u: expected a finite number, found ''; an input has no missing samples` |
| `swing.csv` | `light,0.02,` | `light,0.00,` | `swing.csv, row 3, column t: expected more than 0 s, found 0 s` |
| `swing.csv` | `heavy,0.02,` | `other,0.02,` | `swing.csv, row 6, column run: run 'heavy' has one row; expected at least two` |
| `swing.toml` | `system = ` | `title2 = ` | `unknown entry of swing.toml 'title2'; did you mean title?` |
| `swing.toml` | `noise = 0.2` | `noise = 0` | `swing.toml: channels.q.noise: expected more than 0 (leave it out if unknown), found 0` |
| `swing.toml` | `[channels.q]` | `[channels.angle]` | `unknown channel in swing.toml 'angle'; there are: q, qd` |
| `swing.toml` | `[extra.temperature]` | `[extra.pressure]` | `swing.csv: expected column 'pressure', found columns run, t, u, q, temperature` |
| `swing.toml` | `length = ` | `lenght = ` | `unknown entry in [constants] of swing.toml 'lenght'; there are: gravity, length, mass; did you mean length?` |
| `swing.toml` | `mass = 0.15` | `mass = -0.15` | `swing.toml: constants.mass: expected more than 0 kg, found -0.15` |
| `swing.toml` | `held_out = true` | `held_out = "yes"` | `swing.toml: runs.last.held_out: expected true or false, found 'yes'` |
| `swing.toml` | `qd = 0.0` | `speed = 0.0` | `unknown entry in [runs.last.initial] of swing.toml 'speed'; there are: q, qd` |
| `swing.toml` | `noise = 0.2` | `noise = 1e300` | `swing.toml: channels.q.noise: expected a number within ±1e+15, found 1e+300` |
| `swing.toml` | `mass = 0.15` | `mass = 1e12` | `swing.toml: constants.mass: expected 1e-09 to 1e+09 kg, found 1e+12` |
"""  # noqa: E501 - a row is one line
"""Further errors, in rows as on the page."""
ERRORS = tables(section(PAGE, "## Error messages"))[0][1:] + tables(MORE_ERRORS)[0]


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write the files of the page's example into the working directory."""
    monkeypatch.chdir(tmp_path)
    for name in ("swing.toml", "swing.csv", "small.toml"):
        (tmp_path / name).write_text(BLOCKS[name], encoding="utf-8")
    return tmp_path


def test_the_example_loads_as_the_page_says(files):
    recording = read_recording("swing.csv", Pendulum)
    light, heavy, last = recording.runs
    assert read_system_name("swing.csv") == "pendulum"
    assert recording.noise == {"q": pytest.approx(0.2 * 3.141592653589793 / 180)}
    assert recording.extra == {"temperature": "degC"}
    assert light.inputs["u"].tolist() == pytest.approx([0, 0, 0.05, 0.05])
    assert heavy.constants == {"mass": 0.25}
    assert last.initial == {"q": 0.7854, "qd": 0.0}
    assert [run.held_out for run in recording.runs] == [False, False, True]


def test_inspect_prints_the_output_of_the_page(files):
    lines = [*format_summary(read_recording("swing.csv", Pendulum), Pendulum)]
    assert "\n".join(lines) + "\n" == BLOCKS["inspect"]


def test_the_smallest_description_is_enough(files):
    (files / "small.csv").write_text("run,t,q\na,0,1\na,1,0.5\na,2,0.1\na,3,0\n", encoding="utf-8")
    fitting, measuring = read_recording("small.csv", Pendulum).runs
    assert (fitting.times.size, measuring.times.size) == (2, 2)


@pytest.mark.parametrize("row", ERRORS, ids=[quoted(row[2])[0] for row in ERRORS])
def test_a_fault_has_the_message_of_the_page(files, row):
    # Columns of the table: file, original text, changed text, message.
    (name,), (before,), (after,), (message,) = map(quoted, row)
    (files / name).write_text(BLOCKS[name].replace(before, after, 1), encoding="utf-8")
    assert before in BLOCKS[name]
    with pytest.raises(InputError) as raised:
        read_recording("swing.csv", Pendulum)
    assert str(raised.value) == message


PLACES = {
    "": "",
    "channels.NAME.": "channels.q",
    "inputs.NAME.": "inputs.u",
    "extra.NAME.": "extra.temperature",
    "runs.NAME.": "runs.heavy",
}
"""Prefixes of keys on the page, and the example's table for each."""
CONSTANTS = {"gravity", "length", "mass"}
"""Constants of the system; a run may set them, and the page writes them as `runs.NAME.CONSTANT`."""


@pytest.mark.parametrize("place", PLACES)
def test_the_page_documents_exactly_the_keys_of_the_reader(files, place):
    table = PLACES[place]
    # The message for an unknown key lists all known keys.
    spoilt = {"": "nonsense = 1\n" + BLOCKS["swing.toml"]}.get(
        table, BLOCKS["swing.toml"].replace(f"[{table}]", f"[{table}]\nnonsense = 1", 1)
    )
    (files / "swing.toml").write_text(spoilt, encoding="utf-8")
    with pytest.raises(InputError, match=r"'nonsense'; there are: ") as raised:
        read_recording("swing.csv", Pendulum)
    known = set(str(raised.value).partition("there are: ")[2].split(", ")) - CONSTANTS
    rows = tables(section(PAGE, "## The description"))[0][1:]
    keys = {name for row in rows for name in quoted(row[0])}
    if place:
        told = {key.removeprefix(place) for key in keys if key.startswith(place)} - {"CONSTANT"}
    else:
        told = {
            key.strip("[]").removesuffix(".NAME") for key in keys if not re.search(r"NAME\.", key)
        }
    assert told == known
