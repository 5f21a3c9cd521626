"""Draw a random arm, move it in MuJoCo, and write its log with one convention broken or none.

MuJoCo alone makes the motion, so the data are independent of the code under test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tests.exams.planted.planted_motion import Change
from tests.exams.robot_files import write_robot_recording

BROKEN = (
    "sign of position",
    "sign of command",
    "sign of both",
    "zero of position",
    "zero of both",
    "unit of one",
    "unit of all",
    "exchanged positions",
    "exchanged commands",
    "exchanged both",
    "wrapped",
    "late commands",
)
"""Conventions to break, one in each log."""
CAUSES = ("nothing", "friction", "damping", "delay", "offset", "mass", "stiffness")
"""Causes in correct logs; they are not broken conventions."""
CHANGES = {
    "friction": ("frictionloss", "j", (0.1, 0.8)), "damping": ("damping", "j", (0.5, 3.0)),
    "mass": ("mass", "link", (0.2, 0.8)), "stiffness": ("kp", "m", (0.2, 0.6)),
}  # fmt: skip
"""Kind of the changed number, begin of the name of its place, and limits of its size, by cause."""
RATE, SECONDS, RUNS, NOISE = 100.0, 3.0, 3, 5e-4
TIMESTEP = 0.002


@dataclass(frozen=True)
class Log:
    """A log on disk.

    Attributes:
        path: path of the table.
        broken: the broken convention; None for a correct log.
        cause: hidden cause of a correct log.
        joints: numbers of the affected joints.
        size: size of the offset, factor or delay.
    """

    path: Path
    broken: str | None
    cause: str
    joints: tuple[int, ...]
    size: float


def write_log(folder: Path, seed: int, broken: str | None, cause: str = "nothing") -> Log:
    """Draw an arm and write its log.

    Args:
        folder: a folder that does not exist yet.
        seed: seed of everything that is drawn.
        broken: one of `BROKEN`; None for a correct log.
        cause: one of `CAUSES`.
    """
    rng = np.random.default_rng([seed, 7])
    joints = int(rng.integers(2, 8))
    servo = bool(rng.random() < 0.6) or (broken or "").endswith(("both", "commands"))
    axes = _axes(rng, joints)
    gravity_joints = _find_gravity_joints(axes)
    joint = int(rng.choice(gravity_joints))
    text = _model(rng, axes, servo)
    model = mujoco.MjModel.from_xml_string(text)
    concerned, size = (joint,), 0.0
    if broken is None:
        size = _hide(model, rng, cause, joint, servo)
    travel = np.zeros(joints)
    if broken == "wrapped":
        travel[joint] = math.pi
    runs = [_run(model, rng, servo, cause, joint, size, travel) for _ in range(RUNS)]
    q, qd, u = (np.stack([run[k] for run in runs]) for k in range(3))
    q = q + NOISE * rng.standard_normal(q.shape)
    if broken is None and cause == "offset":
        q[..., joint] += size
    units = {"q": ["rad"] * joints, "u": ["rad" if servo else "N*m"] * joints}
    if broken is not None:
        concerned, size = _break(rng, broken, joint, gravity_joints, q, qd, u, units, servo)
    _write(folder, q, qd if rng.random() < 0.5 else None, u, units, text)
    return Log(folder / "log.csv", broken, cause, concerned, size)


def _axes(rng, joints):
    """Draw an axis for each joint; the first is often vertical, the others seldom are."""
    kinds = ["0 0 1", "0 1 0", "1 0 0"]
    axes = [str(rng.choice(kinds, p=[0.6, 0.3, 0.1]))]
    for _ in range(joints - 1):
        axes.append(str(rng.choice(kinds, p=[0.15, 0.65, 0.2])))
    if not any(axis != "0 0 1" for axis in axes[1:]):
        axes[1] = "0 1 0"
    return axes


def _find_gravity_joints(axes):
    """Return the joints on which gravity acts; the zero of the others cannot be identified."""
    return [i for i, axis in enumerate(axes) if axis == "0 1 0"] or [1]


def _model(rng, axes, servo):
    """Return the MJCF of an arm whose links bend sideways, so every joint carries weight."""
    body, ends, tip = "", "", "0 0 0.2"
    for i, axis in enumerate(axes):
        length = float(rng.uniform(0.15, 0.35))
        aside = float(rng.uniform(0.02, 0.08))
        radius = float(rng.uniform(0.025, 0.04))
        at = tip
        tip = f"{length:.4f} {aside:.4f} 0"
        body += (
            f'<body name="link{i}" pos="{at}"><joint name="j{i}" axis="{axis}" '
            f'damping="{rng.uniform(0.05, 0.3):.4f}" armature="{rng.uniform(0.01, 0.05):.4f}"/>'
            f'<geom type="capsule" fromto="0 0 0 {tip}" size="{radius:.4f}" density="1500" '
            'contype="0" conaffinity="0"/>'
        )
        ends += "</body>"
    drives = ""
    for i in range(len(axes)):
        if servo:
            kp = float(rng.uniform(60.0, 200.0)) / (1 + i)
            drives += f'<position name="m{i}" joint="j{i}" kp="{kp:.2f}" kv="{0.12 * kp:.3f}"/>'
        else:
            drives += f'<motor name="m{i}" joint="j{i}"/>'
    return (
        f'<mujoco model="arm"><option timestep="{TIMESTEP}" integrator="implicitfast"/>'
        f"<worldbody>{body}{ends}</worldbody><actuator>{drives}</actuator></mujoco>"
    )


def _hide(model, rng, cause, joint, servo):
    """Put a cause into the model and return its size."""
    if cause in CHANGES and (servo or cause != "stiffness"):
        kind, place, limits = CHANGES[cause]
        size = float(rng.uniform(*limits))
        Change(kind, f"{place}{joint}", size).apply(model)
        return size
    if cause == "offset":
        return float(rng.uniform(0.01, 0.05))
    return float(rng.integers(1, 4)) / RATE if cause == "delay" else 0.0


def _run(model, rng, servo, cause, joint, size, travel):
    """Simulate one run: positions, velocities and commands (T, D) at the samples."""
    count, every = int(SECONDS * RATE) + 1, round(1.0 / RATE / TIMESTEP)
    joints = model.nv
    data = mujoco.MjData(model)
    middle = rng.uniform(-0.6, 0.6, joints) + travel
    waves = [
        (rng.uniform(0.1, 0.35, joints), rng.uniform(0.3, 1.2, joints), rng.uniform(0, 6.3, joints))
        for _ in range(3)
    ]
    ramp = np.where(travel > 0, 0.5, 0.0)
    data.qpos[:] = middle + sum(a * np.sin(p) for a, _, p in waves)
    mujoco.mj_forward(model, data)
    q, qd, u = (np.zeros((count, joints)) for _ in range(3))
    delay = round(size * RATE) if cause == "delay" else 0
    for k in range(count):
        t = k / RATE
        wanted = (
            middle
            + sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in waves)
            + ramp * np.sin(2.0 * t)
        )
        q[k], qd[k] = data.qpos, data.qvel
        if servo:
            u[k] = wanted
        else:
            # Log the torques of a controller with gravity compensation.
            mujoco.mj_forward(model, data)
            torque = np.zeros((1, joints))
            wish = 60.0 * (wanted - data.qpos) - 12.0 * data.qvel
            mujoco.mj_mulM(model, data, torque[0], wish)
            u[k] = torque[0] + data.qfrc_bias
        data.ctrl[:] = u[max(k - delay, 0)]
        for _ in range(every):
            mujoco.mj_step(model, data)
    return q, qd, u


def _break(rng, broken, joint, gravity_joints, q, qd, u, units, servo):
    """Break a convention in place; return the affected joints and the size."""
    joints = q.shape[-1]
    other = int(rng.choice([i for i in range(joints) if i != joint]))
    concerned = [v for v, part in ((q, "position"), (qd, "position"), (u, "command"))
                 if broken.endswith("both") or part in broken]  # fmt: skip
    if broken.startswith("sign"):
        for values in concerned:
            values[..., joint] *= -1.0
    elif broken.startswith("exchanged"):
        for values in concerned:
            values[..., [joint, other]] = values[..., [other, joint]]
        return (joint, other), 0.0
    elif broken in ("zero of position", "zero of both"):
        size = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.25, 2.8))
        q[..., joint] += size
        if broken == "zero of both" and servo:
            u[..., joint] += size
        return (joint,), size
    elif broken == "unit of one":
        q[..., joint] *= 180.0 / math.pi
    elif broken == "unit of all":
        factor = float(rng.choice([180.0 / math.pi, 1000.0]))
        q *= factor
        if servo and rng.random() < 0.5:
            u *= factor
        return tuple(range(joints)), factor
    elif broken == "wrapped":
        q[..., joint] = (q[..., joint] + math.pi) % (2.0 * math.pi) - math.pi
    elif broken == "late commands":
        late = int(rng.integers(1, 6))
        u[:] = np.concatenate([np.repeat(u[:, :1], late, axis=1), u[:, :-late]], axis=1)
        return (joint,), late / RATE
    return (joint,), 0.0


def _write(folder, q, qd, u, units, model):
    joints = q.shape[-1]
    inputs = {f"u.m{i}": units["u"][i] for i in range(joints)}
    channels = {f"q.j{i}": ("rad", None) for i in range(joints)}
    readings = q
    if qd is not None:
        channels |= {f"qd.j{i}": ("rad/s", None) for i in range(joints)}
        readings = np.concatenate([q, qd], axis=-1)
    times = np.arange(q.shape[1]) / RATE
    runs = {f"r{k + 1}": (k == RUNS - 1, times, u[k], readings[k]) for k in range(RUNS)}
    write_robot_recording(folder, "log", inputs, channels, runs, ("arm.xml", model), ".4g")
