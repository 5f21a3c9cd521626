"""Tests of MCAP files with JSON and Protobuf messages, written by the format's own packages."""

import json
import math

import numpy as np
import pytest

import simgap
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError
from sims.recording.log_formats.log_files import list_logs, read_log
from tests.sims.recording.two_joint_arm import ARM

mcap = pytest.importorskip("mcap", reason="mcap is not installed: extra mcap")
mcap_protobuf = pytest.importorskip("mcap_protobuf", reason="extra mcap")
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # noqa: E402
from mcap.writer import Writer  # noqa: E402
from mcap_protobuf.writer import Writer as ProtobufWriter  # noqa: E402

TIMES = 1.7e9 + np.arange(200) * 0.02
NANO = 1_000_000_000


def state(k):
    """Return position, velocity and command of the joints at a sample."""
    q = {"hip": 0.5 * math.sin(0.1 * k), "knee": math.cos(0.1 * k)}
    v = {"hip": 2.5 * math.cos(0.1 * k), "knee": -5.0 * math.sin(0.1 * k)}
    u = {"hip": 0.5 * math.sin(0.1 * k + 0.05), "knee": math.cos(0.1 * k + 0.05)}
    return q, v, u


def json_bag(path, style="lists"):
    """Write joint states and commands as JSON: parallel lists, or a list of named objects."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        topics = {
            topic: writer.register_channel(topic, "json", schema)
            for topic in ("/joint_states", "commands")
        }
        for k, t in enumerate(TIMES):
            q, v, u = state(k)
            stamp = {"sec": int(t), "nsec": round((t % 1) * NANO)}
            names = ["knee", "hip"]
            message = {"name": names, "note": "x", "timestamp": stamp}
            message |= {"position": [q[n] for n in names], "velocity": [v[n] for n in names]}
            if style == "objects":
                joints = [{"name": n, "position": q[n], "velocity": v[n]} for n in names]
                message = {"timestamp": stamp, "joints": joints}
            written = round(t * NANO) + 3_000_000
            for topic, data in (("/joint_states", message), ("commands", {"cmd": u})):
                writer.add_message(topics[topic], written, json.dumps(data).encode(), written)
        writer.finish()
    return path


def protobuf_bag(path):
    """Write joint states of an own Protobuf type, with repeated fields and a stamp."""
    file = descriptor_pb2.FileDescriptorProto(name="states.proto", package="t", syntax="proto3")
    kinds = descriptor_pb2.FieldDescriptorProto

    def message(name, *members):
        made = file.message_type.add(name=name)
        for number, (member, kind, repeated, of) in enumerate(members, 1):
            label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
            made.field.add(name=member, number=number, type=kind, label=label, type_name=of or None)

    message("Stamp", ("seconds", kinds.TYPE_INT64, False, ""),
            ("nanos", kinds.TYPE_INT32, False, ""))  # fmt: skip
    message("State", ("stamp", kinds.TYPE_MESSAGE, False, ".t.Stamp"),
            ("name", kinds.TYPE_STRING, True, ""), ("position", kinds.TYPE_DOUBLE, True, ""),
            ("velocity", kinds.TYPE_DOUBLE, True, ""), ("cmd", kinds.TYPE_DOUBLE, True, ""),
            ("on", kinds.TYPE_BOOL, False, ""))  # fmt: skip
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    state_type = message_factory.GetMessageClass(pool.FindMessageTypeByName("t.State"))
    with path.open("wb") as out, ProtobufWriter(out) as writer:
        for k, t in enumerate(TIMES):
            q, v, u = state(k)
            made = state_type(name=["knee", "hip"], on=k < 100)
            made.position.extend([q["knee"], q["hip"]])
            made.velocity.extend([v["knee"], v["hip"]])
            made.cmd.extend([u["knee"], u["hip"]])
            made.stamp.seconds, made.stamp.nanos = int(t), round((t % 1) * NANO)
            writer.write_message("states", made, round(t * NANO), round(t * NANO))
    return path


BAGS = {
    "lists": lambda path: json_bag(path),
    "objects": lambda path: json_bag(path, "objects"),
    "protobuf": protobuf_bag,
}


@pytest.mark.parametrize("style", BAGS)
def test_a_file_is_a_folder_of_topics_and_is_imported(style, tmp_path):
    path = BAGS[style](tmp_path / "run.mcap")
    topics = {path.name for path in list_logs(path)}
    assert topics == ({"states"} if style == "protobuf" else {"joint_states", "commands"})
    (tmp_path / "arm.xml").write_text(ARM)
    made = simgap.import_logs([path], tmp_path / "arm.xml", tmp_path / "log.toml")
    assert made.checks == []
    recording, _ = load_recording(tmp_path / "log.toml", divide=False)
    (run,) = recording.runs
    own = np.isfinite(run.channels["q.knee"])
    assert own.sum() == 200
    for name in ("hip", "knee"):
        expected = np.array([[part[name] for part in state(i)] for i in range(200)])
        np.testing.assert_allclose(run.channels[f"q.{name}"][own], expected[:, 0], atol=1e-12)
        np.testing.assert_allclose(run.channels[f"qd.{name}"][own], expected[:, 1], atol=1e-12)
        # Commands of JSON are stamped when they are written, 3 ms after the state of their sample.
        late = 0 if style == "protobuf" else 1
        held = run.inputs[f"u.m_{name}"][own][late:]
        np.testing.assert_allclose(held, expected[: 200 - late, 2], atol=1e-12)
    np.testing.assert_allclose(run.times[own], np.arange(200) * 0.02, atol=1e-6)


def test_the_stamp_of_a_message_is_its_time_else_that_of_writing(tmp_path):
    path = json_bag(tmp_path / "run.mcap")
    np.testing.assert_allclose(read_log(path / "joint_states").get_column("time"), TIMES, atol=1e-6)
    late = read_log(path / "commands").get_column("time") - TIMES
    np.testing.assert_allclose(late, 0.003, atol=1e-6)


def test_an_unknown_topic_and_numbers_that_are_too_large(tmp_path):
    path = json_bag(tmp_path / "run.mcap")
    with pytest.raises(InputError, match=r"unknown topic 'state'; there are: commands, joint_sta"):
        read_log(path / "state")
    with (tmp_path / "huge.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channel = writer.register_channel("a", "json", schema)
        for k in range(3):
            writer.add_message(channel, k, b'{"x": 1' + b"0" * 400 + b', "y": NaN}', k)
        writer.finish()
    assert np.isinf(read_log(tmp_path / "huge.mcap" / "a").get_column("x")).all()
