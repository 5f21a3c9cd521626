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


def write_rostopic(folder, run, count):
    """Write the tables of ``rostopic echo -p``; joints are sorted the other way round."""
    own = folder / f"run{run}"
    own.mkdir()
    times, q, u = motion(run, count)
    rows = ["%time,field.name0,field.name1,field.position0,field.position1"]
    commands = ["%time,field.data0,field.data1"]
    for t, (a, b), (c, d) in zip(times, q, u, strict=True):
        stamp = round((START + t) * NANO)
        rows.append(f"{stamp},knee,hip,{b:.9f},{a:.9f}")
        commands.append(f"{stamp},{c:.9f},{d:.9f}")
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


def write_lerobot(folder, run, count):
    """Add an episode to a dataset of version 2.1, in degrees."""
    import pandas

    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True, exist_ok=True)
    (folder / "meta").mkdir(exist_ok=True)
    names = [f"{joint}.pos" for joint in JOINTS]
    features = {name: {"names": names} for name in ("action", "observation.state")}
    about = {"codebase_version": "v2.1", "fps": RATE, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    times, q, u = motion(run, count)
    pandas.DataFrame(
        {
            "action": list(np.degrees(u).astype(np.float32)),
            "observation.state": list(np.degrees(q).astype(np.float32)),
            "timestamp": times.astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, run),
        }
    ).to_parquet(data / f"episode_{run:06d}.parquet")


def _write_ros(path, run, count, storage):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = Stores.ROS1_NOETIC if storage == "bag" else Stores.ROS2_JAZZY
    types = get_typestore(store)
    plugins = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}
    writer = (
        Writer1(path)
        if storage == "bag"
        else Writer(path, version=9, storage_plugin=plugins[storage])
    )
    made = {
        name: types.types[f"{package}/msg/{name}"]
        for package, name in (
            ("builtin_interfaces", "Time"), ("std_msgs", "Header"), ("sensor_msgs", "JointState"),
            ("std_msgs", "Float64MultiArray"), ("std_msgs", "MultiArrayLayout"),
        )
    }  # fmt: skip
    times, q, u = motion(run, count)
    with writer:
        topics = {}
        for t, position, command in zip(times, q, u, strict=True):
            seconds = START + t
            sec = int(seconds)
            stamp = made["Time"](sec, round((seconds - sec) * NANO))
            extra = {"seq": 0} if storage == "bag" else {}
            header = made["Header"](stamp=stamp, frame_id="", **extra)
            nothing = np.array([])
            state = made["JointState"](
                header, ["knee", "hip"], position[::-1].copy(), nothing, nothing
            )
            target = made["Float64MultiArray"](made["MultiArrayLayout"]([], 0), command)
            for topic, message in (("/joint_states", state), ("/commands", target)):
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=types)
                encode = types.serialize_ros1 if storage == "bag" else types.serialize_cdr
                writer.write(topics[topic], round(seconds * NANO), encode(message, kind))


def write_ros1(folder, run, count):
    _write_ros(folder / f"run{run}.bag", run, count, "bag")


def write_ros2(folder, run, count):
    _write_ros(folder / f"run{run}", run, count, "mcap")


def write_db3(folder, run, count):
    _write_ros(folder / f"run{run}", run, count, "db3")


def write_json(folder, run, count):
    from mcap.writer import Writer

    times, q, u = motion(run, count)
    with (folder / f"run{run}.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        channel = writer.register_channel("/state", "json", schema)
        for t, position, command in zip(times, q, u, strict=True):
            seconds = START + t
            stamp = {"sec": int(seconds), "nsec": round(math.fmod(seconds, 1.0) * NANO)}
            message = {"timestamp": stamp, "name": list(JOINTS), "position": position.tolist()}
            message["command"] = command.tolist()
            written = round(seconds * NANO)
            writer.add_message(channel, written, json.dumps(message).encode(), written)
        writer.finish()


def write_protobuf(folder, run, count):
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
    "mcap protobuf": write_protobuf,
}
"""Function that writes a run, by format: folder, number of the run, number of samples."""
OPTIONS = {
    "robomimic": ("--rate", "100"),
    "lerobot": ("--position-unit", "deg"),
}
"""Options of `simgap import` that a format needs."""
NEEDED = {
    "hdf5": "h5py", "robomimic": "h5py", "torch": "torch", "ros1": "rosbags", "ros2": "rosbags",
    "db3": "rosbags", "mcap json": "mcap", "mcap protobuf": "mcap_protobuf",
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
