"""Tests of other causes that are refitted with plain MuJoCo."""

import numpy as np
import pytest

from tests.exams.coefficient_fit import fit_coefficients
from tests.exams.planted.equivalent_causes import (
    FORMS,
    held_out_ratios,
)
from tests.exams.planted.planted_cases import STANDARD
from tests.exams.planted.planted_motion import EFFECTS
from tests.exams.planted.test_planted_cases import drawn

EQUAL_RATIO = STANDARD.equal_below
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def test_an_equivalent_cause_fits_as_well_and_another_does_not():
    # For a cart on a slide, its mass and the armature of the slide have the same effect.
    item = drawn("double-pendulum-cart/armature/2")
    assert item.place == "slider"
    ratios = held_out_ratios(
        item,
        ["mass.scale@cart", "inertia.armature@slider", "friction.coulomb@slider", "backlash@m"],
    )
    assert ratios["mass.scale@cart"] <= EQUAL_RATIO
    assert ratios["inertia.armature@slider"] <= 1.01
    assert ratios["friction.coulomb@slider"] > 1.2
    assert ratios["backlash@m"] is None


def test_every_planted_kind_can_be_refitted():
    assert set(EFFECTS.values()) <= FORMS.keys()


@pytest.mark.slow
def test_a_law_that_contains_the_planted_one_fits_as_well():
    item = drawn("pusher/frictionloss/0")
    names = [f"{e}@{item.place}" for e in ("friction.stribeck", "friction.direction")]
    stribeck, direction = held_out_ratios(item, names).values()
    assert stribeck <= EQUAL_RATIO
    assert direction > EQUAL_RATIO


def test_the_fit_finds_a_minimum_at_a_bound():
    def residual(x):
        return np.array([x[0] - 3.0, 2 * x[1] + 4.0])

    free = fit_coefficients(residual, np.zeros(2), np.full(2, -np.inf), np.inf, 12)
    assert free == pytest.approx([3.0, -2.0], abs=1e-4)
    bounded = fit_coefficients(residual, np.zeros(2), np.array([-np.inf, -0.5]), np.inf, 12)
    assert bounded == pytest.approx([3.0, -0.5], abs=1e-4)
