"""Model files of the kinds that people have, and how they are driven.

Hands, grippers with loops and tendons, quadrupeds, a humanoid, a biped with rods, a quadrotor, a
differential drive and arms with servos of several kinds. The files are written in the style of
public ones; that of the humanoid comes from gymnasium.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from xml.etree import ElementTree

import mujoco

from tests.exams.planted.planted_robots import ROBOTS, Robot

SERVO_NUMBERS = ("damping", "frictionloss", "armature", "mass", "kp", "com", "zero", "payload")
LOOP_NUMBERS = ("damping", "frictionloss", "armature", "mass", "kp")
MOTOR_NUMBERS = ("damping", "frictionloss", "armature", "mass", "gear", "com", "zero", "payload")
GROUND_NUMBERS = ("damping", "frictionloss", "mass", "payload", "friction")
FLIGHT_NUMBERS = ("mass", "gear", "com", "payload")


@dataclass(frozen=True)
class ModelFile:
    """A model file and how it is driven.

    Attributes:
        name: name of the model in the exam.
        stated_text: text of the file; None for gymnasium's humanoid.
        numbers: kinds of numbers that may be wrong.
        swing: amplitude of the commands, in the unit of the input; for motors rad or m. One for all
            actuators or one for each.
        drive: "servo" (the commands are set points), "motor" (a position loop computes torques) or
            "rotors" (a flight controller computes thrusts).
        pose: positions around which the joints move, by joint; the default is that of the file.
        centre: commands around which the actuators move, by actuator; the default is the pose.
        unmeasured: joints without a channel.
        base: "" (none), "fixed" (the option fix_base removes the free joint) or "recorded".
        files: text of further files, by path.
        noise: standard deviation of positions, rad or m.
        is_touching: whether the robot touches the ground.
    """

    name: str
    stated_text: str | None
    numbers: tuple[str, ...]
    swing: float | tuple[float, ...] = 0.4
    drive: str = "servo"
    pose: dict[str, float] = field(default_factory=dict)
    centre: dict[str, float] = field(default_factory=dict)
    unmeasured: tuple[str, ...] = ()
    base: str = ""
    files: dict[str, str] = field(default_factory=dict)
    noise: float = 1e-3
    is_touching: bool = False
    is_urdf = False

    @cached_property
    def text(self):
        """Text of the file.

        Raises:
            MissingModelError: if the package of the file is not installed.
        """
        return _humanoid() if self.stated_text is None else self.stated_text

    @cached_property
    def simulated_text(self):
        """Text of the simulated robot: without meshes, and without free joints on a stand."""
        tree = ElementTree.fromstring(self.text)
        for parent in list(tree.iter()):
            for child in list(parent):
                is_mesh = child.tag in ("mesh", "geom") and child.get("mesh", child.get("file"))
                is_free = child.tag == "freejoint" or child.get("type") == "free"
                if is_mesh or (is_free and self.base == "fixed") or child.tag == "keyframe":
                    parent.remove(child)
        return ElementTree.tostring(tree, encoding="unicode")

    def compile(self, force_limits=None):
        """Compile the simulated robot with plain MuJoCo, so that weights can be carried later."""
        files = {name: text.encode() for name, text in self.files.items()}
        spec = mujoco.MjSpec.from_string(self.simulated_text, files)
        # MuJoCo decides here whether any weight is carried. This share changes no force.
        spec.bodies[-1].gravcomp = spec.bodies[-1].gravcomp or 1e-200
        return spec.compile()

    @cached_property
    def gains(self):
        """Largest kp and kv of the actuators, zero for motors."""
        bias = self.compile().actuator_biasprm
        return float(-bias[:, 1].min()), float(-bias[:, 2].min())

    def about(self, model):
        """Return the positions (nq,) around which the robot moves."""
        return Robot.about(self, model)


def _capsule(end, mass, size=0.02):
    return (
        f'<geom type="capsule" fromto="0 0 0 {end}" size="{size}" mass="{mass}" '
        'contype="0" conaffinity="0"/>'
    )


def _finger(name, place, axis="0 1 0"):
    return f"""
<body name="{name}_proximal" pos="{place}"><joint name="{name}_1" axis="{axis}"/>
  {_capsule("0 0 .045", 0.03, 0.008)}
  <body name="{name}_middle" pos="0 0 .045">
    <joint name="{name}_2" axis="{axis}" stiffness=".06"/>{_capsule("0 0 .03", 0.02, 0.007)}
    <body name="{name}_distal" pos="0 0 .03">
      <joint name="{name}_3" axis="{axis}" stiffness=".04"/>{_capsule("0 0 .02", 0.012, 0.007)}
    </body>
  </body>
</body>"""


_FINGERS = {"index": "-.03 0 .09", "ring": "0 0 .09", "little": ".03 0 .08", "thumb": "-.05 0 .03"}
HAND = f"""<mujoco model="hand">
<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><joint damping=".006" armature=".0002" range="-.3 1.6"/>
<position kp=".8" kv=".01" forcerange="-1 1"/></default>
<worldbody><body name="palm" pos="0 0 .3" euler="1.57 0 0">{_capsule("0 0 .08", 0.3, 0.03)}
{"".join(_finger(n, p, "1 0 .3" if n == "thumb" else "1 0 0") for n, p in _FINGERS.items())}
</body></worldbody>
<tendon>{
    "".join(
        f'''<fixed name="{n}_curl"><joint joint="{n}_2" coef="1"/>
<joint joint="{n}_3" coef="1"/></fixed>'''
        for n in _FINGERS
    )
}</tendon>
<actuator>{
    "".join(
        f'''<position name="a_{n}" joint="{n}_1"/>
<position name="a_{n}_curl" tendon="{n}_curl"/>'''
        for n in _FINGERS
    )
}</actuator>
</mujoco>
"""


def _gripper_side(side, sign):
    return f"""
<body name="{side}_driver" pos="{0.03 * sign} 0 .04">
  <joint name="{side}_driver" axis="0 {sign} 0" range="-.8 .8"/>{_capsule("0 0 .05", 0.05, 0.006)}
  <body name="{side}_follower" pos="0 0 .05"><joint name="{side}_follower" axis="0 {sign} 0"/>
    {_capsule("0 0 .04", 0.04, 0.006)}
  </body>
</body>
<body name="{side}_spring" pos="{0.015 * sign} 0 .04"><joint name="{side}_spring" axis="0 {sign} 0"
  stiffness=".05"/>{_capsule("0 0 .05", 0.03, 0.005)}</body>"""


GRIPPER = f"""<mujoco model="arm with gripper">
<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><joint damping=".02" armature=".001"/></default>
<worldbody><body name="upper" pos="0 0 .6">
  <joint name="shoulder" axis="0 1 0" damping=".3" armature=".02"/>{_capsule(".3 0 0", 1.2)}
  <body name="fore" pos=".3 0 0">
    <joint name="elbow" axis="0 1 0" damping=".2" armature=".02"/>{_capsule(".25 0 0", 0.8)}
    <body name="wrist" pos=".25 0 0" euler="0 1.57 0">
      <joint name="roll" axis="0 0 1" damping=".05" armature=".005"/>{_capsule("0 0 .04", 0.3)}
      {_gripper_side("right", 1)}{_gripper_side("left", -1)}
    </body>
  </body>
</body></worldbody>
<tendon><fixed name="split"><joint joint="right_driver" coef=".5"/>
<joint joint="left_driver" coef=".5"/></fixed></tendon>
<equality>
<connect body1="right_follower" body2="right_spring" anchor="-.015 0 0" solref="0.005 1"/>
<connect body1="left_follower" body2="left_spring" anchor=".015 0 0" solref="0.005 1"/>
<joint joint1="right_driver" joint2="left_driver" polycoef="0 1 0 0 0" solref="0.005 1"/>
</equality>
<actuator><position name="m_shoulder" joint="shoulder" kp="120" kv="8"/>
<position name="m_elbow" joint="elbow" kp="80" kv="5"/>
<position name="m_roll" joint="roll" kp="15" kv=".5"/>
<position name="fingers_actuator" tendon="split" kp="4" kv=".1" forcerange="-5 5"/></actuator>
</mujoco>
"""


def _leg(name, x, y):
    side = 1 if y > 0 else -1
    return f"""
<body name="{name}_hip" pos="{x} {y} 0"><joint name="{name}_hip_joint" axis="1 0 0"/>
  {_capsule(f"0 {0.08 * side} 0", 0.5, 0.03)}
  <body name="{name}_thigh" pos="0 {0.08 * side} 0"><joint name="{name}_thigh_joint" axis="0 1 0"/>
    {_capsule("0 0 -.21", 0.9)}
    <body name="{name}_calf" pos="0 0 -.21"><joint name="{name}_calf_joint" axis="0 1 0"/>
      {_capsule("0 0 -.21", 0.2, 0.012)}
      <geom name="{name}_foot" class="foot" pos="0 0 -.21"/>
    </body>
  </body>
</body>"""


_LEGS = {"FL": (0.19, 0.05), "FR": (0.19, -0.05), "RL": (-0.19, 0.05), "RR": (-0.19, -0.05)}
_STANCE = {"hip": 0.0, "thigh": 0.8, "calf": -1.5}
QUADRUPED = f"""<mujoco model="quadruped">
<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
<default><joint damping=".3" armature=".01"/><position kp="60" kv="2" forcerange="-40 40"/>
<default class="foot"><geom type="sphere" size=".022" mass=".06" friction=".8 .02 .01"
  priority="1" condim="3"/></default></default>
<worldbody><geom name="floor" type="plane" size="5 5 .1"/>
<body name="trunk" pos="0 0 HEIGHT"><freejoint name="base"/>
<geom name="trunk" type="box" size=".25 .09 .05" mass="6" contype="0" conaffinity="0"/>
{"".join(_leg(name, *place) for name, place in _LEGS.items())}
</body></worldbody>
<actuator>{
    "".join(
        f'<position name="{leg}_{part}" joint="{leg}_{part}_joint"/>'
        for leg in _LEGS
        for part in _STANCE
    )
}</actuator>
<keyframe><key name="home" qpos="0 0 HEIGHT 1 0 0 0 {"0 .8 -1.5 " * 4}"
  ctrl="{"0 .8 -1.5 " * 4}"/></keyframe>
</mujoco>
"""
_STANCE_POSE = {f"{leg}_{part}_joint": q for leg in _LEGS for part, q in _STANCE.items()}


def _rod_leg(side, y):
    return f"""
<body name="{side}_thigh" pos="0 {y} 1"><joint name="{side}_hip" axis="0 1 0"/>
  {_capsule("0 0 -.4", 1.5)}
  <body name="{side}_shin" pos="0 0 -.4"><joint name="{side}_knee" axis="0 1 0"/>
    {_capsule(".1 0 -.35", 0.7, 0.015)}
    <body name="{side}_foot" pos=".1 0 -.35"><joint name="{side}_ankle" axis="0 1 0"/>
      {_capsule(".12 0 0", 0.3, 0.012)}</body></body>
  <body name="{side}_crank" pos=".02 0 -.05"><joint name="{side}_crank" axis="0 1 0"/>
    {_capsule("-.06 0 0", 0.1, 0.008)}
    <body name="{side}_rod" pos="-.06 0 0">
      <joint name="{side}_rod" axis="0 1 0" damping=".002" armature="0"/>
      {_capsule("0 0 -.35", 0.15, 0.006)}</body></body>
</body>"""


BIPED = f"""<mujoco model="biped with rods">
<compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/>
<default><joint damping=".05" armature=".01"/></default>
<worldbody>{_rod_leg("left", 0.1)}{_rod_leg("right", -0.1)}</worldbody>
<equality>
<connect body1="left_rod" body2="left_shin" anchor="0 0 -.35" solref="0.004 1"/>
<connect body1="right_rod" body2="right_shin" anchor="0 0 -.35" solref="0.004 1"/>
</equality>
<actuator>{
    "".join(
        f'''<position name="{s}_m_hip" joint="{s}_hip" kp="150" kv="6"/>
<position name="{s}_m_crank" joint="{s}_crank" kp="60" kv="2"/>
<position name="{s}_m_ankle" joint="{s}_ankle" kp="20" kv=".5"/>'''
        for s in ("left", "right")
    )
}
</actuator>
</mujoco>
"""

ROTORS = {"m1": (0.1, 0.1, 1), "m2": (-0.1, 0.1, -1), "m3": (-0.1, -0.1, 1), "m4": (0.1, -0.1, -1)}
ROTOR_TORQUE = 0.018  # Torque of a rotor about its axis divided by its thrust, m.
QUADROTOR = f"""<mujoco model="quadrotor">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="hull" pos="0 0 1"><freejoint name="base"/>
<inertial pos="0.001 0 0" mass="0.5" diaginertia="0.003 0.0033 0.0055"/>
<geom type="box" size=".08 .08 .02" contype="0" conaffinity="0"/>
{"".join(f'<site name="{n}" pos="{x} {y} 0"/>' for n, (x, y, _) in ROTORS.items())}
</body></worldbody>
<actuator>{
    "".join(
        f'<motor name="{n}" site="{n}" gear="0 0 1 0 0 {s * ROTOR_TORQUE}" ctrlrange="0 4"/>'
        for n, (_, _, s) in ROTORS.items()
    )
}</actuator>
</mujoco>
"""
ROVER = f"""<mujoco model="differential drive">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><geom name="floor" type="plane" size="5 5 .1"/>
<body name="chassis" pos="0 0 .05"><freejoint name="base"/>
<geom name="chassis" type="box" size=".12 .08 .03" mass="2" contype="0" conaffinity="0"/>
<geom name="caster" type="sphere" size=".02" pos=".1 0 -.03" mass=".05" friction="0 0 0"
  condim="1"/>
{
    "".join(
        f'''<body name="{s}_wheel" pos="-.03 {y} 0"><joint name="{s}" axis="0 1 0" damping=".002"/>
<geom name="{s}_tyre" type="cylinder" size=".05 .01" euler="90 0 0" mass=".15"
  friction=".9 .005 .0001" priority="1"/></body>'''
        for s, y in (("left", 0.1), ("right", -0.1))
    )
}
</body></worldbody>
<actuator><velocity name="m_left" joint="left" kv=".05"/>
<velocity name="m_right" joint="right" kv=".05"/></actuator>
</mujoco>
"""

INHERITRANGE = f"""<mujoco model="table arm">
<compiler angle="radian" autolimits="true"/>
<option timestep="0.002" integrator="implicitfast"/>
<default><default class="servo"><joint damping=".6" frictionloss=".05" armature=".028"/>
<position kp="18" kv=".6" inheritrange="1" forcerange="-3.3 3.3"/></default></default>
<worldbody><body name="base" pos="0 0 .05" childclass="servo">
<body name="shoulder"><joint name="pan" axis="0 0 1" range="-1.9 1.9"/>{_capsule("0 0 .05", 0.1)}
<body name="upper_arm" pos="0 0 .05"><joint name="lift" axis="0 1 0" range="-1.7 1.7"/>
{_capsule("0 0 .11", 0.1)}
<body name="lower_arm" pos="0 0 .11"><joint name="flex" axis="0 1 0" range="-1.7 1.7"/>
{_capsule(".13 0 0", 0.1)}
<body name="wrist" pos=".13 0 0"><joint name="wrist_flex" axis="0 1 0" range="-1.6 1.6"/>
{_capsule(".06 0 0", 0.08)}
<body name="gripper" pos=".06 0 0"><joint name="wrist_roll" axis="1 0 0" range="-2.7 2.7"/>
{_capsule(".05 .01 0", 0.09)}</body></body></body></body></body>
</body></worldbody>
<actuator>{
    "".join(
        f'<position name="{j}" joint="{j}" class="servo"/>'
        for j in ("pan", "lift", "flex", "wrist_flex", "wrist_roll")
    )
}</actuator>
</mujoco>
"""


def _arm(prefix, joints, lengths, masses, servo, tail=""):
    """Return bodies and actuators of an arm.

    Args:
        prefix: beginning of all names.
        joints: axis by joint.
        lengths, masses: of the links, m and kg.
        servo: further attributes of each actuator.
        tail: elements in the last body.
    """
    bodies, previous = "", "0 0 .3"
    for (name, axis), length, mass in zip(joints.items(), lengths, masses, strict=True):
        bodies += (
            f'<body name="{prefix}{name}_link" pos="{previous}">'
            f'<joint name="{prefix}{name}" axis="{axis}"/>{_capsule(f"{length} 0 0", mass)}'
        )
        previous = f"{length} 0 0"
    actuators = "".join(
        f'<position name="{prefix}m_{n}" joint="{prefix}{n}" {servo}/>' for n in joints
    )
    return bodies + tail + "</body>" * len(joints), actuators


_FILTERED = _arm(
    "", {"yaw": "0 0 1", "pitch": "0 1 0", "elbow": "0 1 0", "wrist": "1 0 0"},
    (0.05, 0.3, 0.25, 0.1), (0.5, 1.2, 0.8, 0.3), 'kp="120" kv="6" timeconst="0.03"',
    '<body name="tool" pos=".1 .04 0"><geom size=".02" mass=".2"/></body>',
)  # fmt: skip
FILTERED = f"""<mujoco model="arm with filtered servos">
<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><joint damping=".4" armature=".03"/></default>
<worldbody>{_FILTERED[0]}</worldbody><actuator>{_FILTERED[1]}</actuator>
</mujoco>
"""
_ATTACHED = _arm(
    "arm/", {"shoulder": "0 1 0", "elbow": "0 1 0", "wrist": "0 0 1"},
    (0.3, 0.25, 0.15), (1.5, 0.9, 0.4), 'kp="200" kv="10" forcerange="-60 60"',
)  # fmt: skip
SLASHES = """<mujoco model="scene">
<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><joint damping=".5" armature=".02"/></default>
<worldbody><light pos="0 0 3"/><include file="parts/arm_body.xml"/></worldbody>
<include file="parts/arm_drives.xml"/>
</mujoco>
"""
SLASHES_FILES = {
    "parts/arm_body.xml": f"<mujocoinclude>{_ATTACHED[0]}</mujocoinclude>\n",
    "parts/arm_drives.xml": (
        f"<mujocoinclude><actuator>{_ATTACHED[1]}</actuator></mujocoinclude>\n"
    ),
}


def _mesh_link(name, place, axis, mass, centre, inertia):
    return f"""<body name="{name}_link" pos="{place}">
<inertial pos="{centre}" mass="{mass}" diaginertia="{inertia}"/>
<joint name="{name}" axis="{axis}"/>
<geom class="visual" mesh="{name}_visual"/><geom class="collision" mesh="{name}_collision"/>"""


_MESH_LINKS = (
    ("shoulder_pan", "0 0 .16", "0 0 1", 3.76, "0 0 0", ".0111 .0111 .0104"),
    ("shoulder_lift", "0 .138 0", "0 1 0", 8.0, "0 0 .14", ".133 .13 .0151"),
    ("elbow", "0 -.131 .395", "0 1 0", 2.85, "0 0 .12", ".0312 .0306 .0041"),
    ("wrist_1", "0 0 .392", "0 1 0", 1.0, "0 .127 0", ".0026 .0022 .0026"),
    ("wrist_2", "0 .127 0", "0 0 1", 1.0, "0 0 .1", ".0026 .0026 .0022"),
    ("wrist_3", "0 0 .1", "0 1 0", 0.8, "0 .077 .02", ".0012 .0012 .0006"),
)
ABSENT_MESHES = f"""<mujoco model="arm with meshes">
<compiler angle="radian" meshdir="assets"/>
<option timestep="0.002" integrator="implicitfast"/>
<default><joint armature=".1" damping="1"/><position kp="800" kv="80" forcerange="-150 150"/>
<default class="visual"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
<default class="collision"><geom type="mesh" group="3"/></default></default>
<asset>{
    "".join(
        f'<mesh name="{link[0]}_{k}" file="{link[0]}_{k}.stl"/>'
        for link in _MESH_LINKS
        for k in ("visual", "collision")
    )
}</asset>
<worldbody>{"".join(_mesh_link(*link) for link in _MESH_LINKS)}{"</body>" * len(_MESH_LINKS)}
</worldbody>
<actuator>{
    "".join(f'<position name="{link[0]}_servo" joint="{link[0]}"/>' for link in _MESH_LINKS)
}</actuator>
</mujoco>
"""
_ON_BASE = _arm(
    "", {"turn": "0 0 1", "lift": "0 1 0", "bend": "0 1 0"}, (0.05, 0.3, 0.25),
    (0.6, 1.4, 0.9), 'kp="150" kv="8" forcerange="-40 40"',
)  # fmt: skip
MOBILE_ARM = f"""<mujoco model="mobile arm">
<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><joint damping=".3" armature=".02"/></default>
<worldbody><body name="platform" pos="0 0 .1">
<joint name="base_x" type="slide" axis="1 0 0" damping="20"/>
<joint name="base_y" type="slide" axis="0 1 0" damping="20"/>
<joint name="base_yaw" axis="0 0 1" damping="2"/>
<geom type="box" size=".25 .2 .08" mass="15" contype="0" conaffinity="0"/>{_ON_BASE[0]}
</body></worldbody>
<actuator><velocity name="m_x" joint="base_x" kv="200"/><velocity name="m_y" joint="base_y"
kv="200"/><velocity name="m_yaw" joint="base_yaw" kv="20"/>{_ON_BASE[1]}</actuator>
</mujoco>
"""


def _humanoid():
    """Return the text of gymnasium's humanoid with a time step that divides the sample interval."""
    robot = Robot("humanoid", "gymnasium", "envs/mujoco/assets/humanoid.xml", "motor", {})
    tree = ElementTree.fromstring(robot.source().read_text())
    tree.find("option").set("timestep", "0.0025")
    return ElementTree.tostring(tree, encoding="unicode") + "\n"


MODELS = {
    model.name: model
    for model in (
        ModelFile(
            "hand", HAND, LOOP_NUMBERS, swing=(0.4, 0.6) * 4,
            pose={f"{f}_{k}": 0.4 for f in _FINGERS for k in (1, 2, 3)},
            centre={f"a_{f}_curl": 0.8 for f in _FINGERS},
        ),
        ModelFile(
            "arm-with-gripper", GRIPPER, LOOP_NUMBERS, swing=(0.3, 0.3, 0.5, 0.3),
            unmeasured=("right_follower", "right_spring", "left_follower", "left_spring",
                        "left_driver"),
        ),
        ModelFile(
            "quadruped-hanging", QUADRUPED.replace("HEIGHT", ".7"), SERVO_NUMBERS, swing=0.3,
            pose=_STANCE_POSE, base="fixed", noise=5e-4,
        ),
        ModelFile(
            "quadruped-standing", QUADRUPED.replace("HEIGHT", ".318"), GROUND_NUMBERS, swing=0.12,
            pose=_STANCE_POSE, base="recorded", noise=5e-4, is_touching=True,
        ),
        ModelFile(
            "humanoid-hanging", None, MOTOR_NUMBERS, swing=0.2, drive="motor", base="fixed",
            pose={
                "right_hip_x": -0.2, "left_hip_x": -0.2, "right_hip_y": -0.3, "left_hip_y": -0.3,
                "right_knee": -0.6, "left_knee": -0.6, "right_elbow": -0.9, "left_elbow": -0.9,
            },
        ),
        ModelFile(
            "biped-with-rods", BIPED, LOOP_NUMBERS, swing=0.3,
            unmeasured=("left_knee", "left_rod", "right_knee", "right_rod"),
        ),
        ModelFile(
            "quadrotor", QUADROTOR, FLIGHT_NUMBERS, swing=0.4, drive="rotors", base="recorded",
            noise=4e-4,
        ),
        ModelFile(
            "differential-drive", ROVER, GROUND_NUMBERS, swing=5.0,
            centre={"m_left": 3.0, "m_right": 3.0}, base="recorded", noise=4e-4, is_touching=True,
        ),
        ModelFile("arm-inheritrange", INHERITRANGE, SERVO_NUMBERS, swing=0.5),
        ModelFile("arm-filtered", FILTERED, SERVO_NUMBERS, pose={"pitch": -0.5, "elbow": 0.9}),
        ModelFile("arm-included", SLASHES, SERVO_NUMBERS, files=SLASHES_FILES),
        ModelFile(
            "arm-absent-meshes", ABSENT_MESHES, SERVO_NUMBERS,
            pose={"shoulder_lift": -0.6, "elbow": 1.0}, noise=3e-4,
        ),
        ModelFile(
            "mobile-arm", MOBILE_ARM, SERVO_NUMBERS, swing=(0.3, 0.3, 0.6, 0.4, 0.4, 0.4),
            pose={"lift": -0.6, "bend": 0.8},
        ),
    )
}  # fmt: skip
"""Models by name, in addition to `ROBOTS`."""
SYSTEMS = (*ROBOTS, *MODELS)
