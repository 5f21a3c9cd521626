"""Tests of overflowing levels: against the closed form, refused where not possible, and at the
named place only.
"""

import math

import numpy as np
import pytest

from bench.conformance.toy_systems import FirstOrderTank
from sims import effects
from sims.core.simulator import Channel, InputError, Scenario
from sims.own_simulator import OwnSimulator

DRAIN, RIM = 0.5, 0.7
TIMES = np.arange(81) / 20
TAP = np.where(TIMES < 2.0, 0.6, 0.1)
THETA = np.array([[DRAIN]])


class Pair(FirstOrderTank):
    """Two first-order tanks with the same inflow."""

    name = "pair"
    channels = (Channel("left", "K", 50.0), Channel("right", "m"))
    states = {"left": 0.0, "right": 0.0}  # noqa: RUF012
    levels = ("left", "right")

    def reset(self, theta, constants, initial):
        self.drain, self.both = theta["drain"], dict(initial)

    def step(self, inputs, seconds):
        for name in self.both:
            self.both[name] += (inputs["tap"] - self.drain * self.both[name]) * seconds

    def observe(self):
        return self.both

    def put(self, levels):
        self.both |= levels


def level(times, start, tap):
    """Return the level of a tank without a rim."""
    end = tap / DRAIN
    return end + (start - end) * np.exp(-DRAIN * times)


def test_a_tank_fills_to_its_rim_stays_there_and_drains_from_it():
    tub = FirstOrderTank(fixed={"state.overflow": RIM})
    (seen,) = tub.simulate(THETA, Scenario(TIMES, {"level": 0.2}, {"tap": TAP}))[:, :, 0]
    filled = np.minimum(level(TIMES, 0.2, 0.6), RIM)
    drained = level(TIMES - 2.0, RIM, 0.1)
    np.testing.assert_allclose(seen, np.where(TIMES < 2.0, filled, drained), rtol=1e-12)
    full = math.log((0.6 / DRAIN - 0.2) / (0.6 / DRAIN - RIM)) / DRAIN
    assert (seen == RIM).sum() == ((full <= TIMES) & (TIMES <= 2.0)).sum() > 5
    free = FirstOrderTank().simulate(THETA, Scenario(TIMES, {"level": 0.2}, {"tap": TAP}))[0, :, 0]
    assert free.max() == pytest.approx(level(2.0, 0.2, 0.6), rel=1e-12)


def test_what_begins_above_the_rim_has_run_over_at_once():
    seen = FirstOrderTank(fixed={"state.overflow": RIM}).simulate(
        THETA, Scenario(TIMES, {"level": 2.0})
    )
    np.testing.assert_allclose(seen[0, :, 0], level(TIMES, RIM, 0.0), rtol=1e-12)


def test_each_level_has_its_own_rim_in_its_own_unit_and_size():
    rims = {"state.overflow@left": 1.0, "state.overflow@right": 2.0}
    tap = np.full(81, 3.0)
    (seen,) = Pair(fixed=rims).simulate(THETA, Scenario(TIMES, {}, {"tap": tap}))
    np.testing.assert_array_equal(seen[-1], [1.0, 2.0])
    tuned = Pair(effects=list(rims)).parameters[1:]
    assert [(p.name, p.unit, p.bounds) for p in tuned] == [
        ("state.overflow@left", "K", (0.0, 200.0)),
        ("state.overflow@right", "m", (0.0, 4.0)),
    ]


def test_rims_that_cannot_be_say_why():
    class Fixed(Pair):
        name = "fixed"
        put = OwnSimulator.put

    assert {"state.overflow@left", "state.overflow@right"} <= set(
        effects.list_effects_for(Pair.system)
    )
    assert not {
        name for name in effects.list_effects_for(Fixed.system) if name.startswith("state.")
    }
    for kind, name, message in [
        (Pair, "state.overflow", "needs a place: state.overflow@left, state.overflow@right"),
        (Pair, "state.overflow@top", "unknown place .* 'top'; there are: left, right"),
        (Fixed, "state.overflow@left", "its levels cannot be set"),
    ]:
        with pytest.raises(InputError, match=message):
            kind(fixed={name: 1.0})
