"""Tests of array functions of forces, frictions and contacts against numbers computed by hand."""

import numpy as np
import pytest

from sims import effects
from tests.sims.effects.effect_systems import batch_coefficients, moment

ROLL = {"x": [[0.5]], "v": [[-2.0]], "theta": [2.0]}
STATES = {"ball": {"x": [[1.0, 2.0, 3.0]], "v": [[3.0, 0.0, -4.0]]}, "slider": ROLL}


def force(name, now, *c):
    effect = effects.get_effect(name)
    return effect().force(
        batch_coefficients(*c, *[0.0] * (len(effect.coefficients) - len(c)), count=len(now.x)), now
    )[0]


def limit(name, now, *c):
    return effects.get_effect(name)().limit(batch_coefficients(*c, count=len(now.x)), now)[0, 0]


@pytest.mark.parametrize(
    ("system", "name", "c", "expected"),
    [
        ("ball", "drag.linear", [0.1], [-0.3, 0, 0.4]),
        ("ball", "wind", [0.1, 3.0], [0, 0, 1.6]),  # no motion relative to the air along x
        ("ball", "force.periodic", [0.7, 0.2, 2.5], [0, 0, 0.7]),  # a quarter of a cycle
        ("slider", "drag.quadratic", [0.1], [0.4]),
    ],
)
def test_forces_that_no_closed_form_of_a_run_covers(system, name, c, expected):
    state = moment(system, t=0.1, **STATES[system])
    assert force(name, state, *c) == pytest.approx(expected, abs=1e-12)


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
