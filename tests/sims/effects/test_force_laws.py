"""Tests of array functions of forces, frictions and contacts against numbers computed by hand."""

import numpy as np
import pytest

from sims import effects
from tests.sims.effects.effect_systems import batch_coefficients, moment

FLIGHT = {"x": [[1.0, 2.0, 3.0]], "v": [[3.0, 0.0, -4.0]]}  # |v| = 5
ROLL = {"x": [[0.5]], "v": [[-2.0]], "theta": [2.0]}


def force(name, now, *c):
    effect = effects.get_effect(name)
    return effect().force(
        batch_coefficients(*c, *[0.0] * (len(effect.coefficients) - len(c)), count=len(now.x)), now
    )[0]


def limit(name, now, *c):
    return effects.get_effect(name)().limit(batch_coefficients(*c, count=len(now.x)), now)[0, 0]


@pytest.mark.parametrize(
    ("name", "c", "expected"),
    [
        ("drag.linear", [0.1], [-0.3, 0, 0.4]),
        ("drag.quadratic", [0.1], [-1.5, 0, 2.0]),
        ("gravity.scale", [0.1], [0, 0, -0.981]),
        ("gravity.tilt", [0.1, -0.2], [0.981, -1.962, 0]),
        ("lift.magnus", [0.5], [2.0, 0, 1.5]),  # c (-vz, vx)
        ("lift.magnus", [0.0, 0.5], [0, 1.5, 0]),
        ("wind", [0.1, 3.0], [0, 0, 1.6]),  # no motion relative to the air along x
        ("wind", [0.1, 0.0, 12.0], [-0.1 * 13 * 3, 0.1 * 13 * 12, 0.1 * 13 * 4]),
        ("force.bias", [0.7], [0, 0, 0.7]),
        ("force.periodic", [0.7, 0.2, 2.5], [0, 0, 0.7]),  # a quarter of a cycle
    ],
)
def test_forces_on_a_ball(name, c, expected):
    assert force(name, moment("ball", t=0.1, **FLIGHT), *c) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "c", "expected"),
    [
        ("drag.linear", [0.1], 0.2),
        ("drag.quadratic", [0.1], 0.4),
        ("gravity.tilt", [0.1], 2.0 * 0.980665),
        ("wind", [0.1, 1.0], 0.9),
        ("spring.linear", [3.0], -1.5),
        ("spring.cubic", [8.0], -1.0),
        ("force.bias", [0.7], 0.7),
        ("force.ripple", [0.7, 0.2, 2.0], 0.7),  # a quarter of a period
        ("force.ripple", [0.7, 0.2, 1.0], -0.2),  # half a period
        ("force.periodic", [0.7, 0.2, 5.0], -0.2),
    ],
)
def test_forces_on_a_slider(name, c, expected):
    assert force(name, moment("slider", t=0.1, **ROLL), *c) == pytest.approx([expected], abs=1e-12)


def test_gravity_on_a_pendulum():
    hanging = moment("pendulum", [[0.3]], [[0.0]], mass=2.0, length=0.5, gravity=10.0)
    assert force("gravity.scale", hanging, 0.1) == pytest.approx([-np.sin(0.3)])
    assert force("gravity.tilt", hanging, 0.1) == pytest.approx([np.cos(0.3)])


def test_lift_does_no_work():
    now = moment("ball", [[0.0, 0.0, 0.0]], [[1.0, 2.0, 3.0]])
    assert force("lift.magnus", now, 0.3, -0.8) == pytest.approx(
        np.cross([0.0, -0.3, -0.8], now.v[0])
    )
    assert force("lift.magnus", now, 0.3, -0.8) @ now.v[0] == pytest.approx(0.0, abs=1e-12)


def test_stribeck_lies_between_its_levels():
    def at(speed):
        return limit("friction.stribeck", moment("slider", [[0.0]], [[speed]]), 1.0, 0.5, 0.1)

    assert (at(0.0), at(10.0)) == (1.5, 1.0)
    assert at(0.1) == at(-0.1) == pytest.approx(1 + 0.5 * np.exp(-1))
    still, moving = (moment("slider", [[0.0]], [[v]]) for v in (0.0, 1e6))
    assert limit("friction.stribeck", still, 1.0, 0.5, 0.0) == 1.5
    assert limit("friction.stribeck", moving, 1.0, 0.5, 0.0) == 1.0


def test_dry_friction_never_drives():
    now = moment("slider", **ROLL, inputs=[3.0])
    assert limit("friction.coulomb", now, 0.4) == 0.4
    for name, c in (
        ("friction.coulomb", [-0.4]),
        ("friction.stribeck", [-1, -1, 1]),
        ("friction.load", [-0.1]),
    ):
        assert limit(name, now, *c) == 0.0


def test_load_counts_both_sides_of_the_transmission():
    assert limit("friction.load", moment("slider", **ROLL, inputs=[-3.0]), 0.1) == pytest.approx(
        0.3
    )
    # At rest the drive carries the weight, so both sides of the gear are loaded.
    held = moment(
        "pendulum", [[0.5]], [[0.0]], inputs=[np.sin(0.5)], mass=0.2, length=0.5, gravity=10.0
    )
    assert limit("friction.load", held, 0.1) == pytest.approx(0.2 * np.sin(0.5))
    driven = moment(
        "pendulum", [[0.5]], [[0.0]], inputs=[-np.sin(0.5)], mass=0.2, length=0.5, gravity=10.0
    )
    assert limit("friction.load", driven, 0.1) == 0.0


def test_restitution_is_a_power_of_speed_that_makes_no_energy():
    effect = effects.get_effect("restitution.speed")()

    def at(e, speed, c):
        return effect.restitution(batch_coefficients(c), np.array([[e]]), np.array([[speed]]))[0, 0]

    assert at(0.8, 1.0, -0.25) == 0.8
    assert at(0.8, 16.0, -0.25) == pytest.approx(0.4)
    assert at(0.3, 4.0, 0.5) == pytest.approx(0.6)
    assert (at(0.8, 0.0, -0.25), at(0.8, 100.0, 0.5)) == (1.0, 1.0)
    assert at(1.2, 3.0, 0.0) == 1.2  # a coefficient of zero changes nothing


def test_contact_friction_is_its_coefficient():
    effect = effects.get_effect("contact.friction")()
    assert effect.friction(batch_coefficients(0.3, count=2)).tolist() == [[0.3], [0.3]]
    assert effect.friction(batch_coefficients(-0.3)).tolist() == [[0.0]]


def test_elements_do_not_influence_each_other():
    c = np.array([[[0.1], [0.2], [0.0]]])
    now = moment("slider", [[0.0]] * 3, [[1.0], [2.0], [3.0]])
    assert effects.get_effect("drag.quadratic")().force(c, now).tolist() == [[-0.1], [-0.8], [0.0]]
