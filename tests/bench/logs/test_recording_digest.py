"""Tests of the recording digest: it changes with each file of a recording and no other."""

from pathlib import Path

import pytest

from bench.diagnosis.many_logs import list_logs
from bench.logs.recording_digest import compute_recording_digest
from sims.core.files import CHUNK_BYTES

DESCRIPTION = """model = "arm.xml"
[channels.q.elbow]
unit = "rad"
file = "seen.csv"
[inputs."u.m"]
unit = "rad"
[inputs.u.n]
unit = "rad"
file = "drive.mcap/commands"
[runs.1]
folder = "first"
[runs.2]
folder = "second"
"""
FILES = {
    "log.toml": DESCRIPTION,
    "arm.xml": '<mujoco><include file="leg.xml"/></mujoco>',
    "leg.xml": "<mujoco><include  file='foot.xml'/></mujoco>",
    "foot.xml": "<mujoco/>",
    "first/seen.csv": "t,q\n0,1\n",
    "first/log.csv": "t,u.m\n0,1\n",
    "second/seen.csv": "t,q\n0,2\n",
    "second/drive.mcap": "no bag, but called one",
}


@pytest.fixture
def log(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path / "log.toml"


@pytest.mark.parametrize("name", FILES)
def test_any_of_its_files_makes_it_another_one(log, name):
    before = compute_recording_digest(log)
    assert compute_recording_digest(log) == before
    path = log.parent / name
    path.write_text(path.read_text() + "\n")
    assert compute_recording_digest(log) != before


def test_what_it_does_not_name_makes_no_difference(log):
    before = compute_recording_digest(log)
    for name in ("other.csv", "first/other.csv", "seen.csv", "second/other.xml"):
        (log.parent / name).write_text("t,q\n0,1\n")
    assert compute_recording_digest(log) == before
    assert compute_recording_digest(log, "asked otherwise") != before


def test_what_is_missing_or_malformed_is_said_later(log):
    before = compute_recording_digest(log)
    (log.parent / "first/seen.csv").unlink()
    assert compute_recording_digest(log) != before
    log.write_text(DESCRIPTION.replace('"seen.csv"', '"\\u0000"'))
    assert len(compute_recording_digest(log)) == 64
    log.write_text("[channels")
    assert len(compute_recording_digest(log)) == 64


def test_the_end_of_a_large_file_counts(log):
    path = log.parent / "second/drive.mcap"
    path.write_bytes(bytes(CHUNK_BYTES) + b"a")
    before = compute_recording_digest(log)
    path.write_bytes(bytes(CHUNK_BYTES) + b"bb")
    assert compute_recording_digest(log) != before


def test_a_model_named_next_to_the_logs_counts(log):
    def digest():
        (one,) = list_logs([log], Path("out"), {"model": log.parent / "other.xml"})
        return one.digest

    (log.parent / "other.xml").write_text('<mujoco><include file="leg.xml"/></mujoco>')
    before = digest()
    assert digest() == before
    (log.parent / "leg.xml").write_text("<mujoco> </mujoco>")
    assert digest() != before
