"""Tests of forces on the batch engine against closed forms and conservation laws."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipk

from tests.sims.effects.effect_systems import run

G = 9.81
FREE = {"gravity": 0.0}
WEIGHT = 0.15 * 9.81 * 0.15  # N*m, of the default pendulum at the horizontal


def slide(times, fixed, mass=1.0, u=0.0, **initial):
    """Return x and v, each (T,)."""
    return run("slider", times, fixed, [mass], {"u": np.broadcast_to(u, times.shape)}, **initial).T


def swing(times, fixed, inertia=3.3e-3, u=0.0, **initial):
    """Return q and qd, each (T,)."""
    return run(
        "pendulum", times, fixed, [inertia], {"u": np.broadcast_to(u, times.shape)}, **initial
    ).T


def fly(times, fixed, constants=None, **initial):
    """Return x, y, z and accel_z, each (T,)."""
    return run("ball", times, fixed, constants=constants, **initial).T


def period(times, x):
    """Return the mean period from the upward zero crossings, located by linear interpolation."""
    i = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    crossings = times[i] - x[i] * (times[i + 1] - times[i]) / (x[i + 1] - x[i])
    return (crossings[-1] - crossings[0]) / (len(crossings) - 1)


@pytest.mark.parametrize(("c", "mass"), [(0.8, 2.0), (5.0, 0.5)])
def test_linear_drag_decays_at_its_rate(c, mass):
    times = np.arange(100) * 0.01
    x, v = slide(times, {"drag.linear": c}, mass, v=3.0)
    rate = -np.polyfit(times, np.log(v), 1)[0]
    assert rate == pytest.approx(c / mass, rel=1e-6)
    assert x == pytest.approx(3.0 * mass / c * -np.expm1(-c / mass * times), abs=1e-6)


def test_quadratic_drag_ends_at_the_terminal_speed():
    times, k = np.arange(0, 12, 0.05), 0.05
    terminal = (G / k) ** 0.5
    x, y, z, accel = fly(times, {"drag.quadratic": k}, z=500.0)
    assert z == pytest.approx(
        500 - terminal**2 / G * np.log(np.cosh(G * times / terminal)), abs=1e-5
    )
    assert (z[-2] - z[-1]) / 0.05 == pytest.approx(terminal, rel=1e-4)
    assert accel[-1] == pytest.approx(G, rel=1e-4)
    assert not x.any()
    assert not y.any()


def test_wind_carries_a_weightless_ball_with_the_air():
    times, k, w = np.arange(0, 5, 0.05), 0.1, np.array([6.0, -8.0])
    x, y, _, _ = fly(times, {"wind": [k, *w]}, FREE, z=50.0)
    carried = times - np.log1p(k * 10 * times) / (
        k * 10
    )  # u' = -k |u| u for the velocity relative to the air
    assert x == pytest.approx(6 * carried, abs=1e-6)
    assert y == pytest.approx(-8 * carried, abs=1e-6)


def test_wind_on_a_slider_counts_its_mass():
    times, k, mass = np.arange(0, 5, 0.05), 0.4, 2.0
    x, _ = slide(times, {"wind": [k, 3.0]}, mass)
    assert x == pytest.approx(3 * times - mass / k * np.log1p(3 * k / mass * times), abs=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_coulomb_friction_holds_what_pulls_less_and_lets_go_of_more(sign):
    times = np.arange(0, 1, 0.01)
    for pull, acceleration in ((0.99, 0.0), (1.5, 0.25)):
        x, v = slide(times, {"friction.coulomb": 1.0}, 2.0, sign * pull)
        assert x == pytest.approx(sign * acceleration * times**2 / 2, abs=1e-9)
        assert np.array_equal(v, np.zeros_like(v)) == (pull < 1)


def test_coulomb_friction_takes_the_same_from_every_swing():
    times, c = np.arange(0, 4, 0.005), 2e-3
    q, _ = swing(times, {"friction.coulomb": c, "gravity.scale": 0.0}, q=0.1)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(q)))) + 1
    heights = np.abs(q[turns])[:3]
    assert np.diff(np.concatenate([[0.1], heights])) == pytest.approx(-2 * c / WEIGHT, rel=0.01)
    assert q[-1] == q[-100]
    assert abs(WEIGHT * np.sin(q[-1])) < c


def test_stribeck_friction_stops_after_the_time_of_its_quadrature():
    coulomb, extra, speed, mass = 0.5, 1.0, 0.3, 1.5
    times = np.arange(0, 4, 0.005)
    _, v = slide(times, {"friction.stribeck": [coulomb, extra, speed]}, mass, v=1.0)

    def slowing(s):
        return mass / (coulomb + extra * np.exp(-((s / speed) ** 2)))

    stop = quad(slowing, 0, 1.0)[0]
    halfway = quad(slowing, 0.5, 1.0)[0]
    assert np.interp(halfway, times, v) == pytest.approx(0.5, abs=1e-4)
    assert v[times < stop - 0.005].min() > 0
    assert not v[times > stop + 0.005].any()


def test_stribeck_friction_holds_up_to_its_greatest_level():
    times, c = np.arange(0, 2, 0.01), {"friction.stribeck": [1.0, 0.5, 0.05]}
    assert not slide(times, c, 1.0, 1.49)[0].any()
    _, v = slide(times, c, 1.0, 1.51)
    assert v[-1] > 0.3
    assert np.diff(v)[-10:] / 0.01 == pytest.approx(
        0.51, abs=1e-3
    )  # only the Coulomb level remains


def test_load_friction_takes_a_share_of_the_drive():
    times = np.arange(0, 1, 0.01)
    x, _ = slide(times, {"friction.load": 0.2}, 2.0, 3.0)
    assert x == pytest.approx(0.8 * 3.0 / 2.0 * times**2 / 2, abs=1e-9)


@pytest.mark.parametrize(("factor", "holds"), [(0.995, True), (1.005, False)])
def test_load_friction_holds_in_the_band_of_equilibrium(factor, holds):
    """It holds if |u - w| <= c (u + w): u between w (1 - c) / (1 + c) and w (1 + c) / (1 - c)."""
    times, c, w = np.arange(0, 1, 0.01), 0.2, WEIGHT * np.sin(0.5)
    for u in (w * (1 + c) / (1 - c) * factor, w * (1 - c) / (1 + c) / factor):
        q, _ = swing(times, {"friction.load": c}, u=u, q=0.5)
        assert np.array_equal(q, np.full_like(q, 0.5)) == holds


def test_gravity_scale_shows_in_the_period():
    times, c = np.arange(0, 8, 0.002), 0.15
    q, _ = swing(times, {"gravity.scale": c}, q=1e-3)
    assert period(times, q) == pytest.approx(
        2 * np.pi * (3.3e-3 / (WEIGHT * (1 + c))) ** 0.5, rel=1e-6
    )


def test_gravity_scale_shows_in_the_fall():
    times = np.arange(0, 0.8, 0.02)
    _, _, z, accel = fly(times, {"gravity.scale": -0.1}, z=5.0)
    assert z == pytest.approx(5 - 0.9 * G * times**2 / 2, abs=1e-9)
    assert accel == pytest.approx(0.1 * G, abs=1e-9)


def test_tilt_moves_the_equilibrium_of_a_pendulum():
    times, c = np.arange(0, 3, 0.005), 0.1
    q, _ = swing(times, {"gravity.tilt": c}, q=np.arctan(c))
    assert q == pytest.approx(np.arctan(c), abs=1e-9)
    q, _ = swing(times, {"gravity.tilt": c}, q=np.arctan(c) + 1e-3)
    expected = 2 * np.pi * (3.3e-3 / (WEIGHT * (1 + c * c) ** 0.5)) ** 0.5
    assert period(times, q - np.arctan(c)) == pytest.approx(expected, rel=1e-5)


def test_tilt_pulls_ball_and_slider_sideways():
    times = np.arange(0, 0.8, 0.02)
    x, y, z, _ = fly(times, {"gravity.tilt": [0.1, -0.2]}, z=5.0)
    half = times**2 / 2
    assert np.stack([x, y, z - 5]) == pytest.approx(
        G * np.stack([0.1 * half, -0.2 * half, -half]), abs=1e-9
    )
    assert slide(times, {"gravity.tilt": 0.1}, 3.0)[0] == pytest.approx(
        0.1 * 9.80665 * half, abs=1e-9
    )


def test_magnus_flight_is_a_circle_of_radius_speed_over_coefficient():
    times, c, v = np.arange(0, 12, 0.05), 0.5, 3.0
    x, y, z, _ = fly(times, {"lift.magnus": c}, FREE, z=50.0, vx=v)
    assert x == pytest.approx(v / c * np.sin(c * times), abs=1e-6)
    assert z - 50 == pytest.approx(v / c * (1 - np.cos(c * times)), abs=1e-6)
    assert np.hypot(x, z - 50 - v / c) == pytest.approx(v / c, rel=1e-6)
    assert not y.any()
    x, y, z, _ = fly(times, {"lift.magnus": [0.0, c]}, FREE, z=50.0, vx=v)
    assert np.hypot(x, y - v / c) == pytest.approx(v / c, rel=1e-6)
    assert z == pytest.approx(50.0, abs=1e-12)


def test_springs_keep_energy():
    times, k, cubic = np.arange(0, 10, 0.01), 20.0, 40.0
    x, v = slide(times, {"spring.linear": k, "spring.cubic": cubic}, 0.8, x=0.4, v=1.0)
    energy = 0.8 * v**2 / 2 + k * x**2 / 2 + cubic * x**4 / 4
    assert energy == pytest.approx(energy[0], rel=1e-5)
    assert np.ptp(x) > 0.5


def test_springs_act_on_an_angle_as_on_a_length():
    times, inertia = np.arange(0, 4, 0.002), 3.3e-3
    q, _ = swing(times, {"spring.linear": 0.3}, inertia, q=1e-3)
    assert period(times, q) == pytest.approx(
        2 * np.pi * (inertia / (WEIGHT + 0.3)) ** 0.5, rel=1e-6
    )


@pytest.mark.parametrize("amplitude", [0.1, 0.5])
def test_purely_cubic_spring_has_the_elliptic_period(amplitude):
    times, c, mass = np.arange(0, 40, 0.01), 30.0, 1.2
    x, _ = slide(times, {"spring.cubic": c}, mass, x=amplitude)
    assert period(times, x) == pytest.approx(
        4 * ellipk(0.5) / (amplitude * (c / mass) ** 0.5), rel=1e-5
    )


def test_bias_accelerates():
    times = np.arange(0, 0.8, 0.02)
    assert slide(times, {"force.bias": 1.5}, 3.0)[0] == pytest.approx(0.5 * times**2 / 2, abs=1e-9)
    assert fly(times, {"force.bias": 1.5}, z=5.0)[2] == pytest.approx(
        5 - (G - 1.5) * times**2 / 2, abs=1e-9
    )


def test_ripple_keeps_energy_and_slows_by_its_amplitude():
    times, a, b, length, mass = np.arange(0, 2, 0.002), 0.8, -0.5, 0.2, 0.7
    x, v = slide(times, {"force.ripple": [a, b, length]}, mass, v=1.0)
    wave = 2 * np.pi / length
    potential = (a * np.cos(wave * x) - b * np.sin(wave * x)) / wave
    energy = mass * v**2 / 2 + potential
    assert energy == pytest.approx(energy[0], rel=1e-6)
    assert np.ptp(mass * v**2 / 2) == pytest.approx(2 * np.hypot(a, b) / wave, rel=1e-3)


def test_periodic_force_shakes_with_its_amplitude():
    times, a, b, f, mass = np.arange(0, 3, 0.01), 1.2, -0.7, 2.0, 0.5
    _, v = slide(times, {"force.periodic": [a, b, f]}, mass)
    omega = 2 * np.pi * f
    expected = (a * (1 - np.cos(omega * times)) + b * np.sin(omega * times)) / (mass * omega)
    assert v == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("direction", "rate"), [(1.0, 0.8), (-1.0, 3.0)])
def test_friction_by_direction_decays_at_the_rate_of_its_way(direction, rate):
    times = np.arange(100) * 0.01
    x, v = slide(times, {"friction.direction": (0.8, 3.0)}, 2.0, v=3.0 * direction)
    assert v == pytest.approx(3.0 * direction * np.exp(-rate / 2.0 * times), rel=1e-6)
    assert x == pytest.approx(
        3.0 * direction * 2.0 / rate * -np.expm1(-rate / 2.0 * times), abs=1e-6
    )


def test_friction_in_one_direction_lets_a_spring_swing_back_freely():
    """Half of each swing is damped, the other half conserves energy: amplitude falls once a
    period.
    """
    times, stiffness, damping = np.arange(0, 8, 0.005), 20.0, 1.0
    fixed = {"friction.direction": (damping, 0.0), "spring.linear": stiffness}
    x, v = slide(times, fixed, 1.0, x=-1.0)
    energy = 0.5 * v**2 + 0.5 * stiffness * x**2
    assert np.diff(energy[v < -0.01]).max() < 1e-4
    back = (v[1:] < 0) & (v[:-1] < 0)
    assert np.abs(np.diff(energy)[back]).max() < 1e-6
    damped = np.sqrt(stiffness - damping**2 / 4)
    (peaks,) = np.nonzero((v[:-1] > 0) & (v[1:] <= 0))
    # from rest at -1 through half a damped swing
    assert x[peaks[0]] == pytest.approx(np.exp(-damping / 2 * np.pi / damped), rel=1e-4)


def turn(times, fixed, goal, constants=None, theta=(0.5, 4.0, 2e-3), **initial):
    """Return the angle of a servo, (T,)."""
    inputs = {"goal": np.broadcast_to(goal, times.shape), "torque_enable": np.ones(times.size)}
    return run("servo", times, fixed, list(theta), inputs, constants, **initial)[:, 0]


@pytest.mark.parametrize("begin", [0.95, 1.04, 1.3, 0.2])
def test_a_servo_with_a_dead_zone_rests_where_it_first_comes_within_it(begin):
    times = np.arange(0, 6, 0.01)
    q = turn(times, {"servo.deadband": 0.06}, 1.0, FREE, q=begin)
    if abs(begin - 1.0) < 0.06:
        assert q == pytest.approx(begin, abs=1e-12)
    else:
        # at the edge of the dead zone it is driven no further, and damped by its back EMF
        assert abs(q[-1] - 1.0) <= 0.06 + 1e-3
        assert abs(turn(times, {}, 1.0, FREE, q=begin)[-1] - 1.0) < 1e-3


def test_gravity_pulls_a_servo_by_the_dead_zone_further_down():
    times, width = np.arange(0, 8, 0.01), 0.05
    fixed = {"servo.deadband": width}
    plain, dead = (turn(times, f, 1.0, q=0.9)[-1] for f in ({}, fixed))
    kp, voltage, kt, resistance = 200.0 * 0.00287738, 7.4, 0.5, 4.0
    stiffness = kt * kp * voltage / resistance
    for q, error in ((plain, 1.0 - plain), (dead, 1.0 - dead - width)):
        assert stiffness * error == pytest.approx(0.49 * 9.81 * 0.1 * np.sin(q), rel=1e-5)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_end_stop_without_loss_gives_back_what_it_takes(side):
    """A motion of energy E enters Hertz's contact k d^1.5 / 0.1 to d^2.5 = E / (4 k)."""
    times, mass, speed, k = np.arange(0, 1.5, 0.002), 2.0, 0.8, 900.0
    stop = {"state.limit": (side * k, side * 0.3, 0.0)}
    x, v = slide(times, stop, mass, 0.0, v=side * speed)
    deepest = (0.5 * mass * speed**2 / (4 * k)) ** 0.4
    assert (side * x).max() == pytest.approx(0.3 + deepest, abs=2e-5)
    assert v[-1] == pytest.approx(-side * speed, rel=1e-4)
    free = times < 0.3 / speed - 1e-3
    assert x[free] == pytest.approx(side * speed * times[free], abs=1e-9)


@pytest.mark.parametrize("stiffness", [300.0, 3000.0])
@pytest.mark.parametrize(("loss", "speed"), [(0.05, 0.4), (0.5, 0.8), (1.5, 0.8)])
def test_the_rebound_of_an_end_stop_depends_on_loss_and_speed_alone(stiffness, loss, speed):
    """The rebound speed follows from w dw / (1 + a w) = -F dd / m on the way in and out.

    log((1 + a w) / (1 - a w')) = a (w + w'), with the rebound speed w'; for small a w, w' = w (1 -
    2 a w / 3).
    """
    times = np.arange(0, 3, 0.002)
    _, v = slide(times, {"state.limit": (stiffness, 0.3, loss)}, 2.0, 0.0, v=speed)

    def missed(back):
        return np.log((1 + loss * speed) / (1 - loss * back)) - loss * (speed + back)

    back = brentq(missed, 1e-6, min(speed, 1 / loss) * (1 - 1e-9))
    assert -v[-1] == pytest.approx(back, rel=2e-3)
    if loss * speed < 0.03:
        assert back == pytest.approx((1 - 2 * loss * speed / 3) * speed, rel=1e-3)
