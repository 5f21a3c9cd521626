import mujoco

from sims.robot.places.place_list import coupled_joints

FOURBAR = """
<mujoco><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0"/>
<geom size=".02" fromto="0 0 0 0 0 .2" type="capsule"/>
<body name="coupler" pos="0 0 .2"><joint name="knee" axis="0 1 0"/>
<geom size=".02" fromto="0 0 0 .4 0 0" type="capsule"/></body></body>
<body name="rocker" pos=".4 0 0"><joint name="rocker" axis="0 1 0"/>
<geom size=".02" fromto="0 0 0 0 0 .2" type="capsule"/></body>
<body name="free" pos="1 0 0"><joint name="alone" axis="0 1 0"/><geom size=".02"/>
<body name="arm" pos=".1 0 0"><joint name="first" axis="0 1 0"/><geom size=".02"/>
<body name="tip" pos=".1 0 0"><joint name="second" axis="0 1 0"/><geom size=".02"/></body></body>
</body></worldbody><equality>{equality}</equality></mujoco>
"""
LOOP = '<connect body1="coupler" body2="rocker" anchor=".4 0 0"/>'
JOINTS = '<joint joint1="first" joint2="second"/>'
NAMES = ("crank", "knee", "rocker", "alone", "first", "second")


def groups_of(equality):
    model = mujoco.MjModel.from_xml_string(FOURBAR.format(equality=equality))
    dofs = [model.joint(name).dofadr[0] for name in NAMES]
    return sorted(sorted(NAMES[k] for k in group) for group in coupled_joints(model, dofs))


def test_the_joints_of_a_loop_and_of_an_equality_are_coupled():
    assert groups_of("") == []
    assert groups_of(LOOP) == [["crank", "knee", "rocker"]]
    assert groups_of(LOOP + JOINTS) == [["crank", "knee", "rocker"], ["first", "second"]]


def test_only_the_joints_below_a_common_ancestor_are_in_a_loop():
    equality = '<weld body1="free" body2="tip"/>'
    assert groups_of(equality) == [["first", "second"]]


def test_groups_that_share_a_joint_are_one():
    equality = '<joint joint1="rocker" joint2="first"/>' + LOOP + JOINTS
    assert groups_of(equality) == [["crank", "first", "knee", "rocker", "second"]]
