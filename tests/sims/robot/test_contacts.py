"""Tests of detecting models that can have contacts; the reference is MuJoCo with overlapping
shapes.
"""

import mujoco
import numpy as np
import pytest

from bench.core.plugin_registries import make_robot_simulator
from sims.core.simulator import Scenario
from sims.robot.dynamics.mujoco_batch import get_batch_cache
from sims.robot.parsing.collision_filters import can_collide

MODEL = """<mujoco>{option}<worldbody>{floor}
  <body name="a"><joint type="slide"/><geom name="a" size="0.1"{mask}/>
    <body name="b"><joint type="slide"/><geom name="b" size="0.1"{mask}/>
      <body name="c">{joint}<geom name="c" size="0.1"{mask}/></body>
    </body>
  </body></worldbody>{contact}</mujoco>"""
JOINT = '<joint type="slide"/>'
FREE = {"option": "", "floor": "", "mask": "", "joint": JOINT, "contact": ""}
EXCLUDED = '<contact><exclude body1="c" body2="a"/></contact>'
CASES = {
    "two links that do not carry each other": ({}, True),
    "what is only seen": ({"mask": ' contype="0" conaffinity="0"'}, False),
    "masks that do not meet": ({"mask": ' contype="1" conaffinity="2"'}, False),
    "what is excluded": ({"contact": EXCLUDED}, False),
    "a floor": ({"contact": EXCLUDED, "floor": '<geom size="1 1 1" type="plane"/>'}, True),
    "a fixed link is part of what carries it": ({"joint": ""}, False),
    "a pair that is asked for": (
        {"contact": '<contact><exclude body1="c" body2="a"/><pair geom1="a" geom2="b"/></contact>'},
        True,
    ),
    "carriers are not filtered": (
        {"contact": EXCLUDED, "option": '<option><flag filterparent="disable"/></option>'},
        True,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_model_can_have_contacts_where_mujoco_finds_some(case):
    changes, wanted = CASES[case]
    model = mujoco.MjModel.from_xml_string(MODEL.format(**FREE | changes))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)  # all shapes overlap
    assert bool(data.ncon) == wanted
    assert can_collide(model) == wanted


ARM = """<mujoco><worldbody>{floor}<body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
  </body></worldbody><actuator><motor name="m" joint="shoulder"/></actuator></mujoco>"""


def test_only_contacts_that_cannot_be_are_not_looked_for(tmp_path):
    times = np.arange(60) / 100.0
    scenario = Scenario(times, {"q.shoulder": 0.3}, {"u.m": np.sin(9.0 * times)})
    floor = '<geom type="plane" size="1 1 1" pos="0 0 {}"/>'
    found = {}
    for name, shape in (("none", ""), ("far", floor.format(-9)), ("near", floor.format(-0.15))):
        path = tmp_path / f"{name}.xml"
        path.write_text(ARM.format(floor=shape))
        simulator = make_robot_simulator(path)(observe=["q.shoulder"])
        found[name] = simulator.simulate(np.zeros((1, len(simulator.parameters))), scenario)
        (mujoco_batch,) = get_batch_cache(simulator.robot).batches
        off = bool(mujoco_batch.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT)
        assert off == (name == "none")
    np.testing.assert_array_equal(found["none"], found["far"])
    assert np.abs(found["near"] - found["far"]).max() > 0.1


PILE = """<mujoco>{size}<worldbody><geom type="plane" size="3 3 0.1"/>
  <body pos="0 0 0.021"><joint name="x" type="slide" axis="0 0 1"/>{boxes}</body>
</worldbody><actuator><motor name="m" joint="x"/></actuator></mujoco>"""


@pytest.mark.parametrize("memory", [6, 20, 30])
def test_an_element_whose_contacts_do_not_fit_in_its_arena_has_failed(tmp_path, memory):
    boxes = "".join(
        f'<geom type="box" size="0.05 0.05 0.02" pos="{0.12 * k} 0 0"/>' for k in range(12)
    )
    times = np.arange(30) / 100.0
    found = {}
    for size in ("", f'<size memory="{memory}K"/>'):
        path = tmp_path / f"pile{len(size)}.xml"
        path.write_text(PILE.format(size=size, boxes=boxes))
        simulator = make_robot_simulator(path)(observe=["q.x"])
        found[size] = simulator.simulate(
            np.zeros((1, len(simulator.parameters))), Scenario(times, {}, {})
        )
    enough, little = found.values()
    assert np.isfinite(enough).all()
    assert np.isnan(little).all()
