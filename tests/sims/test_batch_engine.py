"""Tests of the batch engine against SciPy, closed forms and itself."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import TrueSystem
from sims import effects as library
from sims.core.engine import IntegrationBatch
from sims.core.simulator import InputError, Parameter, Scenario
from sims.core.system import System
from sims.effects.friction import CoulombFriction
from sims.engines.batch_engine import make_engine
from sims.engines.compiled import force_program, register_programs
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider
from tests.sims.simulation_cases import (
    FORCES,
    SIMULATORS,
    errors,
    simulate,
    simulate_reference,
    steps,
)

T = np.arange(201) / 100


@pytest.fixture(autouse=True, params=["traced", "evaluated"])
def force_evaluation(request, monkeypatch):
    """Run each test with traced forces, and with forces that NumPy evaluates."""
    if request.param == "evaluated":
        monkeypatch.setattr(register_programs.TracedPrograms, "find", lambda *_: None)
        monkeypatch.setattr(force_program, "_traced_forces", {})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "position", "rate"),
    [("ball", 5e-7, 0), ("pendulum", 5e-4, 1e-3), ("slider", 1e-5, 5e-5), ("servo", 2e-5, 0)],
)
def test_agrees_with_scipy_on_twenty_random_elements(system, position, rate):
    worst = np.max([errors(system, seed) for seed in range(20)], axis=0)
    tolerance = {"ball": [position] * 3, "servo": [position]}.get(system, [position, rate])
    assert (worst < tolerance).all(), worst


@pytest.mark.parametrize(
    ("system", "seed"), [("pendulum", 10), ("pendulum", 8), ("slider", 14), ("servo", 12)]
)
def test_agrees_with_scipy_to_its_own_accuracy_when_steps_are_short(system, seed):
    assert errors(system, seed, time_step=5e-4).max() < 1e-6


def order(cls, fixed, theta, scenario, lengths=(0.02, 0.01, 0.005)):
    """Return the order of convergence: the slope of log error over log step."""
    exact = cls(engine="batch", fixed=fixed, time_step=2.5e-4).simulate(theta, scenario)
    found = [
        np.sqrt(
            np.mean(
                (cls(engine="batch", fixed=fixed, time_step=h).simulate(theta, scenario) - exact)
                ** 2
            )
        )
        for h in lengths
    ]
    return np.polyfit(np.log(lengths), np.log(found), 1)[0]


@pytest.mark.parametrize(
    ("cls", "fixed", "theta", "initial"),
    [
        (
            Slider,
            {"spring.linear": 2.0, "spring.cubic": 1.0, "drag.linear": 1.0},
            [[1.0]],
            {"x": 1.0, "v": 1.0},
        ),
        (
            Slider,
            {"spring.linear": 4.0, "drag.linear": 0.3, "friction.coulomb": 0.3},
            [[1.0]],
            {"x": 2.0},
        ),
        (
            Ball,
            {"drag.quadratic": 0.3, "lift.magnus": [1.0, 0.5]},
            [[0.8]],
            {"z": 2.0, "vx": 5.0, "vy": 3.0},
        ),
    ],
)
def test_converges_with_order_four_through_impacts_and_standstill(cls, fixed, theta, initial):
    scenario = Scenario(np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0]), initial)
    observed = {"observe": ["x", "y", "z"]} if cls is Ball else {}
    found = order(lambda **settings: cls(**observed, **settings), fixed, np.array(theta), scenario)
    assert 3.7 < found < 4.6


def test_ball_in_closed_form():
    g, h, e = 9.81, 4.0, 0.8
    fall = np.sqrt(2 * h / g)
    apex = fall * (1 + e)  # of the first bounce
    times = np.array([0.0, fall / 2, apex, fall * (1 + 2 * e + e * e), 3.9, 4.0])
    seen = Ball(engine="batch").simulate(
        np.array([[e]]), Scenario(times, {"z": h + 0.5, "vx": 1.5})
    )[0]
    np.testing.assert_allclose(seen[:4, 2] - 0.5, [h, h * 0.75, h * e**2, h * e**4], rtol=1e-13)
    np.testing.assert_allclose(seen[:, 0], 1.5 * times, rtol=1e-13)
    np.testing.assert_allclose(seen[:, 3], 0.0, atol=1e-13)


@pytest.mark.parametrize("fixed", [{}, {"drag.quadratic": 1e-12}])
def test_bounces_die_out_and_the_ball_rests_and_glides(fixed):
    g, h, e = 9.81, 1.0, 0.5
    over = np.sqrt(2 * h / g) * (1 + e) / (1 - e)
    times = np.array(
        [0.0, over - 0.05, over + 1e-3, over + 1.0]
    )  # the last bounces are in one interval
    ball = Ball(engine="batch", fixed={"contact.friction": 0.1, **fixed})
    seen = ball.simulate(np.array([[e]]), Scenario(times, {"z": h + 0.5, "vx": 4.0}))[0]
    assert (seen[2:, 2] == 0.5).all()
    assert (seen[2:, 3] == g).all()
    lost = 0.1 * (1 + e) * np.sqrt(2 * g * h) / (1 - e)
    np.testing.assert_allclose(
        np.diff(seen[2:, 0]), (4.0 - lost) * (times[3] - times[2]), rtol=1e-7
    )


def test_every_element_may_bounce_many_times_within_one_step():
    times = np.array([0.0, 4.0])
    theta = np.linspace(0.3, 0.9, 13)[:, None]
    scenario = Scenario(times, {"z": 2.0})
    free = Ball(engine="batch").simulate(theta, scenario)
    stepped = Ball(engine="batch", fixed={"drag.linear": 1e-13}, time_step=4.0).simulate(
        theta, scenario
    )
    np.testing.assert_allclose(stepped, free, atol=1e-8)


def test_ball_at_rest_leaves_the_ground_when_pulled_up():
    for bias, height in ((9.0, 0.5), (12.0, 0.5 + 0.5 * (12.0 - 9.81))):
        seen = Ball(engine="batch", fixed={"force.bias": bias}).simulate(
            np.array([[0.5]]), Scenario(np.array([0.0, 1.0]), {"z": 0.5})
        )
        assert seen[0, 1, 2] == pytest.approx(height, rel=1e-12)


def test_bounces_that_never_die_out_end():
    ball = Ball(engine="batch", fixed={"restitution.speed": -0.15, "drag.linear": 0.1})
    seen = ball.simulate(np.linspace(0.05, 0.6, 12)[:, None], Scenario(T * 2, {"z": 1.0}))
    assert (seen[:, :, 2] >= 0.5 - 1e-12).all()


def test_friction_stops_where_it_should_and_then_holds_exactly_still():
    m, c, v = 2.0, 3.0, 1.0
    slider = Slider(engine="batch", fixed={"friction.coulomb": c})
    pulled = np.where(T < 1.0, 0.0, np.where(T < 1.5, 0.999 * c, 1.5 * c))
    seen = slider.simulate(np.array([[m]]), Scenario(T, {"v": v}, {"u": pulled}))[0]
    stop = m * v / c
    np.testing.assert_allclose(seen[stop > T, 1], v - c / m * T[stop > T], atol=1e-13)
    rest = seen[(stop < T) & (T <= 1.5)]
    assert (rest == rest[0]).all()
    assert rest[0] == pytest.approx([0.5 * m * v**2 / c, 0.0], rel=1e-12)
    np.testing.assert_allclose(seen[T > 1.5, 1], 0.5 * c / m * (T[T > 1.5] - 1.5), atol=1e-12)


def test_a_sticking_body_breaks_away_within_a_step():
    c, a, f = 1.0, 1.5, 0.5
    slider = Slider(
        engine="batch", fixed={"friction.coulomb": c, "force.periodic": [a, 0.0, f]}, time_step=0.05
    )
    w = 2 * np.pi * f
    loose = np.arcsin(c / a) / w
    seen = slider.simulate(np.array([[1.0]]), Scenario(T[:60:5]))[0]
    t = T[:60:5]
    expected = np.where(
        t > loose, a / w * (np.cos(w * loose) - np.cos(w * t)) - c * (t - loose), 0.0
    )
    np.testing.assert_allclose(seen[:, 1], expected, atol=1e-6)
    assert (seen[t < loose] == 0.0).all()


class Puck(System):
    """A body on a level plane, to test friction in two dimensions."""

    name, says, kind = "puck", "a puck", "point"
    parameters = (Parameter("unused", "1", 0.5, (0, 1)),)
    coordinates, rates, sensed = ("x", "y"), ("vx", "vy"), ("x",)

    def mass(self, theta, constants):
        return np.ones((len(theta), 1))

    def weight(self, moment):
        return np.tile([0.3, 0.0], (len(moment.x), 1))

    def observe(self, x, v, a, constants):
        return {"x": x[:, :, 0]}


def slid(v, limit, lengths, every=1):
    v = np.atleast_2d(np.array(v, dtype=float))
    c = np.full((1, len(v), 1), limit)
    still, theta = np.zeros_like(v), np.zeros((len(v), 1))
    batch = IntegrationBatch(
        Puck(),
        theta,
        {},
        still,
        v,
        np.tile(lengths, (len(v), 1)),
        {},
        ((CoulombFriction(), c),),
        every,
    )
    return make_engine(Puck).integrate(batch)


def test_friction_in_two_dimensions_follows_the_direction_of_motion():
    def rate(t, y):
        return [y[2], y[3], *([0.3, 0.0] - 1.0 * y[2:] / np.hypot(*y[2:]))]

    motion = slid([-0.5, 0.8], 1.0, np.full(80, 0.01))
    solved = solve_ivp(rate, (0, 0.8), [0, 0, -0.5, 0.8], rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose([*motion.x[0, -1], *motion.v[0, -1]], solved, atol=1e-6)
    back = slid([-0.5, 0.0], 0.2, np.full(300, 0.01))  # reverses and never sticks
    turn = 0.5 / 0.5
    assert back.v[0, -1, 0] == pytest.approx(0.1 * (3.0 - turn), rel=1e-9)
    held = slid([-0.5, 0.0], 0.4, np.full(300, 0.01))
    assert (held.v[0, -1] == 0.0).all()
    assert held.x[0, -1, 0] == pytest.approx(-(0.5**2) / (2 * 0.7), rel=1e-9)


@pytest.mark.parametrize("system", list(SIMULATORS))
def test_an_element_depends_on_itself_alone(system):
    cls, rng = SIMULATORS[system], np.random.default_rng(5)
    names = [*FORCES[system], "sensor.delay", "clock.skew", "sensor.lag"]
    if system != "ball":
        names += ["input.lag", "backlash"]
    simulator = cls(engine="batch", effects=names)
    low, high = np.array([p.bounds for p in simulator.parameters]).T
    theta = rng.uniform(low, high, (40, low.size))
    off = rng.uniform(size=(40, len(names))) < 0.85
    place = len(cls.parameters)
    for k, effect in enumerate(simulator.effects):
        count = len(effect.on(simulator.system))
        theta[np.ix_(off[:, k], range(place, place + count))] = 0.0
        place += count
    theta[20:25, len(cls.parameters) :] = 0.0
    runs = []
    for k in range(5):
        t = np.arange(40 - 5 * k) / (40.0 + 20 * k)
        command = {
            channel.name: steps(rng, t.size, 1.0) + (channel.name == "torque_enable")
            for channel in cls.inputs
        }
        runs.append(
            Scenario(t, {name: value + 0.3 * k for name, value in cls.states.items()}, command)
        )
    scenarios = [runs[k % 5] for k in range(40)]
    together = simulator.simulate_batch(theta, scenarios)
    for lane in [*range(0, 40, 4), 20, 21, 22, 23, 24]:
        alone = simulator.simulate(theta[lane : lane + 1], scenarios[lane])[0]
        assert alone.tobytes() == np.ascontiguousarray(together[lane, : len(alone)]).tobytes(), lane
        assert np.isnan(together[lane, len(alone) :]).all()
    bare = cls(engine="batch")
    for lane in range(20, 25):  # all coefficients are zero: equal to the system without effects
        expected = bare.simulate(theta[lane : lane + 1, : len(cls.parameters)], scenarios[lane])[0]
        assert expected.tobytes() == np.ascontiguousarray(together[lane, : len(expected)]).tobytes()


def test_steps_of_no_length_change_nothing():
    motion = slid([[0.5, 0.8], [0.0, 0.0]], 0.2, np.full(20, 0.02))
    waiting = slid([[0.5, 0.8], [0.0, 0.0]], 0.2, np.tile([0.0, 0.02, 0.0], 20), every=3)
    for a, b in zip((motion.x, motion.v, motion.a), (waiting.x, waiting.v, waiting.a), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("system", "value", "effects"),
    [
        ("ball", 0.7, {"drag.quadratic": [0.1], "contact.friction": [0.05]}),
        ("pendulum", 4e-3, {"friction.coulomb": [0.01]}),
    ],
)
def test_finite_differences_are_smooth_through_events(system, value, effects):
    cls, t = SIMULATORS[system], np.arange(81) / 40
    initial = {"z": 2.0, "vx": 3.0, "vz": 0.5} if system == "ball" else {"q": 1.0, "qd": 0.0}
    scenario = Scenario(
        t,
        {**cls.states, "x": 0.0, **initial} if system == "ball" else initial,
        {} if system == "ball" else {"u": 0 * t},
    )
    constants = {c.name: c.value for c in cls.constants}

    def slopes(solve, share):
        low, high = (
            solve(TrueSystem(system, {cls.parameters[0].name: v}, constants, effects), scenario)
            for v in (value * (1 - share), value * (1 + share))
        )
        return (high - low) / (2 * share * value)

    expected = slopes(simulate_reference, 1e-4)
    away = np.ones(t.size, dtype=bool)
    if system == "ball":  # The slope jumps at an impact; samples near one are not compared.
        z = Ball(observe=["z"], engine="batch", fixed=effects, time_step=1e-3).simulate(
            np.array([[value]]), Scenario(np.arange(8001) / 4000, scenario.initial)
        )[0, :, 0]
        lows = np.flatnonzero((z[1:-1] <= z[:-2]) & (z[1:-1] < z[2:])) + 1
        away = np.abs(t[:, None] - lows / 4000).min(axis=1) > 0.02
    scale = np.abs(expected).max(axis=0) + 1e-12
    for share in (1e-3, 1e-5, 1e-7):
        found = slopes(simulate, share)
        assert (np.abs(found - expected)[away] < 1e-3 * scale).all(), share


def test_a_ball_in_closed_form_and_a_stepped_one_differ_by_rounding():
    ball = Ball(engine="batch", effects=["drag.quadratic"])
    theta = np.array([[e, c] for e in (0.3, 0.6, 0.9) for c in (0.0, 1e-7, 1e-4)])
    seen = ball.simulate(theta, Scenario(T, {"z": 3.0, "vx": 2.0}))[:, :, [0, 2]].reshape(3, 3, -1)
    small, large = (seen[:, 1] - seen[:, 0]) / 1e-7, (seen[:, 2] - seen[:, 0]) / 1e-4
    assert np.abs(large).max() > 1.0
    assert np.abs(small - large).max() < 5e-3 * np.abs(large).max()


def test_only_an_element_that_overflows_is_nan():
    slider = Slider(engine="batch", effects=["spring.cubic"])
    theta = np.array([[1.0, 2.0], [0.1, -5e4], [1.0, 2.0]])
    scenario = Scenario(T[:41], {"x": 1.0})
    seen = slider.simulate(theta, scenario)
    assert np.isnan(seen[1]).all()
    assert np.isfinite(seen[[0, 2]]).all()
    assert np.array_equal(seen[0], slider.simulate(theta[:1], scenario)[0])


def test_stiff_servo_stays_stable_at_the_corner_of_its_bounds():
    theta = np.array([[3.0, 0.5, 1e-4]])
    t = T[:61]
    inputs = {"goal": np.where(t < 0.3, 1.0, -1.0), "torque_enable": np.ones(t.size)}
    scenario = Scenario(t, {}, inputs)
    coarse = Servo(engine="batch").simulate(theta, scenario)
    fine = Servo(engine="batch", time_step=1e-3).simulate(theta, scenario)
    np.testing.assert_allclose(coarse, fine, atol=2e-5)


def test_one_sample_and_no_elements():
    pendulum = Pendulum(engine="batch")
    assert pendulum.simulate(
        np.array([[3e-3]]), Scenario(np.array([1.0]), {"q": 0.2})
    ).tolist() == [[[0.2, 0.0]]]
    assert pendulum.simulate(np.empty((0, 1)), Scenario(T)).shape[0] == 0


@pytest.mark.parametrize(
    ("settings", "message"), [({"time_step": 0.0}, "time_step"), ({"stepsize": 1.0}, "stepsize")]
)
def test_refuses_settings_it_cannot_use(settings, message):
    with pytest.raises(InputError, match=message):
        Ball(engine="batch", **settings)


def test_only_an_element_that_needs_too_many_steps_is_abandoned():
    times = np.arange(201) / 100.0
    kinds = {"drag.linear": 0.1, "friction.stribeck": (0.02, 4.0, 0.02)}
    whole = Slider(engine="batch", effects=list(kinds), time_step=0.01)
    hasty = Slider(engine="batch", effects=list(kinds), time_step=0.01, patience=1.5)
    scenario = Scenario(times, {"x": 0.0, "v": 0.0}, {"u": 6.0 * np.sin(40.0 * times)})
    theta = np.array(
        [[1.0, 0.1, 0.0, 0.0, 0.02], [1.0, 0.0, 0.02, 4.0, 0.02], [1.3, 0.2, 0.0, 0.0, 0.02]]
    )
    expected, found = whole.simulate(theta, scenario), hasty.simulate(theta, scenario)
    assert np.isfinite(expected).all()
    np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])
    assert np.isnan(found[1]).any(), (
        "reversals forty times a second, in a friction that falls within 0.02 m/s"
    )
    np.testing.assert_array_equal(hasty.simulate(theta[1:2], scenario), found[1:2])
    patient = Slider(engine="batch", effects=list(kinds), time_step=0.01, patience=50.0)
    np.testing.assert_array_equal(patient.simulate(theta, scenario), expected)


@pytest.mark.parametrize("kind", [Slider, Pendulum])
def test_a_force_that_jumps_at_rest_is_no_fast_decay(kind):
    """With a drive with weak braking, a run stays below four times the planned number of steps."""
    times = np.arange(60) / 50
    run = Scenario(times, {}, {"u": 0.05 * np.sign(np.sin(7 * times + 0.2))})
    theta = [1.0] if kind is Slider else [0.003]
    hasty, patient = (
        kind(engine="batch", fixed={"supply.braking": 0.5}, patience=p) for p in (4.0, np.inf)
    )
    seen, wanted = (simulator.simulate(np.array([theta]), run)[0] for simulator in (hasty, patient))
    np.testing.assert_array_equal(seen, wanted)


@pytest.mark.parametrize(
    ("simple", "rich"), [("friction.coulomb", "friction.stribeck"), ("drag.quadratic", "wind")]
)
def test_an_effect_becomes_the_one_it_contains(simple, rich):
    effect = library.get_effect(rich)
    assert effect.contains == (simple,)
    scenario = Scenario(
        np.arange(101) / 50.0, {"x": 0.0, "v": 2.0}, {"u": np.sin(np.arange(101) / 9.0)}
    )
    one, other = (Slider(engine="batch", effects=[name]) for name in (simple, rich))
    theta = np.zeros((1, len(other.parameters)))
    theta[0, :2] = 1.0, 0.4
    if rich == "friction.stribeck":
        theta[0, -1] = 0.1
    np.testing.assert_allclose(
        other.simulate(theta, scenario), one.simulate(np.array([[1.0, 0.4]]), scenario), atol=1e-9
    )
