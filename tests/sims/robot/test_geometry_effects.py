"""Tests of geometry errors and payloads: their physics, and the model files that state them."""

import mujoco
import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.robot.export.write_model_file import write_model_files
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import robot, write_and_check
from tests.sims.robot.sample_urdfs import joint, link
from tests.sims.robot.sample_urdfs import robot as urdf
from tests.sims.robot.test_model_changes import number, one

PENDULUM = """
<mujoco>
  <option timestep="0.001" integrator="RK4"/>
  <worldbody>
    <body name="rod" gravcomp="{gravcomp}">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0 0.2 -0.5" mass="0.8" diaginertia="0.02 0.02 0.001"/>
    </body>
  </worldbody>
</mujoco>
"""
MASS, LENGTH, INERTIA = 0.8, 0.5, 0.02 + 0.8 * 0.5**2


def pendulum(folder, gravcomp=0.0):
    path = folder / "pendulum.xml"
    path.write_text(PENDULUM.format(gravcomp=gravcomp))
    return make_robot_simulator(read_robot(path))


def accelerations(kind, effect, *c):
    """Return the accelerations at rest at some angles, from the positions after 20 ms."""
    times = np.array([0.0, 0.02])
    simulator = kind(observe=["q.hinge"], effects=[effect])
    found = []
    for angle in (-1.0, 0.2, 0.9):
        seen = simulator.simulate(np.array([c]), Scenario(times, {"q.hinge": angle}, {}))
        found.append(2.0 * (seen[0, 1, 0] - angle) / times[1] ** 2)
    return np.array(found)


ANGLES = np.array([-1.0, 0.2, 0.9])
WEIGHT = MASS * 9.81 * LENGTH


def test_a_file_with_too_much_compensation_is_corrected(tmp_path):
    """A coefficient of -1 removes the compensation of the file."""
    kind = pendulum(tmp_path, gravcomp=1.0)
    (c,) = kind.system.effect("gravity.compensation@rod").coefficients
    assert (c.least, c.plausible[0][0]) == (-1.0, -1.0)
    found = accelerations(kind, "gravity.compensation@rod", -1.0)
    np.testing.assert_allclose(found, -WEIGHT * np.sin(ANGLES) / INERTIA, rtol=2e-3)


def test_only_geometry_that_shows_in_the_motion_is_a_candidate(tmp_path):
    """Tilts out of a plane and the position of the whole robot do not show."""
    system = make_robot_simulator(robot(tmp_path)).system
    names = {name for kind in ("joint.axis", "link.length") for name in _names(system, kind)}
    # The wheel turns about an axis of its own, so all links move in one plane except for it.
    assert names == {"joint.axis@shoulder", "joint.axis@elbow", "joint.axis@spin"} | {
        f"link.length@{place}" for place in ("fore", "wheel", "*")
    }
    axis = system.effect("joint.axis@elbow")
    assert [c.name for c in axis.coefficients] == ["x", "z"]


def _names(system, kind):
    from sims import effects

    return [effect.name for effect in system.placed(effects.get_effect(kind))]


CAUSES = {
    "joint.zero@elbow": one(0.1),
    "joint.axis@spin": {"x": number(0.1, "rad"), "z": number(-0.05, "rad")},
    "link.length@wheel": one(0.2),
    "payload@fore": {"mass": number(0.3, "kg"), "x": number(0.1, "m"), "z": number(0.02, "m")},
    "mass.scale@fore": one(0.5),
    "gravity.compensation@upper": one(0.8),
}


def test_an_mjcf_states_geometry(tmp_path):
    """Angles are in the unit of the file, and a payload is not scaled with its body."""
    arm = robot(tmp_path)
    done = write_and_check(arm, CAUSES)
    assert not done.notes
    assert 'ref="5.72957' in done.xml
    assert '<body name="wheel" pos="0.36 0 0"' in done.xml
    assert 'gravcomp="0.8"' in done.xml
    model = mujoco.MjModel.from_xml_string(done.xml)
    assert model.body("fore").mass == pytest.approx(0.8 * 1.5 + 0.3)


def test_an_element_in_a_frame_is_said(tmp_path):
    """The frame would change the written attribute."""
    from tests.sims.robot.sample_arms import ARM

    body = ARM[ARM.index('<body name="wheel"') : ARM.index("</body>") + len("</body>")]
    arm = robot(tmp_path, ARM.replace(body, f'<frame euler="0 0 30">{body}</frame>'))
    done = write_model_files(arm, {"link.length@wheel": one(0.2)})
    assert any("link.length@wheel" in note and "<frame>" in note for note in done.notes)


def test_a_urdf_states_geometry(tmp_path):
    """A URDF has no reference position, so the frame of the joint turns instead."""
    origin = '<origin xyz="0.3 0.1 0" rpy="0.1 0.2 0.3"/><limit lower="-1" upper="1"/>'
    fixed = '<joint name="w" type="fixed"><parent link="b"/><child link="c"/>'
    fixed += '<origin xyz="0 0.2 0.1" rpy="0 0.4 0"/></joint>'
    path = tmp_path / "arm.urdf"
    path.write_text(
        urdf(
            *(link(name) for name in ("base", "a", "b", "c", "d", "e")),
            joint("i", "base", "a", inside=origin),
            joint("j", "a", "b", inside=origin),
            fixed,
            joint("k", "c", "d", inside=origin),
            joint("l", "d", "e", kind="prismatic", inside=origin),
        )
    )
    arm = read_robot(path)
    causes = {
        "joint.zero@j": one(0.2),
        "joint.zero@l": one(0.05),
        "joint.axis@j": {"y": number(0.1, "rad"), "z": number(0.3, "rad")},
        "link.length@d": one(0.2),
        "payload@b": {"mass": number(0.4, "kg"), "y": number(0.3, "m")},
        "gravity.compensation@d": one(0.5),
    }
    done = write_and_check(arm, causes, "")
    assert [note for note in done.notes if "not in the URDF" in note] == [
        "gravity.compensation@d: 0.5 (95 %: 0.45 to 0.55): not in the URDF: a URDF cannot state it"
    ]


def test_causes_that_add_the_same_element_to_a_urdf_combine(tmp_path):
    """The file states neither the origin of the inertial, nor the origin and axis of the joint."""
    path = tmp_path / "arm.urdf"
    text = urdf(link("base"), link("a"), joint("i", "base", "a"))
    path.write_text(text.replace('<axis xyz="1 0 0"/>', ""))
    arm = read_robot(path)
    causes = {
        "joint.axis@i": {"y": number(0.1, "rad"), "z": number(0.3, "rad")},
        "joint.zero@i": one(0.2),
        "mass.offset@a": {"y": number(0.1, "m")},
        "payload@a": {"mass": number(0.4, "kg"), "y": number(0.3, "m")},
    }
    write_and_check(arm, causes)


def test_small_masses_at_points_add_up_to_a_payload(tmp_path):
    """Their mass and first moment are those of the payload (Steiner, for the moment of inertia)."""
    payload = make_robot_simulator(robot(tmp_path)).system.effect("payload@fore")()
    points = np.array(payload.probe_points())
    # The arm moves in one plane until the wheel, so that y does not show in the forearm.
    assert points.shape == (3, 4)
    assert (points[:, 0] == points[0, 0]).all()
    assert not points[:, 2].any()
    wanted = np.array([0.4, 0.12, 0.0, -0.03])
    moments = np.concatenate([points[:, :1], points[:, :1] * points[:, [1, 3]]], axis=1)
    weights = np.linalg.solve(moments.T, wanted[0] * np.array([1.0, wanted[1], wanted[3]]))
    np.testing.assert_allclose(payload.combine(points, weights), wanted, rtol=0, atol=1e-12)
    assert not payload.combine(points, -weights)[0], "a negative mass is not a payload"
