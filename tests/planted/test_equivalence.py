"""Other causes, refitted with plain MuJoCo."""

import pytest

from tests.planted.equivalence import EQUAL_FORMS, held_out_ratios
from tests.planted.items import KINDS
from tests.planted.marking import EQUAL_RATIO
from tests.planted.motion import EFFECTS
from tests.planted.test_items import drawn

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def test_a_twin_is_as_good_and_another_cause_is_not():
    # A cart on a slide: its mass and the armature of the slide are the same in all data.
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
    assert {EFFECTS[kind] for kind in KINDS} <= EQUAL_FORMS.keys()
