"""Tests of ROS 1 and ROS 2 bags as folders of logs: written by rosbags, read topic by topic."""

import tracemalloc
from array import array

import numpy as np
import pytest

import simgap
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError
from sims.recording.log_formats import ros_bags
from sims.recording.log_formats.log_files import list_logs, read_log
from sims.recording.log_formats.ros_bags import MessageTable
from tests.bench.logs import log_writers
from tests.bench.logs.log_writers import ARM, START, WRITERS, make_stamp, write_bag

pytest.importorskip("rosbags", reason="rosbags is not installed: extra bags")

COUNT = 100
TIMES, POSITIONS, RATES, _ = log_writers.motion_with_rates(0, COUNT)


def written(folder, kind="ros2"):
    """Write a bag: a folder of ROS 2, or a file of ROS 1."""
    folder.mkdir(exist_ok=True)
    WRITERS[kind](folder, 0, COUNT)
    (path,) = folder.iterdir()
    return path


@pytest.fixture(params=["ros2", "db3", "ros1"])
def bag(request, tmp_path):
    return written(tmp_path, request.param)


def test_a_topic_is_a_log(bag):
    topics = ["hardware/commands", "joint_states", "note"]
    assert ros_bags.list_topics(bag) == topics
    assert list(list_logs(bag)) == [bag / topic for topic in topics]
    log = read_log(bag / "joint_states")
    assert set(log.list_columns()) == {
        *("time", "position.knee", "position.hip", "velocity.knee", "velocity.hip")
    }
    # Stamps of the header, not of the write time.
    np.testing.assert_allclose(log.get_column("time"), START + TIMES, rtol=0, atol=5e-7)
    np.testing.assert_allclose(log.get_column("position.hip"), POSITIONS[:, 0])
    np.testing.assert_allclose(log.get_column("velocity.knee"), RATES[:, 1])
    commands = read_log(bag / "hardware/commands")
    np.testing.assert_allclose(commands.get_column("time"), START + TIMES, rtol=0, atol=5e-7)
    assert {"data[0]", "data[1]"} < set(commands.list_columns())


def test_a_file_of_a_bag_alone_is_a_bag(tmp_path):
    folder = written(tmp_path)
    (file,) = folder.glob("*.mcap")
    assert ros_bags.list_topics(file) == ros_bags.list_topics(folder)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("joint_state", "unknown topic 'joint_state'; there are: hardware/commands, "),
        ("note", "expected messages with numbers, found none"),
        ("", "a bag; name a topic of it, as "),
    ],
)
def test_what_is_no_topic_of_numbers_is_one_line(bag, topic, message):
    with pytest.raises(InputError) as raised:
        read_log(bag / topic if topic else bag)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_is_not_wanted_is_not_kept(tmp_path):
    path = written(tmp_path) / "joint_states"
    log = read_log(path, frozenset({"time", "Position.hip"}))
    assert set(log.list_columns()) == {"time", "position.hip"}
    np.testing.assert_allclose(log.get_column("position.hip"), POSITIONS[:, 0])
    # The error about an unknown column lists all columns.
    with pytest.raises(InputError, match=r"unknown column 'elbow'; there are: .*velocity\.knee"):
        read_log(path, frozenset({"time", "elbow"})).get_column("elbow")


def test_a_topic_stands_in_memory_once(tmp_path):
    """Columns of messages in order are returned without a copy."""
    table, rows = MessageTable(), 50_000
    for name in "abcdefgh":
        table._numbers[name] = array("d", bytes(8 * rows))
    table._stamps, table._written = array("d", range(1, rows + 1)), array("d", range(rows))
    tracemalloc.start()
    try:
        columns = table.columns()
        held, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert columns["h"].size == rows
    assert most < held + 3 * 8 * rows


def test_a_large_bag_is_read_message_by_message(tmp_path):
    """Memory for the 40 MB of images next to the joints is not retained."""

    def make_messages(types):
        image, header, numbers = (
            types.types[name]
            for name in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "std_msgs/msg/Float64")
        )
        pixels = np.zeros(200_000, dtype=np.uint8)
        for i in range(200):
            head = header(stamp=make_stamp(types, START + i), frame_id="")
            yield "/camera", START + i, image(head, 200, 1000, "mono8", 0, 1000, pixels)
            yield "/angle", START + i, numbers(float(i))

    path = tmp_path / "large"
    write_bag(path, "mcap", make_messages)
    assert sum(f.stat().st_size for f in path.iterdir()) > 40e6
    tracemalloc.start()
    try:
        log = read_log(path / "angle")
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(log.get_column("data"), np.arange(200.0))
    assert most < 10e6


def test_a_stamp_that_repeats_does_not_drop_its_topic(tmp_path, monkeypatch):
    parts = [np.insert(values, 50, values[50], axis=0) for values in log_writers.motion(0, COUNT)]
    monkeypatch.setattr(log_writers, "motion_with_rates", lambda *_: (*parts[:2], *parts[1:]))
    written(tmp_path / "drive")
    (tmp_path / "arm.xml").write_text(ARM)
    out = tmp_path / "log.toml"
    made = simgap.import_logs([tmp_path / "drive"], tmp_path / "arm.xml", out)
    said = "\n".join(made.untold)
    assert "joint_states: 1 of 101 stamps repeat the one before; their rows are left out" in said
    assert "note: expected messages with numbers, found none; left out" in said
    recording, _ = load_recording(out, divide=False)
    assert {"q.hip", "q.knee"} <= set(recording.runs[0].channels)
    assert any("joint_states: 1 of 101 stamps repeat" in note for note in recording.notes)
