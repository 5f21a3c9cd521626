"""The robots that are asked about, drawn by a seed: arms of our own, UR5, Panda, KUKA iiwa."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from tests.robot_exam.exam_robots import Drive, Machine, plain

FASTEST = 300.0  # 1/s: no servo's damping is quicker than this, so that a millisecond follows it


def link(name, mass, com, tensor):
    """Text of a link: kg, m, and the principal moments in kg m^2."""
    (x, y, z), (ixx, iyy, izz) = com, tensor
    return (
        f'<link name="{name}"><inertial><origin xyz="{x:.6g} {y:.6g} {z:.6g}"/>'
        f'<mass value="{mass:.6g}"/><inertia ixx="{ixx:.6g}" ixy="0" ixz="0" iyy="{iyy:.6g}" '
        f'iyz="0" izz="{izz:.6g}"/></inertial></link>'
    )


def joint(name, kind, parent, child, origin, axis, limits, damping=0.0, friction=0.0):
    """Text of a joint."""
    (x, y, z), (low, high, effort) = origin, limits
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x:.6g} {y:.6g} {z:.6g}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="50"/>'
        f'<dynamics damping="{damping:.6g}" friction="{friction:.6g}"/></joint>'
    )


def urdf(name, *parts):
    """A whole robot whose root is a link without mass."""
    return plain(f'<robot name="{name}"><link name="base"/>{"".join(parts)}</robot>')


def rod(mass, length, radius=0.03):
    """(mass, centre of mass, moments) of a rod that hangs down from its joint."""
    across = mass * (3 * radius**2 + length**2) / 12
    return mass, (0.0, 0.0, -length / 2), (across, across, mass * radius**2 / 2)


def hanging(name, lengths, masses, names, axes=None, damping=0.0):
    """An arm of rods that hangs down at zero."""
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
    return text, (), (0.0, 0.0)


def _double(rng):
    lengths, masses = rng.uniform(0.15, 0.3, 2), rng.uniform(0.1, 0.4, 2)
    text = hanging(
        "double", lengths, masses, ("upper", "lower"), damping=rng.uniform(5e-3, 1e-2, 2)
    )
    return text, (), (0.0, 0.0)


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
    return urdf("cartpole", *parts), (), (0.0, 0.0)


def _random(rng):
    count = int(rng.integers(2, 6))
    lengths, masses = rng.uniform(0.15, 0.4, count), np.sort(rng.uniform(0.3, 2.5, count))[::-1]
    axes = ["0 1 0"] + [str(rng.choice(["0 1 0", "1 0 0"])) for _ in range(count - 1)]
    names = tuple(f"j{k + 1}" for k in range(count))
    inertia = np.array([np.sum(masses[k:]) * np.sum(lengths[k:]) ** 2 / 3 for k in range(count)])
    text = hanging("random", lengths, masses, names, axes, rng.uniform(0.3, 1.0) * inertia)
    return text, (), tuple(np.zeros(count))


def example(name):
    """Text of a file of PyPI's example-robot-data."""
    import pinocchio

    for folder in Path(pinocchio.__file__).parents:
        if (folder / "share/example-robot-data/robots" / name).exists():
            return (folder / "share/example-robot-data/robots" / name).read_text()
    raise FileNotFoundError(f"{name}: expected example-robot-data, as installed for development")


def _ur5(rng):
    pose = np.array([0.0, -1.2, 1.4, -0.8, -1.2, 0.3]) + rng.uniform(-0.3, 0.3, 6)
    return plain(example("ur_description/urdf/ur5_robot.urdf")), (), tuple(pose)


def _panda(rng):
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    pose = np.array([0.0, -0.4, 0.0, -1.9, 0.0, 1.6, 0.5]) + rng.uniform(-0.2, 0.2, 7)
    return plain(example("panda_description/urdf/panda.urdf"), fingers), fingers, tuple(pose)


def _iiwa(rng):
    import pybullet_data

    path = Path(pybullet_data.__file__).parent / "kuka_iiwa/model.urdf"
    pose = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0]) + rng.uniform(-0.2, 0.2, 7)
    return plain(path.read_text()), (), tuple(pose)


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
"""Driven by forces about where they hang; the others would fall."""
SERVOS = ("arm2", "random", "ur5", "panda", "iiwa")
NAMES = tuple(f"{name}-motor" for name in MOTORS) + tuple(f"{name}-servo" for name in SERVOS)


def machine(name, rng, numerics=None):
    """A machine of `NAMES`.

    Args:
        name: robot and drive.
        rng: draws its numbers, its pose, and how it is mounted.
        numerics: (step, integrator) that the recording states; fine ones where it is None.
    """
    kind, _, drive = name.partition("-")
    text, _, pose = KINDS[kind](rng)
    tilted = rng.uniform(-0.15, 0.15, 3) if drive == "motor" else rng.uniform(-0.6, 0.6, 3)
    if rng.random() < 0.5 and kind != "cartpole":
        text = plain(text, mount=tilted)
    step, integrator = numerics or (0.002, "RK4")
    bare = Machine(name, text, (), pose, step, integrator)
    return Machine(name, text, _drives(bare, drive, rng), pose, step, integrator)


def _drives(bare, kind, rng):
    """A motor at every joint (of the cartpole its cart, of the double pendulum one of two), or
    servos whose gains suit what each joint moves.
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
    """The inertia that each servo is made for, kg m^2: what its joint moves, and no less than a
    share of the most, unless a servo with this share would be too quick.
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
