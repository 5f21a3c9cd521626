"""Tests of effects written into model fields: each batch element moves as a file with the same
values.
"""

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from sims.robot import model_field_effects
from sims.robot.coupled_drives import COUPLING_PLACEHOLDER
from sims.robot.dynamics.added_elements import add_elements
from sims.robot.dynamics.mujoco_batch import make_batch_spec
from tests.sims.robot.sample_arms import ARM, robot

ELBOW = 'damping="0.1" frictionloss="0.05" stiffness="0.5"'
STIFF = 'solreffriction="0.002 1" solimpfriction="0.99 0.99 0.001 0.5 2"'
FORE = 'pos="0.15 0 0.01" mass="0.8" diaginertia="0.002 0.008 0.009"'
WHEEL = '<geom type="cylinder" size="0.05 0.01" mass="0.2"/>'
MOVED = (
    '<inertial pos="0.02 0 0.03" mass="0.2" diaginertia="0.000131666666666666 0.00013166666666666'
)
MOVED += '6 0.00025"/>' + WHEEL
DRIVES = """<actuator>
    <position name="m_shoulder" joint="shoulder" kp="60" kv="3"/>
    <motor name="m_elbow" joint="elbow" gear"""
TENDON = """<tendon><fixed name="t"><joint joint="elbow" coef="1"/><joint joint="shoulder"
    coef="-0.3"/></fixed></tendon>"""
STATED = {
    ("drag.linear", "shoulder", (0.3,)): ('damping="0.2 0.05 0"', 'damping="0.5 0.05 0"'),
    ("drag.linear", "elbow", (-0.3,)): ('damping="0.1"', 'damping="0"'),
    ("drag.quadratic", "shoulder", (0.25,)): ("0.2 0.05 0", "0.2 0.3 0"),
    ("friction.coulomb", "shoulder", (0.3,)): ("armature", f'frictionloss="0.3" {STIFF} armature'),
    ("friction.coulomb", "elbow", (0.3,)): (
        'frictionloss="0.05"',
        f'frictionloss="0.35" {STIFF}',
    ),
    ("spring.linear", "elbow", (0.5,)): ('stiffness="0.5"', 'stiffness="1"'),
    ("spring.cubic", "elbow", (-0.4,)): ('stiffness="0.5"', 'stiffness="0.5 0 -0.4"'),
    ("inertia.armature", "shoulder", (0.02,)): ('armature="0.01"', 'armature="0.03"'),
    ("mass.scale", "fore", (0.5,)): (
        FORE,
        'pos="0.15 0 0.01" mass="1.2" diaginertia="0.003 0.012 0.0135"',
    ),
    ("mass.offset", "fore", (0.02, 0.0, 0.03)): ("0.15 0 0.01", "0.17 0 0.04"),
    ("mass.offset", "wheel", (0.02, 0.0, 0.03)): (WHEEL, MOVED),
    ("inertia.scale", "fore", (0.5,)): ("0.002 0.008 0.009", "0.003 0.012 0.0135"),
    ("actuator.stiffness", "m_shoulder", (-0.25,)): ('kp="60"', 'kp="45"'),
    ("actuator.damping", "m_shoulder", (-0.5,)): ('kv="3"', 'kv="1.5"'),
    ("actuator.damping", "m_spin", (1.0,)): ('kv="0.05"', 'kv="0.1"'),
    ("gravity.scale", "", (-0.1,)): ("-9.81", "-8.829"),
    ("gravity.tilt", "", (0.1, -0.05)): ("0 0 -9.81", "0.981 -0.4905 -9.81"),
    ("actuator.limit", "m_elbow", (1.5,)): ("-1 4", "-1 1.5"),
    ("actuator.limit", "m_spin", (0.02,)): ('kv="0.05"', 'kv="0.05" forcerange="-0.02 0.02"'),
    ("joint.coupling", "elbow", (-0.3,)): (
        DRIVES,
        TENDON + DRIVES.replace('joint="elbow"', 'tendon="t"'),
    ),
}
"""By effect, place and coefficients: text in the file, and its equivalent replacement."""

HUB = '<joint name="spin" axis="0 0 1"/>'
LOAD = '<body pos="{}"><inertial pos="0 0 0" mass="0.4" diaginertia="1e-14 1e-14 1e-14"/></body>'
STATED |= {
    ("joint.zero", "elbow", (0.15,)): (
        'springref="10"',
        f'springref="10" ref="{np.rad2deg(0.15)}"',
    ),
    ("joint.axis", "spin", (0.3, 0.0, 0.0)): (
        HUB,
        HUB.replace("0 0 1", f"0 {-np.sin(0.3)} {np.cos(0.3)}"),
    ),
    ("joint.axis", "elbow", (np.pi, 0.0, 0.0)): ('"elbow" axis="0 1 0"', '"elbow" axis="0 -1 0"'),
    ("link.length", "fore", (0.25,)): ('"fore" pos="0.4 0 0"', '"fore" pos="0.5 0 0"'),
    ("gravity.compensation", "fore", (0.6,)): ('"fore"', '"fore" gravcomp="0.6"'),
    # A body welded to the link, at its centre of mass plus the offset.
    ("payload", "fore", (0.4, 0.1, -0.02, 0.05)): (
        '<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>',
        '<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>'
        + LOAD.format("0.25 -0.02 0.06"),
    ),
    ("payload", "wheel", (0.4, 0.03, 0.0, 0.0)): (WHEEL, WHEEL + LOAD.format("0.03 0 0")),
}

CONTROL = (0.7, 1.8, 6.0)


def simulate_pair(robot, effect, place, c):
    """Return (2, nq) positions after 0.4 s: an element without the effect, and one with it."""
    of = model_field_effects.MODEL_FIELD_EFFECTS[effect]
    if effect == COUPLING_PLACEHOLDER[1]:
        robot = add_elements(robot, (COUPLING_PLACEHOLDER,))
    batch = Batch(robot.compile(make_batch_spec(robot)), 2, 1)
    fields = {name: batch.expand(name) for name in of.fields}
    of.write(fields, robot, place, np.array([[0.0, value] for value in c]))
    if of.changes_derived_constants:
        batch.set_const()
    return moved(batch)


def moved(batch):
    """Return the positions after 0.4 s of motion."""
    batch.bind("qpos")[:] = (0.3, -0.5, 0.1)
    batch.bind("ctrl")[:] = CONTROL
    batch.step(nstep=400)
    return batch.bind("qpos").copy()


@pytest.mark.parametrize(("effect", "place", "c"), STATED)
def test_an_element_moves_as_the_file_that_states_it(effect, place, c, tmp_path):
    """An element with a coefficient moves as a model whose file has the value; the element next to
    it still moves as the original file.
    """
    arm = robot(tmp_path)
    found = simulate_pair(arm, effect, place, c)
    before, after = STATED[effect, place, c]
    assert ARM.count(before) == 1
    stated = moved(Batch(mujoco.MjModel.from_xml_string(ARM.replace(before, after)), 1, 1))
    plain = moved(Batch(arm.compiled, 1, 1))
    np.testing.assert_allclose(found[1], stated[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found[0], plain[0], rtol=0, atol=1e-12)
    assert np.abs(stated[0] - plain[0]).max() > 1e-5


def test_friction_is_stiff_in_the_elements_where_it_acts_alone(tmp_path):
    """With friction in the file, an element with a zero coefficient moves as the file, although
    another element has more friction.
    """
    arm = robot(tmp_path)
    found = simulate_pair(arm, "friction.coulomb", "elbow", (1e-9,))
    plain = moved(Batch(arm.compiled, 1, 1))
    np.testing.assert_allclose(found[0], plain[0], rtol=0, atol=1e-12)
    stiff = ARM.replace('frictionloss="0.05"', f'frictionloss="0.05" {STIFF}')
    stated = moved(Batch(mujoco.MjModel.from_xml_string(stiff), 1, 1))
    np.testing.assert_allclose(found[1], stated[0], rtol=0, atol=1e-7)
    assert np.abs(found[1] - found[0]).max() > 1e-7


def test_every_native_effect_is_compared():
    """The table above contains every model-field effect, except for those at contacts.

    These are compared in `test_contact_effects` and `test_wheel_radius`.
    """
    at_contacts = {"contact.damping", "contact.friction", "contact.softness", "geom.radius"}
    written = set(model_field_effects.MODEL_FIELD_EFFECTS)
    assert {effect for effect, _, _ in STATED} == written - at_contacts


def test_no_mass_becomes_negative(tmp_path):
    """A coefficient of -3 leaves a positive mass."""
    arm = robot(tmp_path)
    fields = {name: np.array(getattr(arm.compiled, name))[None] for name in ("body_mass",)}
    fields["body_inertia"] = np.array(arm.compiled.body_inertia)[None]
    model_field_effects.MODEL_FIELD_EFFECTS["mass.scale"].write(
        fields, arm, "fore", np.array([[-3.0]])
    )
    assert fields["body_mass"][0, arm.body("fore").id] > 0
