"""Tests of effects with a hidden state against closed forms: flexibility, backlash, hysteresis."""

import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.engines.compiled.force_program import compute_own_inertia
from sims.systems.slider import Slider, SliderSystem
from tests.sims.effects.effect_systems import batch_coefficients, moment

TIMES = np.arange(200) / 100
MASS = 1.3


def slide(effects, u=0.0, v=0.0, **settings):
    """Return position and velocity (T,) of a slider driven by the force u."""
    simulator = Slider(engine="batch", fixed=effects, **settings)
    run = Scenario(TIMES, {"x": 0.0, "v": v}, {"u": np.broadcast_to(u, TIMES.shape).copy()})
    return simulator.simulate(np.array([[MASS]]), run)[0].T


def test_dry_friction_holds_the_drive_while_the_load_swings_on():
    # The drive does not move: its load starts at rest, and the push is less than friction.
    x, v = slide({"joint.flexibility": (0.5, 20.0, 0.1), "friction.coulomb": 2.0}, 1.0)
    assert not x.any()
    assert not v.any()
    # Friction stops the drive during fast motion while the load still moves, until the load pulls
    # it out of sticking.
    knock = np.select([TIMES < 0.15, TIMES < 0.25], [12.0, -12.0])
    x, v = slide({"joint.flexibility": (0.6, 8.0, 0.01), "friction.coulomb": 4.0}, knock)
    still = v[1:] == 0.0
    loose = np.flatnonzero(still[:-1] & ~still[1:])
    assert loose.size >= 2
    np.testing.assert_array_equal(x[1:-1][still[:-1] & still[1:]], x[2:][still[:-1] & still[1:]])


def test_a_load_without_inertia_changes_no_standstill_or_break_away():
    pulses = np.where(TIMES % 0.8 < 0.4, 3.0, -3.0) * np.exp(-0.5 * TIMES)
    friction = {"friction.coulomb": 0.7, "friction.stribeck": (0.4, 0.9, 0.1)}
    light, bare = (
        slide({**load, **friction}, pulses, v=-0.4)
        for load in ({"joint.flexibility": (1e-13, 5.0, 0.1)}, {})
    )
    assert 20 < (bare[1] == 0.0).sum() < 150
    np.testing.assert_array_equal(light[1] == 0.0, bare[1] == 0.0)
    np.testing.assert_allclose(light, bare, atol=1e-5)


@pytest.mark.parametrize(
    "off", [{"joint.flexibility": (0.0, 30.0, 0.1)}, {"joint.backlash": (0.0, 0.3)}]
)
def test_what_is_off_changes_no_bit(off):
    pulses = np.where(TIMES % 0.8 < 0.4, 3.0, -3.0)
    with_it, without = (slide({**e, "drag.linear": 0.4}, pulses) for e in (off, {}))
    np.testing.assert_array_equal(with_it, without)


def test_elements_with_and_without_a_state_are_each_as_alone():
    names = ("joint.flexibility", "friction.hysteresis", "friction.coulomb")
    simulator = Slider(engine="batch", effects=names)
    run = Scenario(TIMES, {"x": 0.0, "v": 0.3}, {"u": np.sin(5 * TIMES)})
    rows = np.zeros((4, len(simulator.parameters)))
    rows[:, 0] = MASS
    rows[1, 1:4] = 0.3, 25.0, 0.1
    rows[2, 4:6] = 0.2, 0.03
    rows[3, 1:] = 0.3, 25.0, 0.1, 0.2, 0.03, 0.4
    together = simulator.simulate(rows, run)
    for row, seen in zip(rows, together, strict=True):
        np.testing.assert_array_equal(simulator.simulate(row[None], run)[0], seen)
    assert len({seen[-1, 0] for seen in together}) == 4


def test_inertia_is_that_of_the_drive_side():
    from sims.effects.friction import FrictionHysteresis
    from sims.effects.transmission import JointFlexibility

    acting = [
        (JointFlexibility(), batch_coefficients(0.25, 30.0, 0.1)),
        (FrictionHysteresis(), batch_coefficients(0.5, 0.01)),
    ]
    inertia = compute_own_inertia(SliderSystem(), np.array([[2.0]]), {}, acting)
    assert inertia[0, 0] == pytest.approx(1.5)


def test_a_share_beyond_all_leaves_something_to_either_side():
    from sims.effects.transmission import JointFlexibility

    assert JointFlexibility().behind(batch_coefficients(5.0, 30.0, 0.1))[0, 0] == pytest.approx(
        0.98
    )
    at = moment("slider", [[0.1]], [[0.2]], theta=[[2.0]])
    assert at.inertia[0, 0] == 2.0


@pytest.mark.parametrize("engine", ["mujoco", "pybullet"])
def test_engines_of_one_coordinate_say_that_they_cannot(engine):
    pytest.importorskip(engine)
    with pytest.raises(InputError, match=f"engine {engine} cannot simulate .*choose engine batch"):
        Slider(engine=engine, fixed={"joint.flexibility": (0.3, 20.0, 0.1)})
