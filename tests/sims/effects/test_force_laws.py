"""Tests of array functions of forces, frictions and contacts against numbers computed by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from sims import effects
from tests.sims.effects.effect_systems import batch_coefficients, moment

ROLL = {"x": [[0.5]], "v": [[-2.0]], "theta": [2.0]}


def limit(name, now, *c):
    return effects.get_effect(name)().limit(batch_coefficients(*c, count=len(now.x)), now)[0, 0]


def test_stribeck_friction_without_a_width_acts_at_standstill_alone():
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


def test_an_end_stop_absorbs_the_speed_of_the_coordinate_that_hits_it():
    """Eq. (2) of `sims.effects.state_limits` for the second of two coordinates."""
    stiffness, place, loss, depth, rate = 200.0, 0.3, 0.5, 0.04, 0.7
    now = SimpleNamespace(
        primary=np.array([[place + depth]]), primary_rate=np.array([[rate]]),
        v=np.array([[-3.0, rate]]), along_primary=lambda force: force,
    )  # fmt: skip
    stop = effects.get_effect("state.limit")()
    force = stop.force(batch_coefficients(stiffness, place, loss), now)
    expected = -stiffness * depth * np.sqrt(depth / 0.01) * (1.0 + loss * rate)
    assert force == pytest.approx(np.array([[expected]]))
