"""Tests of the reference simulations.

SciPy and MuJoCo agree about every effect, and unmodelled causes agree with closed forms.
"""

import numpy as np
import pytest

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import TrueSystem
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    SIMULATORS,
    draw_input_signal,
    get_constants,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    CHANNELS,
    simulate_with_mujoco,
    simulate_with_scipy,
)
from sims import effects as library
from sims.core.simulator import Scenario
from tests.sims.engine_agreement import coefficients

TIMES = np.arange(300) / 100
# Error of MuJoCo's second-order steps of 1 ms (for sensor.lag: at a bounce), in m, rad, m/s, rad/s.
TOLERANCE = {"ball": (5e-5,) * 3, "pendulum": (1e-4, 1e-3), "slider": (5e-6, 5e-6)}
KNOCKS = (1e-5, 5e-4)  # Larger, because the force has a kink if a flank is met between two steps.
TURNS = (2e-3, 8e-3)  # Larger, because the force jumps if a motion reverses between two steps.
BASE = {"ball": {"restitution": 0.7}, "pendulum": {"inertia": 0.004}, "slider": {"mass": 1.2}}
OTHER_COEFFICIENTS = {
    ("pendulum", "friction.warming"): (0.015, 1e-3, 0.8),
    ("pendulum", "sensor.eccentricity"): (0.05, 0.04),
    ("pendulum", "sensor.gain"): (0.05,),
    ("slider", "state.limit"): (40.0, 0.6, 0.3),
}
"""Coefficients of effects with which those of the engines change too little, or are 1."""
EFFECTS = [
    (system, effect)
    for system, simulator in SIMULATORS.items()
    for effect in library.list_effects_for(simulator.system)
]
TOGETHER = [
    ("ball", {"drag.linear": (0.1,), "restitution.speed": (-0.1,), "sensor.delay": (0.02,)}),
    ("ball", {"contact.friction": (0.05,), "lift.magnus": (0.2, -0.1), "sensor.gain": (0.05,)}),
    ("pendulum", {"friction.coulomb": (0.01,), "input.saturation": (0.06,), "input.lag": (0.04,)}),
    (
        "pendulum",
        {
            "friction.stribeck": (0.005, 0.01, 0.5),
            "force.periodic": (0.02, 0.0, 0.7),
            "clock.skew": (0.01,),
        },
    ),
    ("slider", {"friction.coulomb": (0.6,), "joint.flexibility": (0.5, 20.0, 0.05)}),
    (
        "slider",
        {"friction.coulomb": (0.6,), "force.periodic": (0.5, 0.5, 0.6), "input.lag": (0.1,)},
    ),
    (
        "slider",
        {
            "backlash": (0.6,),
            "input.delay": (0.021,),
            "spring.linear": (3.0,),
            "sensor.lag": (0.02,),
        },
    ),
]


def scenario(system, form="steps"):
    if system == "ball":
        return Scenario(TIMES, {"x": 0.1, "y": 0.2, "z": 3.0, "vx": 1.0, "vy": -0.5, "vz": 0.3})
    u = draw_input_signal(form, TIMES, np.random.default_rng(1), (0.5, 2.0))
    if system == "pendulum":
        return Scenario(TIMES, {"q": 0.8, "qd": 1.0}, {"u": 0.07 * u})
    return Scenario(TIMES, {"x": 0.1, "v": 0.2}, {"u": 2.0 * (u - u.mean())})


def world(system, **effects):
    return TrueSystem(system, BASE[system], get_constants(system), effects)


@pytest.mark.parametrize(("system", "effect"), EFFECTS)
def test_scipy_and_mujoco_agree_about_each_effect(system, effect):
    c = OTHER_COEFFICIENTS.get((system, effect), coefficients(system, effect))
    run, hidden = scenario(system, "chirp"), world(system, **{effect: tuple(np.atleast_1d(c))})
    seen, other = (
        see(hidden, run, CHANNELS[system]) for see in (simulate_with_scipy, simulate_with_mujoco)
    )
    changes = np.abs(seen - simulate_with_scipy(world(system), run, CHANNELS[system])).max(axis=0)
    within = {"joint.backlash": KNOCKS, "supply.braking": TURNS}
    tolerance = within.get(effect, TOLERANCE[system])
    assert (np.abs(seen - other).max(axis=0) < tolerance).all()
    assert changes.max() > 50 * max(tolerance)  # Otherwise the agreement would mean nothing.


@pytest.mark.parametrize(("system", "effects"), TOGETHER)
def test_scipy_and_mujoco_agree_about_effects_together(system, effects):
    run, hidden = scenario(system), world(system, **effects)
    seen, other = (
        see(hidden, run, CHANNELS[system]) for see in (simulate_with_scipy, simulate_with_mujoco)
    )
    assert (np.abs(seen - other).max(axis=0) < 2 * np.array(TOLERANCE[system])).all()


def strange(system, foreign, initial, number=0, times=TIMES):
    """Simulate a run without input, with an unmodelled cause."""
    names = list(SIMULATORS[system].states)
    run = Scenario(times, dict(zip(names, initial, strict=True)))
    return simulate_with_scipy(
        TrueSystem(system, BASE[system], get_constants(system), foreign),
        run,
        CHANNELS[system],
        number,
    )


def test_gust_on_the_slider_is_a_push_for_a_while_in_its_own_time():
    force, lasting, begin, mass = 2.0, 0.25, 1.1, BASE["slider"]["mass"]
    x, v = strange("slider", {"gust": (force, lasting, 0.4, begin)}, (0.1, 0.2), number=1).T
    inside = np.clip(TIMES - begin, 0.0, lasting)
    after = np.clip(TIMES - begin - lasting, 0.0, None)
    pushed = force / mass * (inside**2 / 2 + lasting * after)
    np.testing.assert_allclose(x, 0.1 + 0.2 * TIMES + pushed, atol=1e-8)
    np.testing.assert_allclose(v, 0.2 + force / mass * inside, atol=1e-8)


def test_ageing_damps_by_the_square_of_time():
    _, v = strange("slider", {"ageing": (0.5,)}, (0.0, 1.0)).T
    np.testing.assert_allclose(v, np.exp(-0.5 * TIMES**2 / (2 * BASE["slider"]["mass"])), atol=1e-7)


def test_a_latch_turns_the_slider_round_in_half_a_period_every_other_time():
    latch, speed = {"latch": (50.0, 0.5)}, 0.8
    x, v = strange("slider", latch, (0.0, speed)).T
    meets, half = 0.5 / speed, np.pi * np.sqrt(BASE["slider"]["mass"] / 50.0)
    assert x.max() == pytest.approx(0.5 + speed * half / np.pi, abs=1e-4)
    back = meets + half < TIMES
    np.testing.assert_allclose(v[back], -speed, atol=1e-6)
    np.testing.assert_allclose(x[back], 0.5 - speed * (TIMES[back] - meets - half), atol=1e-6)
    other = strange("slider", latch, (0.0, speed), number=1)
    np.testing.assert_allclose(other[:, 0], speed * TIMES, atol=1e-9)


def test_patch_dissipates_its_work_and_stops_a_slow_slider():
    mass, rubs, half = BASE["slider"]["mass"], 0.5, 0.1
    x, v = strange("slider", {"patch": (rubs, 0.4, half)}, (0.0, 0.8)).T
    assert v[-1] ** 2 == pytest.approx(0.8**2 - 2 * rubs * 2 * half / mass, rel=1e-5)
    x, v = strange("slider", {"patch": (rubs, 0.4, half)}, (0.0, 0.3)).T
    assert v[-1] == 0.0
    # The tolerance is 0.01 because the border of the patch is smooth.
    assert x[-1] == pytest.approx(0.3 + 0.3**2 * mass / (2 * rubs), abs=0.01)


def test_foreign_causes_act_on_the_pendulum_as_on_the_slider():
    start = (0.5, 0.0)
    free = strange("pendulum", {}, start)
    far = {"patch": (0.1, 3.0, 0.1), "latch": (1.0, 3.0)}
    np.testing.assert_allclose(strange("pendulum", far, start), free, atol=1e-6)
    for cause in (
        {"patch": (0.002, 0.2, 0.1)},
        {"latch": (0.1, 0.2)},
        {"gust": (0.02, 0.2, 1.0)},
        {"ageing": (1e-3,)},
    ):
        assert np.abs(strange("pendulum", cause, start) - free)[:, 0].max() > 0.01


THROWN = (0.0, 0.0, 3.0, 1.5, -0.5, 1.0)


def test_updraft_lifts_only_above_its_position():
    everywhere = strange("ball", {"updraft": (2.0, 0.0, 1e6)}, THROWN)
    lifted = simulate_with_scipy(
        world("ball", **{"force.bias": (2.0,)}), Scenario(TIMES, _named(THROWN)), CHANNELS["ball"]
    )
    np.testing.assert_allclose(everywhere, lifted, atol=1e-6)
    nowhere = strange("ball", {"updraft": (2.0, -50.0, 1.0)}, THROWN)
    np.testing.assert_allclose(nowhere, strange("ball", {}, THROWN), atol=1e-8)


def test_layer_drags_only_above_its_height():
    everywhere = strange("ball", {"layer": (0.1, -5.0)}, THROWN)
    dragged = simulate_with_scipy(
        world("ball", **{"drag.quadratic": (0.1,)}),
        Scenario(TIMES, _named(THROWN)),
        CHANNELS["ball"],
    )
    np.testing.assert_allclose(everywhere, dragged, atol=1e-6)
    nowhere = strange("ball", {"layer": (0.1, 9.0)}, THROWN)
    np.testing.assert_allclose(nowhere, strange("ball", {}, THROWN), atol=1e-8)


def test_gust_on_the_ball_is_a_push_for_a_while():
    times = np.arange(60) / 100
    seen = strange("ball", {"gust": (4.0, -3.0, 0.2, 0.1)}, (0, 0, 4.0, 0, 0, 1.0), times=times)
    inside, after = np.clip(times - 0.1, 0.0, 0.2), np.clip(times - 0.3, 0.0, None)
    pushed = inside**2 / 2 + 0.2 * after
    np.testing.assert_allclose(seen[:, 0], 4.0 * pushed, atol=1e-8)
    np.testing.assert_allclose(
        seen[:, 2], 4.0 + times - 9.81 * times**2 / 2 - 3.0 * pushed, atol=1e-8
    )


def test_wear_lowers_each_bounce():
    times = np.arange(4000) / 1000
    z = strange("ball", {"wear": (0.1,)}, (0, 0, 2.5, 0, 0, 0), times=times)[:, 2]
    t = np.sqrt(2 * 2.0 / 9.81)
    height, tops = 2.0, []
    for _ in range(3):
        height *= (0.7 * (1 - 0.1 * t)) ** 2
        tops.append(height + 0.5)
        t += 2 * np.sqrt(2 * height / 9.81)
    peaks = z[1:-1][(z[1:-1] > z[:-2]) & (z[1:-1] >= z[2:])]
    np.testing.assert_allclose(peaks[:3], tops, atol=1e-5)


def _named(initial):
    return dict(zip(SIMULATORS["ball"].states, initial, strict=True))
