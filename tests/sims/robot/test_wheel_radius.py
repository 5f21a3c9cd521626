"""Tests of the radius of wheels and feet, against rolling without slip and other model files."""

import mujoco
import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.robot.export.write_model_file import write_model_files
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import write_and_check
from tests.sims.robot.test_model_changes import one

ROLLER = """
<mujoco model="roller">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" friction="2" solref="0.004 1" priority="1"/>
    <body name="wheel" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="spin" axis="0 1 0" damping="0.01"/>
      <geom name="rim" {shape} mass="2"/>
    </body>
  </worldbody>
  <actuator><velocity name="drive" joint="spin" kv="2"/></actuator>
</mujoco>
"""
SHAPES = {
    "sphere": ('type="sphere" size="{}"', 0.1),
    "cylinder": ('type="cylinder" size="{} 0.02" euler="90 0 0"', 0.1),
    "capsule": ('type="capsule" size="{}" fromto="0 -0.05 0 0 0.05 0"', 0.1),
}
TIMES = np.arange(101) / 100.0
SCENARIO = Scenario(TIMES, {"q.z": 0.02}, {"u.drive": np.full(101, 3.0)})
CHANNELS = ["q.x", "q.z", "q.spin"]


def roller(folder, shape):
    path = folder / f"roller{len(list(folder.iterdir()))}.xml"
    path.write_text(ROLLER.format(shape=shape))
    return make_robot_simulator(read_robot(path))


def motion(kind, *c):
    effects = ["geom.radius@rim"] if c else []
    return kind(observe=CHANNELS, effects=effects).simulate(np.array([c]), SCENARIO)[0]


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("c", [-0.2, 0.15])
def test_a_wheel_rolls_by_its_radius_times_its_angle(name, c, tmp_path):
    """Without slip, v = r omega; at rest, the axle is as high as the radius."""
    shape, radius = SHAPES[name]
    moved = motion(roller(tmp_path, shape.format(radius)), c)
    x, z, spin = (moved[-1] - moved[50]).tolist()
    assert x / spin == pytest.approx(radius * (1 + c), rel=2e-3)
    assert z == pytest.approx(0.0, abs=1e-6)
    # The file's body is at 0.1 m, and a hard contact gives way by less than 0.2 mm.
    assert moved[-1, 1] + 0.1 == pytest.approx(radius * (1 + c), abs=2e-4)


def test_nothing_else_changes(tmp_path):
    """Mass and inertia of the body are those of the file, in the simulation and in the file."""
    kind = roller(tmp_path, SHAPES["cylinder"][0].format(0.1))
    done = write_and_check(kind.robot, {"geom.radius@rim": one(0.25)}, "a log")
    model, file_model = mujoco.MjModel.from_xml_string(done.xml), kind.robot.compiled
    np.testing.assert_allclose(model.geom("rim").size, (0.125, 0.02, 0.0), atol=1e-15)
    np.testing.assert_allclose(model.body_inertia, file_model.body_inertia, rtol=1e-12)
    np.testing.assert_allclose(model.body_mass, file_model.body_mass, rtol=1e-12)
    assert "geom.radius@rim: 0.25" in done.xml
    (tmp_path / "extended.xml").write_text(done.xml)
    written = make_robot_simulator(read_robot(tmp_path / "extended.xml"))
    np.testing.assert_allclose(motion(kind, 0.25), motion(written), atol=1e-9)


def test_the_half_axes_of_an_ellipsoid_grow_together(tmp_path):
    kind = roller(tmp_path, 'type="ellipsoid" size="0.1 0.05 0.08"')
    done = write_model_files(kind.robot, {"geom.radius@rim": one(0.1)})
    model = mujoco.MjModel.from_xml_string(done.xml)
    np.testing.assert_allclose(model.geom("rim").size, (0.11, 0.055, 0.088), rtol=1e-12)


def test_a_larger_wheel_still_collides_where_many_geoms_do(tmp_path):
    """The volumes that bound geoms grow with the wheel: without them, contacts are missed."""
    many = '<geom type="sphere" size="0.005" pos="0 0 {}" mass="0.001"/>'
    text = ROLLER.format(shape=SHAPES["cylinder"][0].format(0.1))
    text = text.replace("</body>", "".join(many.format(k / 100) for k in range(8)) + "</body>")
    text = text.replace(
        "</worldbody>",
        '<body><geom type="box" size="2 2 0.1" pos="0 0 -0.1"/>'
        + "".join(f'<geom size="0.01" pos="3 {k} 0"/>' for k in range(8))
        + "</body></worldbody>",
    ).replace('type="plane" size="5 5 1"', 'type="plane" size="5 5 1" pos="0 0 -1"')
    (tmp_path / "many.xml").write_text(text)
    moved = motion(make_robot_simulator(read_robot(tmp_path / "many.xml")), 0.5)
    assert moved[-1, 1] + 0.1 == pytest.approx(0.15, abs=2e-3)


def test_only_round_geoms_have_a_radius(tmp_path):
    """Candidates are round geoms of moving bodies that touch; others may be named."""
    from sims.effects import get_effect

    effect = get_effect("geom.radius")
    kind = roller(tmp_path, SHAPES["sphere"][0].format(0.1))
    assert not kind.system.placed(effect)
    placed = kind.with_contacts(("floor/rim",)).system.placed(effect)
    assert [one_place.name for one_place in placed] == ["geom.radius@rim"]
    with pytest.raises(InputError, match="geom floor has no radius"):
        kind.system.effect("geom.radius@floor")
    with pytest.raises(InputError, match="rimm"):
        kind.system.effect("geom.radius@rimm")
