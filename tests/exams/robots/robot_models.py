"""Robot models of the exam, drawn from a seed: generated arms, UR5, Panda and KUKA iiwa."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from tests.exams.robots.exam_robots import Drive, Machine, plain

FASTEST = 300.0  # Largest damping rate of a servo in 1/s, so that 1 ms steps resolve it.


def link(name, mass, com, tensor):
    """Return the URDF text of a link; kg, m, and principal moments in kg m^2."""
    (x, y, z), (ixx, iyy, izz) = com, tensor
    return (
        f'<link name="{name}"><inertial><origin xyz="{x:.6g} {y:.6g} {z:.6g}"/>'
        f'<mass value="{mass:.6g}"/><inertia ixx="{ixx:.6g}" ixy="0" ixz="0" iyy="{iyy:.6g}" '
        f'iyz="0" izz="{izz:.6g}"/></inertial></link>'
    )


def joint(name, kind, parent, child, origin, axis, limits, damping=0.0, friction=0.0):
    """Return the URDF text of a joint."""
    (x, y, z), (low, high, effort) = origin, limits
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x:.6g} {y:.6g} {z:.6g}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="50"/>'
        f'<dynamics damping="{damping:.6g}" friction="{friction:.6g}"/></joint>'
    )


def urdf(name, *parts):
    """Return a robot whose root is a link without mass."""
    return plain(f'<robot name="{name}"><link name="base"/>{"".join(parts)}</robot>')


def rod(mass, length, radius=0.03):
    """Return (mass, centre of mass, moments) of a rod that hangs from its joint."""
    across = mass * (3 * radius**2 + length**2) / 12
    return mass, (0.0, 0.0, -length / 2), (across, across, mass * radius**2 / 2)


def hanging(name, lengths, masses, names, axes=None, damping=0.0):
    """Return an arm of rods that hangs down at zero."""
    parts, parent, origin = [], "base", (0.0, 0.0, 0.0)
    axes = axes or ["0 1 0"] * len(lengths)
    dampings = np.broadcast_to(damping, len(lengths))
    for number, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        body = f"{names[number]}_link"
        parts.append(link(body, *rod(mass, length)))
        limits = (-6.28, 6.28, 200)
        parts.append(
            joint(
                names[number], "revolute", parent, body, origin, axes[number], limits,
                dampings[number],
            )
        )  # fmt: skip
        parent, origin = body, (0.0, 0.0, -length)
    return urdf(name, *parts)


def _arm2(rng):
    lengths, masses = rng.uniform(0.25, 0.4, 2), rng.uniform([1.0, 0.5], [2.5, 1.5])
    text = hanging(
        "arm2", lengths, masses, ("shoulder", "elbow"), damping=rng.uniform(0.05, 0.2, 2)
    )
    return text, (0.0, 0.0)


def _double(rng):
    lengths, masses = rng.uniform(0.15, 0.3, 2), rng.uniform(0.1, 0.4, 2)
    text = hanging(
        "double", lengths, masses, ("upper", "lower"), damping=rng.uniform(5e-3, 1e-2, 2)
    )
    return text, (0.0, 0.0)


def _cartpole(rng):
    cart, pole, length = rng.uniform(0.5, 2.0), rng.uniform(0.1, 0.4), rng.uniform(0.3, 0.6)
    parts = (
        link("cart", cart, (0, 0, 0), (0.01, 0.01, 0.01)),
        joint("slide", "prismatic", "base", "cart", (0, 0, 0), "1 0 0", (-3, 3, 100), 2.0),
        link("pole", *rod(pole, length)),
        joint(
            "hinge", "revolute", "cart", "pole", (0, 0, 0), "0 1 0", (-6.28, 6.28, 50),
            rng.uniform(2e-3, 1e-2),
        ),
    )  # fmt: skip
    return urdf("cartpole", *parts), (0.0, 0.0)


def _random(rng):
    count = int(rng.integers(2, 6))
    lengths, masses = rng.uniform(0.15, 0.4, count), np.sort(rng.uniform(0.3, 2.5, count))[::-1]
    axes = ["0 1 0"] + [str(rng.choice(["0 1 0", "1 0 0"])) for _ in range(count - 1)]
    names = tuple(f"j{k + 1}" for k in range(count))
    inertia = np.array([np.sum(masses[k:]) * np.sum(lengths[k:]) ** 2 / 3 for k in range(count)])
    text = hanging("random", lengths, masses, names, axes, rng.uniform(0.3, 1.0) * inertia)
    return text, tuple(np.zeros(count))


def example(name):
    """Return the text of a file of the PyPI package example-robot-data."""
    import pinocchio

    for folder in Path(pinocchio.__file__).parents:
        if (folder / "share/example-robot-data/robots" / name).exists():
            return (folder / "share/example-robot-data/robots" / name).read_text()
    raise FileNotFoundError(f"{name}: expected example-robot-data, as installed for development")


def _ur5(rng):
    pose = np.array([0.0, -1.2, 1.4, -0.8, -1.2, 0.3]) + rng.uniform(-0.3, 0.3, 6)
    return plain(example("ur_description/urdf/ur5_robot.urdf")), tuple(pose)


def _panda(rng):
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    pose = np.array([0.0, -0.4, 0.0, -1.9, 0.0, 1.6, 0.5]) + rng.uniform(-0.2, 0.2, 7)
    return plain(example("panda_description/urdf/panda.urdf"), fingers), tuple(pose)


def _iiwa(rng):
    import pybullet_data

    path = Path(pybullet_data.__file__).parent / "kuka_iiwa/model.urdf"
    pose = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0]) + rng.uniform(-0.2, 0.2, 7)
    return plain(path.read_text()), tuple(pose)


KINDS = {
    "arm2": _arm2,
    "double": _double,
    "cartpole": _cartpole,
    "random": _random,
    "ur5": _ur5,
    "panda": _panda,
    "iiwa": _iiwa,
}
MOTORS = ("arm2", "double", "cartpole", "random")
"""Robots driven by forces around their hanging pose; the other robots would fall."""
SERVOS = ("arm2", "random", "ur5", "panda", "iiwa")
NAMES = tuple(f"{name}-motor" for name in MOTORS) + tuple(f"{name}-servo" for name in SERVOS)


def machine(name, rng, numerics=None):
    """Draw a machine.

    Args:
        name: robot and drive, one of `NAMES`.
        rng: random generator for its numbers, pose and mounting.
        numerics: (step, integrator) that the recording specifies; (0.002, "RK4") if None.
    """
    kind, _, drive = name.partition("-")
    text, pose = KINDS[kind](rng)
    tilted = rng.uniform(-0.15, 0.15, 3) if drive == "motor" else rng.uniform(-0.6, 0.6, 3)
    if rng.random() < 0.5 and kind != "cartpole":
        text = plain(text, mount=tilted)
    step, integrator = numerics or (0.002, "RK4")
    bare = Machine(name, text, (), pose, step, integrator)
    return Machine(name, text, _drives(bare, drive, rng), pose, step, integrator)


def _drives(bare, kind, rng):
    """Return a motor for each joint, or servos with gains that suit the moved inertia.

    The cartpole has a motor at its cart only, the double pendulum at one of its two joints.
    """
    efforts = _efforts(bare)
    if kind == "motor":
        joints = {"cartpole-motor": [0], "double-motor": [int(rng.integers(2))]}.get(
            bare.name, range(len(bare.joints))
        )
        return tuple(Drive(bare.joints[j], "motor", 0.0, 0.0, efforts[j]) for j in joints)
    quick, damped = rng.uniform(12.0, 25.0), rng.uniform(0.6, 1.0)
    drives = []
    for j, inertia in enumerate(_served(bare, 2 * damped * quick)):
        kp, kv = _rounded(quick**2 * inertia), _rounded(2 * damped * quick * inertia)
        drives.append(Drive(bare.joints[j], "position", kp, kv, efforts[j]))
    return tuple(drives)


def _served(bare, rate):
    """Return the inertia for which each servo is designed, kg m^2.

    It is the inertia that the joint moves, or a fraction of the largest one if that is more. The
    fraction is reduced until no servo is faster than `FASTEST`.
    """
    import pinocchio

    model = bare.model()
    mass = pinocchio.crba(model, model.createData(), np.array(bare.pose))
    mass = np.triu(mass) + np.triu(mass, 1).T
    moved = np.diag(mass)
    for share in (0.03, 0.01, 3e-3, 1e-3, 0.0):
        served = np.maximum(moved, share * moved.max())
        quickest = np.abs(np.linalg.eigvals(np.linalg.solve(mass, np.diag(rate * served)))).max()
        if quickest <= FASTEST:
            break
    return served


def _efforts(bare):
    tree = ElementTree.fromstring(bare.urdf)
    limits = {j.get("name"): j.find("limit") for j in tree.findall("joint")}
    return [float(limits[name].get("effort")) for name in bare.joints]


def _rounded(value):
    return float(f"{value:.3g}")
