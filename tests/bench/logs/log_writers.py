"""Write one motion of a two-joint arm in each log format, by the library of the format.

The motion is simulated by MuJoCo alone. Each writer makes the file or folder of one run, or of all
runs for formats that hold several.
"""

from __future__ import annotations

import json
import math

import mujoco
import numpy as np

ARM = """<mujoco model="arm"><option timestep="0.002" integrator="implicitfast"/>
<compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="hip" axis="0 1 0" damping="0.3" armature="0.02" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>
<body pos="0.3 0 0"><joint name="knee" axis="0 1 0" damping="0.2" armature="0.02" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.03" contype="0" conaffinity="0"/>
</body></body></worldbody>
<actuator><position name="m_hip" joint="hip" kp="80" kv="6"/>
<position name="m_knee" joint="knee" kp="60" kv="5"/></actuator></mujoco>"""
JOINTS = ("hip", "knee")
RATE = 100.0
START = 1.7e9  # A clock of robots counts from 1970, s.
NANO = 1_000_000_000
NOISE = 2e-4  # Standard deviation of the positions, rad.
LATENCY = 0.003  # Time from the stamp of a joint state to its writing, s.


def motion(run, count=200):
    """Return times (T,), positions and commands (T, 2) of a run."""
    rng = np.random.default_rng([run, 11])
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    phase, times = rng.uniform(0, 6, 2), np.arange(count) / RATE
    q, u = np.zeros((count, 2)), np.zeros((count, 2))
    data.qpos[:] = 0.5 * np.sin(phase)
    for k, t in enumerate(times):
        u[k] = 0.5 * np.sin(np.array([3.0, 5.0]) * t + phase)
        q[k] = data.qpos
        data.ctrl[:] = u[k]
        for _ in range(round(1 / RATE / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return times, q + NOISE * rng.standard_normal(q.shape), u


def motion_with_rates(run, count):
    """Return times (T,), positions, their derivatives and commands (T, 2) of a run."""
    times, q, u = motion(run, count)
    return times, q, np.gradient(q, times, axis=0), u


def _frame(run, count):
    import pandas

    times, q, u = motion(run, count)
    columns = {"t": times}
    for k, joint in enumerate(JOINTS):
        columns |= {f"{joint}_pos": q[:, k], f"{joint}_cmd": u[:, k]}
    return pandas.DataFrame(columns)


def write_csv(folder, run, count):
    _frame(run, count).to_csv(folder / f"run{run}.csv", index=False)


def write_spreadsheet(folder, run, count):
    """Write decimal commas, semicolons, a comment above the header and degrees in the names."""
    table = _frame(run, count)
    table = table.rename(columns=lambda name: name if name == "t" else f"{name} [deg]")
    table.iloc[:, 1:] = np.degrees(table.iloc[:, 1:])
    with (folder / f"run{run}.csv").open("w") as file:
        file.write("# exported on Monday\n")
        table.to_csv(file, sep=";", decimal=",", index=False)


def write_rostopic(folder, run, count, commanded=JOINTS):
    """Write the tables of ``rostopic echo -p``; joints are sorted the other way round.

    Args:
        folder: folder of all runs.
        run: number of the run.
        count: number of samples.
        commanded: joints in the order of their commands, which have no names.
    """
    own = folder / f"run{run}"
    own.mkdir()
    states = ["%time", "name0", "name1", "position0", "position1", "velocity0", "velocity1"]
    rows = [",field.".join(states)]
    commands = ["%time,field.data0,field.data1"]
    for t, (a, b), v, u in zip(*motion_with_rates(run, count), strict=True):
        stamp = round((START + t) * NANO)
        rows.append(f"{stamp},knee,hip,{b:.9f},{a:.9f},{v[1]:.9f},{v[0]:.9f}")
        sent = (u[JOINTS.index(joint)] for joint in commanded)
        commands.append(",".join([str(stamp), *(f"{value:.9f}" for value in sent)]))
    (own / "joint_states.csv").write_text("\n".join(rows) + "\n")
    (own / "commands.csv").write_text("\n".join(commands) + "\n")


def write_npz(folder, run, count):
    times, q, u = motion(run, count)
    np.savez(folder / f"run{run}.npz", timestamp=times, actual_q=q, target_q=u)


def write_parquet(folder, run, count):
    _frame(run, count).to_parquet(folder / f"run{run}.parquet")


def write_hdf5(folder, run, count):
    import h5py

    times, q, u = motion(run, count)
    with h5py.File(folder / f"run{run}.h5", "w") as file:
        file["time"], file["joint_pos"], file["joint_target"] = times, q, u


def write_robomimic(folder, run, count):
    """Add a demonstration to one file for all runs; rows have no time stamps."""
    import h5py

    _, q, u = motion(run, count)
    with h5py.File(folder / "demos.hdf5", "a") as file:
        demo = file.create_group(f"data/demo_{run}")
        demo["obs/joint_pos"], demo["actions"] = q, u


def write_torch(folder, run, count):
    import torch

    times, q, u = (torch.from_numpy(part) for part in motion(run, count))
    torch.save({"time": times, "obs": {"q": q}, "target": u}, folder / f"run{run}.pt")


def make_episode(number, times, positions, commands):
    """Return the rows of an episode of a LeRobot dataset."""
    import pandas

    return pandas.DataFrame(
        {
            "action": list(commands.astype(np.float32)),
            "observation.state": list(positions.astype(np.float32)),
            "timestamp": times.astype(np.float32),
            "frame_index": np.arange(times.size),
            "episode_index": np.full(times.size, number),
        }
    )


def make_dataset_folder(folder, version, joints=JOINTS, rate=RATE):
    """Write the description of a LeRobot dataset; return the folder of its rows.

    Args:
        folder: folder of the dataset.
        version: version of the format, such as ``2.1``.
        joints: names of the joints, or None if the dataset does not name them.
        rate: number of rows per second.
    """
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True, exist_ok=True)
    (folder / "meta").mkdir(exist_ok=True)
    names = joints and [f"{joint}.pos" for joint in joints]
    features = {"action": {"names": names}, "observation.state": {"names": {"motors": names}}}
    about = {"codebase_version": f"v{version}", "fps": rate, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    return data


def write_lerobot(folder, run, count):
    """Add an episode to a dataset of version 2.1, in degrees."""
    data = make_dataset_folder(folder, "2.1")
    times, q, u = motion(run, count)
    rows = make_episode(run, times, np.degrees(q), np.degrees(u))
    rows.to_parquet(data / f"episode_{run:06d}.parquet")


def make_stamp(types, seconds):
    """Return a time stamp of ROS."""
    return types.types["builtin_interfaces/msg/Time"](*split_seconds(seconds))


def split_seconds(seconds):
    """Return whole seconds and the remaining nanoseconds."""
    return int(seconds), round(math.fmod(seconds, 1.0) * NANO)


def write_bag(path, storage, make_messages):
    """Write a bag: a file of ROS 1 for the storage "bag", otherwise a folder of ROS 2.

    Args:
        path: path of the bag.
        storage: storage format.
        make_messages: function from the message types to topics, times of writing (s) and messages.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    plugins = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}
    if storage == "bag":
        types, writer = get_typestore(Stores.ROS1_NOETIC), Writer1(path)
    else:
        types = get_typestore(Stores.ROS2_JAZZY)
        writer = Writer(path, version=9, storage_plugin=plugins[storage])
    encode = types.serialize_ros1 if storage == "bag" else types.serialize_cdr
    with writer:
        topics = {}
        for topic, seconds, message in make_messages(types):
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(topics[topic], round(seconds * NANO), encode(message, kind))


def _write_ros(path, run, count, storage):
    """Write joint states that have stamps, and commands and notes that do not.

    The second joint comes first, as in many drivers, and states are written after their stamps.
    """

    def make_messages(types):
        names = ("Header", "String", "Float64MultiArray", "MultiArrayLayout")
        header, note, numbers, layout = (types.types[f"std_msgs/msg/{name}"] for name in names)
        state = types.types["sensor_msgs/msg/JointState"]
        extra = {"seq": 0} if storage == "bag" else {}
        for t, q, v, u in zip(*motion_with_rates(run, count), strict=True):
            seconds = START + t
            head = header(stamp=make_stamp(types, seconds), frame_id="", **extra)
            there = state(head, ["knee", "hip"], q[::-1].copy(), v[::-1].copy(), np.array([]))
            yield "/joint_states", seconds + LATENCY, there
            yield "/hardware/commands", seconds, numbers(layout([], 0), u)
        yield "/note", START, note("begun")

    write_bag(path, storage, make_messages)


def write_ros1(folder, run, count):
    _write_ros(folder / f"run{run}.bag", run, count, "bag")


def write_ros2(folder, run, count):
    _write_ros(folder / f"run{run}", run, count, "mcap")


def write_db3(folder, run, count):
    _write_ros(folder / f"run{run}", run, count, "db3")


def write_json_topics(path, messages):
    """Write topics, times of writing (s) and messages, of which texts are JSON already."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema, topics = writer.register_schema("state", "jsonschema", b"{}"), {}
        for topic, seconds, message in messages:
            if topic not in topics:
                topics[topic] = writer.register_channel(topic, "json", schema)
            text = message if isinstance(message, str) else json.dumps(message)
            stamp = round(seconds * NANO)
            writer.add_message(topics[topic], stamp, text.encode(), stamp)
        writer.finish()


def _iterate_json(run, count, has_objects):
    """Yield joint states, as parallel lists or as a list of objects with names, and commands."""
    for t, q, v, u in zip(*motion_with_rates(run, count), strict=True):
        sec, nsec = split_seconds(START + t)
        message = {"timestamp": {"sec": sec, "nsec": nsec}}
        numbers = {"position": q[::-1].tolist(), "velocity": v[::-1].tolist()}
        if has_objects:
            parts = zip(JOINTS[::-1], *numbers.values(), strict=True)
            keys = ("name", *numbers)
            message["joints"] = [dict(zip(keys, part, strict=True)) for part in parts]
        else:
            message |= {"name": JOINTS[::-1], "note": "x", **numbers}
        yield "/joint_states", START + t + LATENCY, message
        yield "commands", START + t, {"cmd": dict(zip(JOINTS, u, strict=True))}


def write_json(folder, run, count):
    write_json_topics(folder / f"run{run}.mcap", _iterate_json(run, count, has_objects=False))


def write_json_objects(folder, run, count):
    write_json_topics(folder / f"run{run}.mcap", _iterate_json(run, count, has_objects=True))


def write_protobuf(folder, run, count):
    """Write joint states of an own type, with repeated fields and a stamp."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap_protobuf.writer import Writer

    file = descriptor_pb2.FileDescriptorProto(name="states.proto", package="t", syntax="proto3")
    kinds = descriptor_pb2.FieldDescriptorProto
    fields = {
        "Stamp": {"seconds": kinds.TYPE_INT64, "nanos": kinds.TYPE_INT32},
        "State": {
            "stamp": kinds.TYPE_MESSAGE, "on": kinds.TYPE_BOOL, "name": kinds.TYPE_STRING,
            "position": kinds.TYPE_DOUBLE, "velocity": kinds.TYPE_DOUBLE, "cmd": kinds.TYPE_DOUBLE,
        },
    }  # fmt: skip
    for message, members in fields.items():
        made = file.message_type.add(name=message)
        for number, (name, kind) in enumerate(members.items(), 1):
            is_list = kind in (kinds.TYPE_STRING, kinds.TYPE_DOUBLE)
            label = kinds.LABEL_REPEATED if is_list else kinds.LABEL_OPTIONAL
            of = ".t.Stamp" if name == "stamp" else None
            made.field.add(name=name, number=number, type=kind, label=label, type_name=of)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    state = message_factory.GetMessageClass(pool.FindMessageTypeByName("t.State"))
    with (folder / f"run{run}.mcap").open("wb") as out, Writer(out) as writer:
        for k, (t, *numbers) in enumerate(zip(*motion_with_rates(run, count), strict=True)):
            q, v, u = (values[::-1].tolist() for values in numbers)
            made = state(name=JOINTS[::-1], on=2 * k < count, position=q, velocity=v, cmd=u)
            made.stamp.seconds, made.stamp.nanos = split_seconds(START + t)
            written = round((START + t) * NANO)
            writer.write_message("states", made, written, written)


def write_protobuf_values(folder, run, count):
    """Write lists of values that are numbers or something else, one topic for each."""
    from google.protobuf import struct_pb2
    from mcap_protobuf.writer import Writer

    times, q, u = motion(run, count)
    with (folder / f"run{run}.mcap").open("wb") as file, Writer(file) as writer:
        for t, position, command in zip(times, q, u, strict=True):
            stamp = round((START + t) * NANO)
            for topic, values in (("/positions", position), ("/targets", command)):
                message = struct_pb2.ListValue()
                message.extend(values.tolist())
                writer.write_message(topic, message, stamp, stamp)


WRITERS = {
    "csv": write_csv,
    "spreadsheet": write_spreadsheet,
    "rostopic": write_rostopic,
    "npz": write_npz,
    "parquet": write_parquet,
    "hdf5": write_hdf5,
    "robomimic": write_robomimic,
    "torch": write_torch,
    "lerobot": write_lerobot,
    "ros1": write_ros1,
    "ros2": write_ros2,
    "db3": write_db3,
    "mcap json": write_json,
    "mcap json objects": write_json_objects,
    "mcap protobuf": write_protobuf,
    "mcap protobuf values": write_protobuf_values,
}
"""Function that writes a run, by format: folder, number of the run, number of samples."""
WITH_RATES = (
    *("rostopic", "ros1", "ros2", "db3", "mcap json", "mcap json objects", "mcap protobuf"),
)
"""Formats whose writer also writes velocities."""
OPTIONS = {
    "robomimic": ("--rate", "100"),
    "lerobot": ("--position-unit", "deg"),
}
"""Options of `simgap import` that a format needs."""
NEEDED = {
    "hdf5": "h5py", "robomimic": "h5py", "torch": "torch", "ros1": "rosbags", "ros2": "rosbags",
    "db3": "rosbags", "mcap json": "mcap", "mcap json objects": "mcap",
    "mcap protobuf": "mcap_protobuf", "mcap protobuf values": "mcap_protobuf",
}  # fmt: skip
"""Package with which a format is written."""


def write_folder(folder, kind, runs=3, count=200):
    """Write the raw folder of a format, and the model file outside of it.

    Returns:
        The folder of the logs and the model file.
    """
    logs = folder / "logs"
    logs.mkdir(parents=True)
    for run in range(runs):
        WRITERS[kind](logs, run, count)
    (folder / "arm.xml").write_text(ARM)
    return logs, folder / "arm.xml"
