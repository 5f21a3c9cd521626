"""Tests of MCAP files with JSON and Protobuf messages, written by the format's own packages."""

import numpy as np
import pytest

import simgap
from sims.core.simulator import InputError
from sims.recording.log_formats.log_files import list_logs, read_log
from tests.bench.logs.log_writers import ARM, START, WRITERS, motion, write_json_topics

pytest.importorskip("mcap", reason="mcap is not installed: extra mcap")
pytest.importorskip("mcap_protobuf", reason="extra mcap")

STATES = {"joint_states", "commands"}


@pytest.mark.parametrize(
    ("kind", "topics"),
    [("mcap json", STATES), ("mcap json objects", STATES), ("mcap protobuf", {"states"})],
)
def test_a_file_is_a_folder_of_topics_with_the_names_of_the_joints(kind, topics, tmp_path):
    WRITERS[kind](tmp_path, 1, 200)
    path = tmp_path / "run1.mcap"
    assert {topic.name for topic in list_logs(path)} == topics
    (tmp_path / "arm.xml").write_text(ARM)
    made = simgap.import_logs([path], tmp_path / "arm.xml", tmp_path / "log.toml")
    assert made.checks == []
    positions = [line for line in made.guessed if line.startswith("q.")]
    assert len(positions) == 2
    assert all("by its name" in line for line in positions)


def test_the_stamp_of_a_message_is_its_time_else_that_of_writing(tmp_path):
    WRITERS["mcap json"](tmp_path, 1, 100)
    for topic in STATES:
        times = read_log(tmp_path / "run1.mcap" / topic).get_column("time")
        np.testing.assert_allclose(times - START, motion(1, 100)[0], atol=1e-6)


def test_an_unknown_topic_and_numbers_that_are_too_large(tmp_path):
    path = tmp_path / "huge.mcap"
    text = '{"x": 1' + "0" * 400 + ', "y": NaN}'
    write_json_topics(path, [("a", k, text) for k in range(3)])
    with pytest.raises(InputError, match=r"unknown topic 'state'; there are: a$"):
        read_log(path / "state")
    assert np.isinf(read_log(path / "a").get_column("x")).all()
