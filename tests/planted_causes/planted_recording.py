"""Write a case as the files of a user: model, table and description."""

from __future__ import annotations

import hashlib

from tests.planted_causes.planted_motion import HELD_OUT, RATE, SAMPLES
from tests.planted_causes.planted_robots import ROBOTS


def write(item, folder):
    """Write the recording of an item into a folder and return the path of its table."""
    folder.mkdir(parents=True, exist_ok=True)
    robot, experiment = ROBOTS[item.robot], item.experiment
    (folder / robot.model_name).write_text(robot.model_text(item.force_limits))
    actuators = [experiment.model.actuator(i).name for i in range(experiment.model.nu)]
    channels = [f"q.{joint}" for joint in experiment.joints]
    if item.with_velocities:
        channels += [f"qd.{joint}" for joint in experiment.joints]
    lines = [",".join(["run", "t", *(f"u.{name}" for name in actuators), *channels])]
    runs, _ = item.truth
    for name, values in item.measured().items():
        commands = runs[name].commands
        for row in range(SAMPLES):
            cells = [f"{x:.9g}" for x in (*commands[row], *values[row])]
            lines.append(",".join([name, f"{row / RATE:.2f}", *cells]))
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    (folder / "log.toml").write_text(_description(item, actuators, channels))
    return folder / "log.csv"


def digest(folder):
    """Return a SHA-256 hash of all files of a recording; equal hashes mean equal cases."""
    content = b"".join(path.read_bytes() for path in sorted(folder.iterdir()))
    return hashlib.sha256(content).hexdigest()[:16]


def _description(item, actuators, channels):
    robot, model = ROBOTS[item.robot], item.experiment.model
    lines = [f'model = "{robot.model_name}"', ""]
    if robot.is_urdf:
        timestep, integrator = robot.engine
        lines += ["[engine]", f"timestep = {timestep}", f'integrator = "{integrator}"', ""]
    for index, name in enumerate(actuators):
        joint = model.joint(model.actuator_trnid[index, 0])
        is_slide = joint.type[0] == 2  # mjJNT_SLIDE
        if robot.drive == "servo":
            unit = "m" if is_slide else "rad"
        else:
            unit = "N" if is_slide else "N*m"
        lines += [f'[inputs."u.{name}"]', f'unit = "{unit}"', ""]
        if robot.is_urdf:
            lines += [f"[actuators.{name}]", f'joint = "{joint.name}"']
            if robot.drive == "servo":
                kp, kv = robot.gains
                lines += ['kind = "position"', f"kp = {kp}", f"kv = {kv}"]
                if joint.name in item.force_limits:
                    limit = item.force_limits[joint.name]
                    lines += [f"force_range = [{-limit:g}, {limit:g}]"]
            else:
                lines += ['kind = "motor"']
            lines += [""]
    for channel, sigma in zip(channels, item.experiment.sigma, strict=True):
        is_slide = model.joint(channel.partition(".")[2]).type[0] == 2
        unit = "m" if is_slide else "rad"
        unit = f"{unit}/s" if channel.startswith("qd.") else unit
        lines += [f'[channels."{channel}"]', f'unit = "{unit}"', f"noise = {sigma:g}", ""]
    lines += [f"[runs.{HELD_OUT}]", "held_out = true", ""]
    return "\n".join(lines)
