"""Tests of effects on impacts, simulated with the batch engine."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.systems.ball import Ball
from tests.sims.effects.effect_systems import run

G, RADIUS = 9.81, 0.5


def first_rebound(heights, fixed, e):
    """Return the speed before and after the first impact, from the drop height and the next
    apex.
    """
    times = np.arange(0, 2.4, 0.002)
    ball = Ball(observe=["z"], engine="batch", fixed=fixed)
    scenarios = [Scenario(times, {"z": RADIUS + h}) for h in heights]
    z = ball.simulate_batch(np.full((len(heights), 1), e), scenarios)[:, :, 0]
    apexes = []
    for row in z:
        up = int(np.argmax(np.diff(row) > 0)) + 1
        top = up + int(np.argmax(np.diff(row[up:]) < 0))
        apexes.append(
            np.polyval(
                np.polyfit(times[top - 5 : top + 6] - times[top], row[top - 5 : top + 6], 2), 0.0
            )
        )
    return (2 * G * np.array(heights)) ** 0.5, (2 * G * (np.array(apexes) - RADIUS)) ** 0.5


@pytest.mark.parametrize(("e0", "c"), [(0.8, -0.2), (0.5, 0.15), (0.7, 0.0)])
def test_the_law_of_restitution_is_recovered_from_apex_heights(e0, c):
    impact, leaving = first_rebound([0.4, 0.8, 1.5, 3.0, 6.0], {"restitution.speed": c}, e0)
    slope, level = np.polyfit(np.log(impact), np.log(leaving / impact), 1)
    assert slope == pytest.approx(c, abs=1e-3)
    assert np.exp(level) == pytest.approx(e0, rel=1e-3)


@pytest.mark.parametrize(("e", "c"), [(0.7, 0.1), (0.3, 0.2)])
def test_contact_friction_takes_its_share_of_the_impact_from_the_sliding(e, c):
    times = np.arange(0, 0.8, 0.01)
    vx, vy = 3.0, -4.0
    fixed = {"contact.friction": c}
    x, y, _, _ = run("ball", times, fixed, [e], z=RADIUS + 1.0, vx=vx, vy=vy).T
    lost = c * (1 + e) * (2 * G) ** 0.5
    after = times > (2 / G) ** 0.5 + 0.01
    first = slice(int(np.argmax(after)), int(np.argmax(after)) + 5)  # before any second impact
    speed = np.array([np.polyfit(times[first], column[first], 1)[0] for column in (x, y)])
    assert np.hypot(*speed) == pytest.approx(5.0 - lost, abs=1e-6)
    assert speed / np.hypot(*speed) == pytest.approx([0.6, -0.8], abs=1e-6)


def test_contact_friction_takes_no_more_than_there_is():
    times = np.arange(0, 0.8, 0.01)
    x = run("ball", times, {"contact.friction": 1.0}, [0.5], z=RADIUS + 1.0, vx=0.5).T[0]
    impact = (2 / G) ** 0.5
    assert x[times > impact] == pytest.approx(0.5 * impact, abs=1e-9)
