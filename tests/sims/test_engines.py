"""Tests of all engines: agreement by system and by effect, and bit-identical results whatever ran
before.
"""

import copy
import functools
import hashlib
import pickle
import subprocess
import sys

import numpy as np
import pytest

from sims import effects
from sims.core.effect import Coefficient, Force, Friction
from sims.core.mujoco_import import import_mujoco
from sims.core.simulator import InputError, Scenario
from sims.engines.external import bullet_world
from sims.engines.time_grid import equalise_steps
from tests.sims.engine_agreement import (
    COEFFICIENTS,
    OTHERS,
    SIMULATORS,
    STEPS,
    THETA,
    carried,
    coefficients,
    compute_max_difference,
    has,
    motion,
    scenario,
)

# Maximum distance from the batch engine in metres or radians with any one effect of the library, at
# the default step.
TOLERANCE = {"ball": 1.5e-4, "pendulum": 1e-3, "slider": 5e-6, "servo": 1.6e-4}
# A lag follows the reading from step to step and smooths the ball's bounces, where the difference
# between steps of 1/120 s is visible.
LAGGED = {"ball": 5e-3}
# A force that jumps where the motion reverses acts late by the rest of the step.
JUMPING = {"pendulum": 2e-3, "servo": 4e-4}
LOOSER = {"sensor.lag": LAGGED, "supply.braking": JUMPING}

CASES = [
    (system, effect)
    for effect in COEFFICIENTS
    for system in SIMULATORS
    if has(system, effect) and carried(effect)
]
BUILDS = [(system, engine, {}) for system in SIMULATORS for engine in OTHERS]
BUILDS += [("ball", engine, {"native_contact": True}) for engine in OTHERS]


def order(steps, errors):
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


@functools.cache
def plain(system, **settings):
    """Return the motion without effects on the batch engine."""
    return motion(system, "batch", **settings)


def theta_for(kind, count=1, seed=0):
    low, high = np.array([p.bounds for p in kind.parameters]).T
    return np.random.default_rng(seed).uniform(low, high, size=(count, len(low)))


# ---------------------------------------------------------------------- agreement


def test_every_effect_of_the_library_is_measured():
    # Effects on numbers of a model file belong to MuJoCo and are tested with robots; levels need a
    # simulator that steps itself.
    own = ("model", "level")
    general = {name for name in effects.list_names() if effects.get_effect(name).needs not in own}
    assert set(COEFFICIENTS) == general


@pytest.mark.parametrize("engine", OTHERS)
@pytest.mark.parametrize("system", ["ball", "slider"])
def test_without_effects_what_is_uniform_is_exact_at_any_step(system, engine):
    exact = plain(system)
    for step in STEPS[system]:
        assert compute_max_difference(motion(system, engine, time_step=step), exact) < 1e-11


@pytest.mark.parametrize("system", ["pendulum", "servo"])
def test_without_effects_engines_converge_in_second_order(system):
    exact = motion(system, "batch", time_step=1e-3)
    errors = {
        e: [compute_max_difference(motion(system, e, time_step=h), exact) for h in STEPS[system]]
        for e in OTHERS
    }
    for found in errors.values():
        assert order(STEPS[system], found) == pytest.approx(2.0, abs=0.05)
        assert found[-1] < 7e-5
    np.testing.assert_allclose(errors["pybullet"], errors["mujoco"], rtol=1e-5)


@pytest.mark.parametrize(("system", "effect"), CASES)
def test_engines_agree_with_each_effect(system, effect):
    fixed = {effect: coefficients(system, effect)}
    # The result of a lag, and its slope, depends on the step size on every engine.
    slow = effect.endswith((".lag", ".hold"))
    # A jump of the set point gives a pulse of 2 ms that the servo's limit cuts off.
    fine = {"time_step": 2e-3} if effect == "servo.derivative" else {}
    exact = motion(system, "batch", fixed, **({"time_step": 1e-3} if slow or fine else {}))
    tolerance = LOOSER.get(effect, {}).get(system, TOLERANCE[system])
    assert compute_max_difference(exact, plain(system)) > 20 * tolerance
    bullet, mujoco = (motion(system, engine, fixed, **fine) for engine in OTHERS)
    assert compute_max_difference(bullet, exact) < tolerance
    assert compute_max_difference(mujoco, exact) < tolerance
    assert compute_max_difference(bullet, mujoco) < 1e-8


@pytest.mark.parametrize(
    ("system", "fixed"),
    [
        ("ball", {"drag.quadratic": 0.05, "restitution.speed": -0.1, "contact.friction": 0.1}),
        (
            "ball",
            {
                "wind": [0.05, 3.0, -2.0],
                "lift.magnus": [0.3, 0.1],
                "force.periodic": [1.0, 0.5, 1.3],
            },
        ),
        ("pendulum", {"drag.quadratic": 3e-4, "friction.coulomb": 0.015}),
        (
            "pendulum",
            {"friction.stribeck": [0.01, 0.01, 0.5], "spring.cubic": 0.05, "gravity.tilt": 0.05},
        ),
        ("slider", {"drag.quadratic": 0.5, "friction.coulomb": 0.7, "force.bias": 0.2}),
        (
            "slider",
            {
                "spring.linear": 30.0,
                "friction.stribeck": [0.4, 0.4, 0.1],
                "force.periodic": [0.5, 0.3, 1.3],
            },
        ),
        ("servo", {"friction.load": 0.1, "drag.linear": 0.01, "force.ripple": [0.02, 0.01, 0.5]}),
    ],
)
def test_with_effects_engines_converge_too(system, fixed):
    exact = motion(system, "batch", fixed, time_step=1e-3)
    for engine in OTHERS:
        errors = np.array(
            [
                compute_max_difference(motion(system, engine, fixed, time_step=h), exact)
                for h in STEPS[system]
            ]
        )
        assert order(STEPS[system], errors) > 1.7
        assert errors[-1] < 0.1 * errors[0]


def test_the_servo_is_stable_over_all_its_bounds():
    # Stiffest corner: back EMF with a time constant of 0.28 ms, at steps of 2.5 ms.
    servo = SIMULATORS["servo"]
    corners = np.array(np.meshgrid(*[p.bounds for p in servo.parameters])).reshape(3, -1).T
    fine, *others = (
        servo(engine=e).simulate(corners, scenario("servo"))[:, :, 0] for e in ("batch", *OTHERS)
    )
    for found in others:
        assert np.abs(found - fine).max() < 0.02


# ---------------------------------------------------------------------- dry friction


@pytest.mark.parametrize("engine", OTHERS)
@pytest.mark.parametrize(
    "friction", [{"friction.coulomb": 1.0}, {"friction.stribeck": [0.6, 0.4, 0.1]}]
)
def test_a_sticking_body_breaks_away_at_the_friction_limit(engine, friction):
    t = np.arange(400) / 100
    slider = SIMULATORS["slider"](engine=engine, fixed=friction)

    def slide(force):
        return slider.simulate(
            np.array([[2.0]]), Scenario(t, {"x": 0.3}, {"u": np.full(400, force)})
        )[0]

    np.testing.assert_allclose(slide(0.999), np.tile([0.3, 0.0], (400, 1)), atol=1e-15)
    assert slide(1.01)[-1, 0] > 0.3 + 0.03


@pytest.mark.parametrize("engine", OTHERS)
@pytest.mark.parametrize("step", [2.5e-3, 0.1])
def test_sliding_to_a_stop_takes_the_closed_distance(engine, step):
    slider = SIMULATORS["slider"](engine=engine, fixed={"friction.coulomb": 1.0}, time_step=step)
    x, v = slider.simulate(np.array([[2.0]]), Scenario(np.arange(40) / 10, {"v": 1.03}))[0].T
    t = np.minimum(np.arange(40) / 10, 2.06)
    np.testing.assert_allclose(v, 1.03 - 0.5 * t, atol=1e-12)
    np.testing.assert_allclose(x, 1.03 * t - 0.25 * t**2, atol=0.125 * 0.5 * step**2 + 1e-12)


# ---------------------------------------------------------------------- third-party effects


class Stop(Force):
    """A stiff spring beyond a position, without velocity dependence."""

    name, says = "test.stop", "there is a stop"
    coefficients = (Coefficient("stiffness", (None, "N/m", None), ((0, 1), (0, 1000), (0, 1))),)

    def force(self, c, moment):
        return -c[0] * np.maximum(moment.x - 0.2, 0.0)


class Rising(Friction):
    """Friction that grows with the distance."""

    name, says = "test.rising", "it is rougher further out"
    coefficients = (Coefficient("rate", (None, "N/m", None), ((0, 1), (0, 10), (0, 1))),)

    def limit(self, c, moment):
        return np.maximum(c[0] * moment.x, 0.0)


@pytest.mark.parametrize("engine", OTHERS)
def test_any_effect_runs_on_any_engine(engine, fresh_registries):
    effects.register_effect(Stop)
    effects.register_effect(Rising)
    fixed = {"test.stop": 200.0, "test.rising": 1.5}
    exact = motion("slider", "batch", fixed, time_step=5e-4)
    errors = [
        compute_max_difference(motion("slider", engine, fixed, time_step=h), exact)
        for h in STEPS["slider"]
    ]
    assert errors[-1] < 1e-6
    assert order(STEPS["slider"], errors) > 1.4  # the force of the stop has a kink


# ------------------------------------------------------------------ batches, worlds, bits


@pytest.mark.parametrize(("system", "engine", "settings"), BUILDS)
def test_elements_do_not_depend_on_their_neighbours(system, engine, settings):
    kind = SIMULATORS[system]
    simulator, run, theta = (
        kind(engine=engine, **settings),
        Scenario(np.arange(150) / 50),
        theta_for(kind, 6),
    )
    together = simulator.simulate(theta, run)
    assert together.shape == (6, 150, len(simulator.channels))
    apart_ = np.concatenate([simulator.simulate(row[None], run) for row in theta[::-1]])[::-1]
    np.testing.assert_array_equal(together, apart_)


@pytest.mark.parametrize(("system", "engine", "settings"), BUILDS)
def test_elements_of_different_runs_come_out_as_alone(system, engine, settings):
    kind = SIMULATORS[system]
    simulator, theta = kind(engine=engine, **settings), theta_for(kind, 3)
    runs = [Scenario(np.arange(n) * dt) for n, dt in ((60, 0.02), (40, 0.013), (1, 1.0))]
    together = simulator.simulate_batch(theta, runs)
    for row, run, found in zip(theta, runs, together, strict=True):
        n = run.times.size
        assert np.isnan(found[n:]).all()
        if (
            not settings
        ):  # otherwise the step, set by the longest interval of the batch, changes the result
            np.testing.assert_allclose(found[:n], simulator.simulate(row[None], run)[0], atol=2e-3)


@pytest.mark.parametrize(("system", "engine", "settings"), BUILDS)
@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_non_finite_parameters_give_nan_elements(system, engine, settings, broken):
    kind = SIMULATORS[system]
    simulator, run, theta = (
        kind(engine=engine, **settings),
        Scenario(np.arange(30) / 50),
        theta_for(kind, 3),
    )
    healthy = kind(engine=engine, **settings).simulate(theta, run)
    theta[1, -1] = broken
    result = simulator.simulate(theta, run)
    assert np.isnan(result[1]).all()
    np.testing.assert_array_equal(result[::2], healthy[::2])


@pytest.mark.parametrize(("system", "engine", "settings"), BUILDS)
def test_a_numerical_failure_gives_nan_in_that_element_only(system, engine, settings):
    kind = SIMULATORS[system]
    simulator, theta = (
        kind(engine=engine, effects=["drag.quadratic"], **settings),
        theta_for(kind, 2),
    )
    theta = np.concatenate([theta, [[0.0], [1e-3]]], axis=1)
    rate = {"ball": "vz", "slider": "v"}.get(system, "qd")
    wild, calm = Scenario(np.arange(30) / 50, {rate: 1e300}), Scenario(np.arange(200) / 50)
    with np.errstate(all="ignore"):
        assert np.isnan(simulator.simulate(theta[1:], wild)).all()
    fresh = kind(engine=engine, effects=["drag.quadratic"], **settings)
    np.testing.assert_array_equal(simulator.simulate(theta, calm), fresh.simulate(theta, calm))


@pytest.mark.parametrize("engine", OTHERS)
@pytest.mark.parametrize(
    ("system", "theta"),
    [
        ("slider", [0.0]),
        ("slider", [-1.0]),
        ("servo", [0.5, 4.0, -1.0]),
        ("pendulum", [0.0]),
    ],
)
def test_impossible_inertia_gives_nan(system, engine, theta):
    simulator = SIMULATORS[system](engine=engine)
    result = simulator.simulate(np.array([theta, THETA[system]]), scenario(system))
    assert np.isnan(result[0]).all()
    assert np.isfinite(result[1]).all()


@pytest.mark.parametrize(("system", "engine", "settings"), BUILDS)
@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))], ids=["copy", "pickle"]
)
def test_a_copy_has_a_world_of_its_own(system, engine, settings, copied):
    kind = SIMULATORS[system]
    simulator, run, theta = (
        kind(engine=engine, **settings),
        Scenario(np.arange(50) / 50),
        theta_for(kind),
    )
    first = simulator.simulate(theta, run)
    twin = copied(simulator)
    np.testing.assert_array_equal(twin.simulate(theta, run), first)
    simulator.close()
    np.testing.assert_array_equal(twin.simulate(theta, run), first)


IMPORTS = {"pybullet": bullet_world.import_pybullet, "mujoco": import_mujoco}
STEPPERS = {"pybullet": "stepSimulation", "mujoco": "mj_step"}
"""Function of each engine's library that makes a step."""


@pytest.mark.parametrize(("system", "engine", "settings"), BUILDS)
def test_an_interrupted_rollout_leaves_nothing_behind(system, engine, settings, monkeypatch):
    kind, library, calls = SIMULATORS[system], IMPORTS[engine](), []
    make_step = getattr(library, STEPPERS[engine])

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) > 20:
            raise KeyboardInterrupt
        make_step(*arguments)

    # An effect makes MuJoCo step in Python.
    simulator, fresh = (
        kind(engine=engine, fixed={"drag.linear": 0.01}, **settings) for _ in range(2)
    )
    theta, run = theta_for(kind), scenario(system)
    with monkeypatch.context() as patch:
        patch.setattr(library, STEPPERS[engine], interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulator.simulate(theta, run)
    np.testing.assert_array_equal(simulator.simulate(theta, run), fresh.simulate(theta, run))


FINGERPRINT = """
import hashlib
from tests.sims.engine_agreement import SIMULATORS, THETA, scenario
import numpy as np
for system, kind in SIMULATORS.items():
    for engine in ("pybullet", "mujoco"):
        for fixed in ({}, {"drag.quadratic": 1e-3}):
            theta = np.array([THETA[system]])
            found = kind(engine=engine, fixed=fixed).simulate(theta, scenario(system))
            print(hashlib.sha256(found.tobytes()).hexdigest())
"""


def test_a_fresh_process_gives_the_same_bits():
    here = []
    for system, kind in SIMULATORS.items():
        for engine in OTHERS:
            for fixed in ({}, {"drag.quadratic": 1e-3}):
                simulator = kind(engine=engine, fixed=fixed)
                simulator.simulate(theta_for(kind, 2), Scenario(np.arange(30) / 50))
                found = simulator.simulate(np.array([THETA[system]]), scenario(system))
                here.append(hashlib.sha256(found.tobytes()).hexdigest())
    found = subprocess.run(
        [sys.executable, "-c", FINGERPRINT], capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == here


# ---------------------------------------------------------------------- steps and settings


@pytest.mark.parametrize("engine", OTHERS)
def test_rounded_time_stamps_are_forgiven(engine):
    exact, rounded = np.arange(400) / 60, np.round(np.arange(400) / 60, 8)
    assert len(set(equalise_steps(np.diff(rounded), 1).tolist())) == 1
    assert set(equalise_steps(np.diff(exact), 1).tolist()) == {exact[-1] / 399}
    uneven = np.array([0.1, 0.1, 0.2])
    np.testing.assert_array_equal(equalise_steps(uneven, 1), uneven)
    assert equalise_steps(np.empty(0), 1).size == 0
    kind, theta = SIMULATORS["pendulum"], np.array([THETA["pendulum"]])
    found = [kind(engine=engine).simulate(theta, Scenario(t)) for t in (exact, rounded)]
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


@pytest.mark.parametrize("engine", OTHERS)
def test_a_system_without_a_world_module_is_refused_only_if_it_bounces(engine):
    from sims.system_simulator import SystemSimulator
    from sims.systems.ball import BallSystem
    from sims.systems.slider import SliderSystem

    class Elsewhere(BallSystem):
        __module__ = "a_plugin_file"
        name = "elsewhere"

    class Ours(SystemSimulator):
        system = Elsewhere

    with pytest.raises(
        InputError,
        match=f"engine {engine} cannot simulate system elsewhere: no module .*_world next to a_",
    ):
        Ours(engine=engine)

    class Guided(SystemSimulator):
        system = type("GuidedSystem", (SliderSystem,), {"__module__": "a_plugin_file"})

    theta, run = np.array([[2.0]]), Scenario(np.arange(50) / 50, {"v": 1.0})
    expected = SIMULATORS["slider"](engine="batch").simulate(theta, run)
    np.testing.assert_allclose(Guided(engine=engine).simulate(theta, run), expected, atol=1e-9)

    class Planar(SystemSimulator):
        system = type("PlanarSystem", (SliderSystem,), {"coordinates": ("x", "y")})

    with pytest.raises(InputError, match="it has 2 coordinates, expected one"):
        Planar(engine=engine)
    with pytest.raises(InputError, match="system slider does not bounce: leave native_contact out"):
        SIMULATORS["slider"](engine=engine, native_contact=True)
