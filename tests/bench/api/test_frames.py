"""Tests of recordings given as pandas data frames instead of NAME.csv with NAME.toml."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import simgap
from simgap import InputError
from sims.core.toml_validation import read_toml

ROBOT = Path(simgap.__file__).parent / "examples" / "robot"
UNITS = {"q": "rad", "qd": "rad/s"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("frames")
    swing = simgap.simulate(
        "pendulum", effects={"drag.linear": 8e-4}, noise={"q": 0.003, "qd": 0.02}, runs=3,
        seconds=1.5, rate=60
    )  # fmt: skip
    swing.write(place / "swing.csv")
    return place


@pytest.fixture
def frame(folder):
    return pd.read_csv(folder / "swing.csv")


@pytest.fixture
def stated(folder):
    """Return the entries of swing.toml other than the system and the units."""
    meta = read_toml(folder / "swing.toml")
    noise = {name: {"noise": own["noise"]} for name, own in meta["channels"].items()}
    return {
        "constants": meta["constants"],
        "description": {"channels": noise, "runs": meta["runs"]},
    }


def same(one, other):
    """Check that two recordings have bitwise identical runs."""
    assert [run.name for run in one.runs] == [run.name for run in other.runs]
    for left, right in zip(one.runs, other.runs, strict=True):
        assert left.held_out == right.held_out
        np.testing.assert_array_equal(left.times, right.times)
        for signals in ("channels", "inputs"):
            own, theirs = getattr(left, signals), getattr(right, signals)
            assert own.keys() == theirs.keys()
            for name in own:
                np.testing.assert_array_equal(own[name], theirs[name])
    return True


def test_a_frame_is_read_as_its_file(folder, frame, stated):
    file = simgap.read_recording(folder / "swing.csv")
    read = simgap.read_recording(frame, "pendulum", units=UNITS, **stated)
    assert same(read, file)
    assert read.noise == file.noise
    assert read.constants == file.constants
    # The user's objects are not changed.
    assert stated["description"]["channels"]["q"] == {"noise": 0.003}
    whole = {**read_toml(folder / "swing.toml")}
    assert same(simgap.read_recording(frame, description=whole), file)


def test_units_are_converted_wherever_they_stand(frame):
    plain = simgap.read_recording(frame, "pendulum", units=UNITS)
    degrees = frame.assign(q=np.degrees(frame.q), t=1e3 * frame.t)
    units = {"q": "deg", "qd": "rad/s", "t": "ms", "u": "N*m"}
    by_argument = simgap.read_recording(degrees, "pendulum", units=units)
    degrees.attrs["units"] = {**units, "dropped": "kg"}
    by_attribute = simgap.read_recording(degrees, "pendulum")
    assert same(by_argument, by_attribute)
    np.testing.assert_allclose(by_argument.runs[0].channels["q"], plain.runs[0].channels["q"])
    np.testing.assert_allclose(by_argument.runs[1].times, plain.runs[1].times, atol=1e-9)
    # The argument takes precedence over the attribute of the frame.
    radians = simgap.read_recording(degrees, "pendulum", units={"q": "rad"})
    assert radians.runs[0].channels["q"][0] == degrees.q[0]


def test_index_names_clocks_and_other_columns(frame):
    frame.attrs["units"] = UNITS
    plain = simgap.read_recording(frame, "pendulum")
    assert same(simgap.read_recording(frame.set_index(["run", "t"]), "pendulum"), plain)
    floats = frame.assign(run=frame.run.astype(float), q=frame.q.astype("Float64"))
    assert same(simgap.read_recording(floats, "pendulum"), plain)
    one = frame[frame.run == 2].drop(columns="run")
    single = simgap.read_recording(one, "pendulum")
    assert [run.name for run in single.runs] == ["1", "1"]
    start = pd.Timestamp("2026-01-01", tz="UTC")
    clock = one.assign(t=start + pd.to_timedelta(one.t, unit="s"))
    np.testing.assert_allclose(
        simgap.read_recording(clock, "pendulum").runs[0].times, single.runs[0].times, atol=1e-6
    )
    renamed = frame.rename(columns={"q": "angle"}).assign(volts=12.0)
    description = {
        "channels": {"q": {"column": "angle", "unit": "rad"}},
        "extra": {"volts": {"unit": "V"}},
    }
    read = simgap.read_recording(renamed, "pendulum", description=description)
    assert same(read, plain)
    assert read.runs[0].extra["volts"][0] == 12.0


@pytest.mark.parametrize(
    ("change", "words", "message"),
    [
        (lambda f: f, {}, "DataFrame: expected a system or model: system='NAME' or"),
        (lambda f: f, {"system": "pendulm"}, "did you mean pendulum?"),
        (
            lambda f: f,
            {"system": "pendulum", "units": {"q": "rad"}},
            "DataFrame: expected the unit of each column, found none of qd; pass "
            "units={'qd': 'rad/s'}, if these are the units",
        ),
        (
            lambda f: f,
            {"system": "pendulum", "units": {**UNITS, "angle": "rad"}},
            "unknown column in units of DataFrame 'angle'; there are: q, qd, t",
        ),
        (
            lambda f: f,
            {"system": "pendulum", "units": {**UNITS, "q": "kg"}},
            "DataFrame: channel q: expected a unit that converts to rad, found 'kg'",
        ),
        (
            lambda f: f.rename(columns={"qd": "q_d"}),
            {"system": "pendulum", "units": UNITS},
            "DataFrame: column 'q_d': expected a channel or input of pendulum, which has channels "
            "q, qd and inputs u; did you mean qd",
        ),
        (
            lambda f: f.drop(columns="t"),
            {"system": "pendulum", "units": UNITS},
            "DataFrame: expected column 't', found columns run, q, qd",
        ),
        (
            lambda f: f.assign(t=f.t.where(f.index != 5, 0.0)),
            {"system": "pendulum", "units": UNITS},
            "DataFrame.iloc[5], column t: expected more than 0.0666666667 s, found 0 s",
        ),
        (
            lambda f: f.assign(q=f.q.astype(object).where(f.index != 7, "x")),
            {"system": "pendulum", "units": UNITS},
            "DataFrame.iloc[7], column q: expected a number, found 'x'",
        ),
        (
            lambda f: f.assign(q=f.q.where(f.index != 7, np.inf)),
            {"system": "pendulum", "units": UNITS},
            "DataFrame.iloc[7], column q: expected a finite number, found inf",
        ),
        (
            lambda f: f.assign(u=np.where(f.index == 3, np.nan, 0.0)),
            {"system": "pendulum", "units": {**UNITS, "u": "N*m"}},
            "DataFrame.iloc[3], column u: expected a finite number, found none; an input has no",
        ),
        (
            lambda f: f.iloc[:0],
            {"system": "pendulum", "units": UNITS},
            "DataFrame: expected rows of data, found none",
        ),
        (
            lambda f: f,
            {"system": "pendulum", "units": UNITS, "constants": {"mas": 1.0}},
            "unknown entry in [constants] of DataFrame 'mas'; there are: gravity, length, mass; "
            "did you mean mass?",
        ),
        (
            lambda f: f,
            {"system": "pendulum", "units": UNITS, "description": {"runs": {"1": {"folder": "a"}}}},
            "DataFrame: expected no file and no folder in the description of a frame",
        ),
    ],
)  # fmt: skip
def test_a_malformed_frame_is_one_line(frame, change, words, message):
    with pytest.raises(InputError) as error:
        simgap.explain(change(frame), **words)
    assert message in str(error.value)


def test_a_frame_is_explained_and_scored_as_its_file(folder, frame, stated, tmp_path):
    given = {"units": UNITS, **stated}
    found = simgap.explain(frame, system="pendulum", **given)
    file = simgap.explain(folder / "swing.csv")
    assert [cause.effect for cause in found.causes] == ["drag.linear"]
    assert found.answer.causes == file.answer.causes
    found.write(tmp_path / "out")
    extended = tmp_path / "out" / "extended.toml"
    assert simgap.score(extended, frame, **given) == simgap.score(extended, folder / "swing.csv")


def test_a_frame_has_a_data_sheet_and_stands_next_to_a_file(folder, frame, stated):
    given = {"units": UNITS, **stated}
    sheet = simgap.datasheet(frame, system="pendulum", **given)
    assert sheet.lines()[0] == "pendulum: named"
    both = simgap.explain([frame, folder / "swing.csv"], system="pendulum", **given)
    assert [cause.effect for cause in both.causes] == ["drag.linear"]


def test_the_next_recording_is_designed_from_a_frame(frame):
    next_one = simgap.design(frame, system="pendulum", units=UNITS, seconds=1.0)
    assert next_one.design is not None
    assert next_one.design.times[-1] >= 0.9


def test_a_frame_of_a_robot():
    """The columns of the frame are joints and actuators of the model file."""
    frame = pd.read_csv(ROBOT / "log.csv")
    meta = read_toml(ROBOT / "log.toml")
    units = {
        name: own["unit"]
        for kind in ("channels", "inputs")
        for name, own in flat(meta[kind]).items()
    }
    rest = {"runs": meta["runs"], "channels": meta["channels"]}
    read = simgap.read_recording(frame, model=ROBOT / "arm2.xml", units=units, description=rest)
    file = simgap.read_recording(ROBOT / "log.csv")
    assert same(read, file)
    assert read.model.path == ROBOT / "arm2.xml"
    scores = [
        simgap.score(ROBOT / "arm2.xml", one, **words)
        for one, words in [
            (frame, {"units": units, "description": rest}),
            (ROBOT / "log.csv", {}),
        ]
    ]
    assert scores[0] == scores[1]


def flat(tables, before=""):
    """Flatten tables of signals to full names such as ``q.shoulder``."""
    found = {}
    for name, own in tables.items():
        found |= {before + name: own} if "unit" in own else flat(own, f"{before}{name}.")
    return found
