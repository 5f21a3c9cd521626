"""Model files of installed packages for the planted-cause test.

Each robot is the file from its package, with the few edits that a user would make: a trunk is fixed
to a stand, shapes of a URDF are removed, fingers are locked, motors are replaced by position
servos.
"""

from __future__ import annotations

import importlib.util
import sysconfig
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from tests.exams.exam import UndrawableError
from tests.exams.robots.exam_robots import Drive, compile_urdf, plain

STIFF_SERVO = (2000.0, 100.0)
"""Gains kp (N m/rad) and kv (N m s/rad) of a stiff position servo."""


class MissingModelError(UndrawableError):
    """The package that contains a model file is not installed."""


@dataclass(frozen=True)
class Robot:
    """A model file and how it is driven.

    Attributes:
        name: name of the robot in this test.
        package: package of the file: "gymnasium", "example-robot-data" or "pybullet_data".
        path: path of the file inside the package.
        drive: "motor" or "servo".
        pose: position around which each joint moves (rad or m), by joint; the default is 0.
        swing: amplitude of the commanded motion, rad or m.
        gains: kp and kv of every servo.
        locked: joints that are removed (MJCF) or fixed (URDF).
        driven: joints with a drive; if empty, every joint.
        engine: timestep (s) and integrator; the file's own if None.
        height: z of the root body of an MJCF on a stand, m.
    """

    name: str
    package: str
    path: str
    drive: str
    pose: dict[str, float]
    swing: float = 0.3
    gains: tuple[float, float] = STIFF_SERVO
    locked: tuple[str, ...] = ()
    driven: tuple[str, ...] = ()
    engine: tuple[float, str] | None = None
    height: float | None = None

    @property
    def is_urdf(self):
        return self.path.endswith(".urdf")

    @property
    def model_name(self):
        """Name of the model file in a recording's folder."""
        return "robot.urdf" if self.is_urdf else "robot.xml"

    def source(self):
        """Path of the packaged file.

        Raises:
            MissingModelError: if the package is not installed or lacks the file.
        """
        if self.package == "example-robot-data":
            folder = Path(sysconfig.get_paths()["purelib"])
            folder = folder / "cmeel.prefix/share/example-robot-data/robots"
        else:
            spec = importlib.util.find_spec(self.package)
            if spec is None:
                raise MissingModelError(f"{self.name}: the package {self.package} is not installed")
            folder = Path(spec.origin).parent
        if not (folder / self.path).is_file():
            raise MissingModelError(f"{self.name}: {self.package} has no file {self.path}")
        return folder / self.path

    @cached_property
    def text(self):
        """Text of the model file in the recording (without the servos of a URDF)."""
        text = self.source().read_text()
        if self.is_urdf:
            return plain(text, self.locked)
        tree = ElementTree.fromstring(text)
        self._edit_mjcf(tree)
        ElementTree.indent(tree)
        return ElementTree.tostring(tree, encoding="unicode") + "\n"

    def _edit_mjcf(self, tree):
        for body in tree.iter("body"):
            for joint in body.findall("joint"):
                if joint.get("name") in self.locked:
                    body.remove(joint)
        if self.height is not None:
            body = tree.find("worldbody/body")
            x, y, _ = body.get("pos", "0 0 0").split()
            body.set("pos", f"{x} {y} {self.height}")
        if self.engine is not None:
            option = tree.find("option")
            option.set("timestep", f"{self.engine[0]}")
            option.set("integrator", self.engine[1])
        if self.drive == "servo":  # Replace the motors of the file; forcerange is added later.
            joints = [motor.get("joint") for motor in tree.find("actuator")]
            tree.remove(tree.find("actuator"))
            actuator = ElementTree.SubElement(tree, "actuator")
            for joint in joints:
                ElementTree.SubElement(
                    actuator,
                    "position",
                    {
                        "name": f"s_{joint}",
                        "joint": joint,
                        "kp": f"{self.gains[0]:g}",
                        "kv": f"{self.gains[1]:g}",
                    },
                )
        else:
            for motor in tree.find("actuator"):
                if motor.get("name") is None:
                    motor.set("name", f"m_{motor.get('joint')}")

    def model_text(self, force_limits):
        """Return the text of the recording's model file with the servos' force limits.

        Args:
            force_limits: by joint, N m or N; those of a URDF are in the description instead.
        """
        if self.is_urdf or self.drive == "motor":
            return self.text
        tree = ElementTree.fromstring(self.text)
        for servo in tree.find("actuator"):
            if servo.get("joint") in force_limits:
                limit = force_limits[servo.get("joint")]
                servo.set("forcelimited", "true")
                servo.set("forcerange", f"{-limit:g} {limit:g}")
        ElementTree.indent(tree)
        return ElementTree.tostring(tree, encoding="unicode") + "\n"

    def compile(self, force_limits=None):
        """Compile the model with plain MuJoCo, including actuators of the description."""
        import mujoco

        if not self.is_urdf:
            return mujoco.MjModel.from_xml_string(self.model_text(force_limits or {}))
        drives = [self.drive_of(joint, force_limits or {}) for joint in self._driven_joints()]
        return compile_urdf(self.text, drives, *self.engine)

    def _driven_joints(self):
        """Return the names of the driven joints of a URDF."""
        joints = ElementTree.fromstring(self.text).findall("joint")
        names = [joint.get("name") for joint in joints if joint.get("type") != "fixed"]
        return [name for name in names if not self.driven or name in self.driven]

    def drive_of(self, joint, force_limits):
        """Return the actuator of a joint, with its force limit by joint, N m or N."""
        kind, gains = ("motor", (0.0, 0.0)) if self.drive == "motor" else ("position", self.gains)
        return Drive(joint, kind, *gains, force_limits.get(joint, np.inf), f"s_{joint}")

    def about(self, model):
        """Return the positions (nq,) around which the robot moves."""
        pose = np.array(model.qpos0)
        for name, value in self.pose.items():
            pose[model.joint(name).qposadr[0]] = value
        return pose


def _gymnasium(name):
    return {"package": "gymnasium", "path": f"envs/mujoco/assets/{name}.xml"}


def _example(path):
    return {"package": "example-robot-data", "path": path}


FINE = (0.002, "implicitfast")

ROBOTS = {
    robot.name: robot
    for robot in (
        Robot("reacher", **_gymnasium("reacher"), drive="motor", pose={"joint1": 0.8}),
        Robot(
            "double-pendulum-cart", **_gymnasium("inverted_double_pendulum"), drive="motor",
            pose={"hinge": np.pi}, swing=0.15,
        ),
        Robot(
            "pusher", **_gymnasium("pusher_v5"), drive="motor",
            pose={
                "r_shoulder_lift_joint": 0.3, "r_elbow_flex_joint": -1.2,
                "r_wrist_flex_joint": -0.5,
            },
        ),
        Robot(
            "half-cheetah-on-a-stand", **_gymnasium("half_cheetah"), drive="motor", pose={},
            swing=0.2, locked=("rootx", "rootz", "rooty"), height=2.0,
        ),
        Robot(
            "walker-servo", **_gymnasium("walker2d_v5"), drive="servo",
            pose={
                "thigh_joint": -0.6, "leg_joint": -0.9, "foot_joint": 0.0,
                "thigh_left_joint": -0.9, "leg_left_joint": -0.7, "foot_left_joint": 0.1,
            },
            locked=("rootx", "rootz", "rooty"), height=2.5, engine=FINE,
        ),
        Robot(
            "pusher-servo", **_gymnasium("pusher_v5"), drive="servo",
            pose={
                "r_shoulder_lift_joint": 0.3, "r_elbow_flex_joint": -1.2,
                "r_wrist_flex_joint": -0.5,
            },
            engine=FINE,
        ),
        Robot(
            "ur5", **_example("ur_description/urdf/ur5_robot.urdf"), drive="servo",
            pose={
                "shoulder_lift_joint": -1.2, "elbow_joint": 1.4, "wrist_1_joint": -0.8,
                "wrist_2_joint": -1.2, "wrist_3_joint": 0.3,
            },
            engine=FINE,
        ),
        Robot(
            "panda", **_example("panda_description/urdf/panda.urdf"), drive="servo",
            pose={
                "panda_joint2": -0.4, "panda_joint4": -1.9, "panda_joint6": 1.6,
                "panda_joint7": 0.5,
            },
            gains=(600.0, 30.0), locked=("panda_finger_joint1", "panda_finger_joint2"),
            engine=FINE,
        ),
        Robot(
            "iiwa", package="pybullet_data", path="kuka_iiwa/model.urdf", drive="servo",
            pose={"lbr_iiwa_joint_2": 0.5, "lbr_iiwa_joint_4": -1.2, "lbr_iiwa_joint_6": 0.8},
            engine=FINE,
        ),
        Robot(
            "z1", **_example("z1_description/urdf/z1.urdf"), drive="servo",
            pose={"joint2": 1.2, "joint3": -1.2, "joint4": 0.2}, locked=("jointGripper",),
            gains=(300.0, 15.0), engine=FINE,
        ),
        Robot(
            "talos-left-arm", **_example("talos_data/robots/talos_left_arm.urdf"), drive="servo",
            pose={"arm_left_2_joint": 0.6, "arm_left_4_joint": -1.2},
            gains=(150.0, 8.0), locked=("gripper_left_joint",), engine=FINE,
        ),
        Robot(
            "double-pendulum",
            **_example("double_pendulum_description/urdf/double_pendulum.urdf"), drive="motor",
            pose={"joint1": np.pi}, swing=0.5, engine=FINE,
        ),
    )
}  # fmt: skip
