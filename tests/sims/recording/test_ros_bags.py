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
from tests.sims.recording.two_joint_arm import ARM

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed: extra bags")
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

TIMES = 1.7e9 + np.arange(200) * 0.02


def stamped(types, seconds):
    sec = int(seconds)
    return types.types["builtin_interfaces/msg/Time"](sec, round((seconds - sec) * 1e9))


def messages(types):
    """Yield joint states with time stamps, commands of the same joints without, and an image."""
    header = types.types["std_msgs/msg/Header"]
    state = types.types["sensor_msgs/msg/JointState"]
    numbers = types.types["std_msgs/msg/Float64MultiArray"]
    layout = types.types["std_msgs/msg/MultiArrayLayout"]
    extra = {} if "seq" not in header.__dataclass_fields__ else {"seq": 0}
    for i, t in enumerate(TIMES):
        # The second joint comes first, as in many drivers.
        q = np.array([0.5 * np.sin(0.1 * i), np.cos(0.1 * i)])
        v = np.array([2.5 * np.cos(0.1 * i), -5.0 * np.sin(0.1 * i)])
        head = header(stamp=stamped(types, t), frame_id="", **extra)
        yield "/joint_states", t + 0.003, state(head, ["knee", "hip"], q, v, np.array([]))
        u = np.array([np.cos(0.1 * i + 0.05), 0.5 * np.sin(0.1 * i + 0.05)])
        yield "/hardware/position_commands", t + 0.001, numbers(layout([], 0), u)
    yield "/note", TIMES[0], types.types["std_msgs/msg/String"]("begun")


def written(path, storage="mcap"):
    """Write a bag: a folder of ROS 2, or a file of ROS 1."""
    if storage == "bag":
        types, writer = get_typestore(Stores.ROS1_NOETIC), Writer1(path)
    else:
        types = get_typestore(Stores.ROS2_JAZZY)
        plugin = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}[storage]
        writer = Writer(path, version=9, storage_plugin=plugin)
    with writer:
        known = {}
        for topic, t, message in messages(types):
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=types)
            raw = types.serialize_ros1 if storage == "bag" else types.serialize_cdr
            writer.write(known[topic], round(t * 1e9), raw(message, kind))
    return path


@pytest.fixture(params=["mcap", "db3", "bag"])
def bag(request, tmp_path):
    return written(tmp_path / f"run.{request.param}", request.param)


def test_a_topic_is_a_log(bag):
    topics = ["hardware/position_commands", "joint_states", "note"]
    assert ros_bags.list_topics(bag) == topics
    assert list(list_logs(bag)) == [bag / topic for topic in topics]
    log = read_log(bag / "joint_states")
    assert set(log.list_columns()) == {
        *("time", "position.knee", "position.hip", "velocity.knee", "velocity.hip")
    }
    # Stamps of the header, not of the write time.
    np.testing.assert_allclose(log.get_column("time"), TIMES, atol=5e-7)
    np.testing.assert_allclose(log.get_column("position.hip"), np.cos(0.1 * np.arange(200)))
    np.testing.assert_allclose(log.get_column("velocity.knee"), 2.5 * np.cos(0.1 * np.arange(200)))
    commands = read_log(bag / "hardware/position_commands")
    np.testing.assert_allclose(commands.get_column("time"), TIMES + 0.001, atol=5e-7)
    assert {"data[0]", "data[1]"} < set(commands.list_columns())


def test_a_file_of_a_bag_alone_is_a_bag(tmp_path):
    folder = written(tmp_path / "run", "mcap")
    (file,) = folder.glob("*.mcap")
    assert ros_bags.list_topics(file) == ros_bags.list_topics(folder)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("joint_state", "unknown topic 'joint_state'; there are: hardware/position_commands, "),
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
    path = written(tmp_path / "run") / "joint_states"
    log = read_log(path, frozenset({"time", "Position.hip"}))
    assert set(log.list_columns()) == {"time", "position.hip"}
    np.testing.assert_allclose(log.get_column("position.hip"), np.cos(0.1 * np.arange(200)))
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
    types = get_typestore(Stores.ROS2_JAZZY)
    image = types.types["sensor_msgs/msg/Image"]
    header = types.types["std_msgs/msg/Header"]
    path = tmp_path / "large"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        camera = writer.add_connection("/camera", image.__msgtype__, typestore=types)
        numbers = types.types["std_msgs/msg/Float64"]
        angle = writer.add_connection("/angle", numbers.__msgtype__, typestore=types)
        pixels = np.zeros(200_000, dtype=np.uint8)
        for i in range(200):
            head = header(stamp=stamped(types, TIMES[i]), frame_id="")
            one = image(head, 200, 1000, "mono8", 0, 1000, pixels)
            stamp = round(TIMES[i] * 1e9)
            writer.write(camera, stamp, types.serialize_cdr(one, image.__msgtype__))
            writer.write(angle, stamp, types.serialize_cdr(numbers(float(i)), numbers.__msgtype__))
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
    twice = np.sort(np.append(TIMES, TIMES[50]))
    monkeypatch.setattr("tests.sims.recording.test_ros_bags.TIMES", twice)
    written(tmp_path / "drive")
    (tmp_path / "arm.xml").write_text(ARM)
    out = tmp_path / "log.toml"
    made = simgap.import_logs([tmp_path / "drive"], tmp_path / "arm.xml", out)
    said = "\n".join(made.untold)
    assert "joint_states: 1 of 201 stamps repeat the one before; their rows are left out" in said
    assert "note: expected messages with numbers, found none; left out" in said
    recording, _ = load_recording(out, divide=False)
    assert {"q.hip", "q.knee"} <= set(recording.runs[0].channels)
    assert any("joint_states: 1 of 201 stamps repeat" in note for note in recording.notes)
