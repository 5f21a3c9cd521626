"""Tests of effect forces compiled to one program: numbers equal numpy's, or numpy is used."""

import ctypes

import numpy as np
import pytest

from bench.core.plugin_registries import make_robot_simulator
from sims import effects as library
from sims.core.effect import Coefficient, Force
from sims.core.simulator import Scenario
from sims.engines.compiled.register_programs import TracedPrograms
from sims.robot.dynamics import mujoco_batch, stepping_with_forces
from sims.robot.dynamics.active_effects import is_evaluated_per_step
from sims.robot.places.placed_effect_classes import make_placed_effect
from tests.sims.robot.sample_arms import ARM

TIMES = np.arange(60) / 100.0
SCENARIO = Scenario(
    TIMES,
    {"q.elbow": 0.4, "qd.shoulder": 0.5},
    {
        "u.m_shoulder": 0.3 * np.sin(7.0 * TIMES),
        "u.m_elbow": np.sin(9.0 * TIMES),
        "u.m_spin": np.cos(5.0 * TIMES),
    },
)


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return make_robot_simulator(tmp_path / "arm.xml")


def list_step_effects(kind):
    """Return every effect of the library that is evaluated per step, at each place that has it."""
    placed = (
        one for name in library.list_names() for one in kind.system.placed(library.get_effect(name))
    )
    found = [effect() for effect in placed]
    return [e for e in found if is_evaluated_per_step(e) and e.place != "*"]


def by_numpy(monkeypatch):
    monkeypatch.setattr(TracedPrograms, "find", lambda *_: None)


def record_results(monkeypatch, owner, name):
    """Return a list to which each call of a function adds its result."""
    results, once = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *a: results.append(once(*a)) or results[-1])
    return results


def test_every_effect_moves_the_robot_as_it_does_without_the_compiler(arm, monkeypatch, capsys):
    effects = list_step_effects(arm)
    assert len(effects) > 25
    families = {effect.name for effect in effects}
    made = arm(effects=[type(effect) for effect in effects])
    size = len(made.parameters)
    theta = np.zeros((len(effects) + 1, size))
    column = 0
    for lane, effect in enumerate(effects):
        for c in effect.coefficients:
            low, high = c.plausible[0]
            theta[lane, column] = (low * high) ** 0.5 if low > 0 else 0.3 * high
            column += 1
    assert column == size
    programs = record_results(monkeypatch, TracedPrograms, "find")
    quick = made.simulate(theta, SCENARIO)
    assert programs
    assert all(programs), "none was left to numpy"
    assert capsys.readouterr().err == ""
    by_numpy(monkeypatch)
    slow = made.simulate(theta, SCENARIO)
    np.testing.assert_allclose(quick, slow, rtol=1e-9, atol=1e-11)
    moved = np.abs(quick[:-1] - quick[-1]).max(axis=(1, 2)) > 1e-9
    still = {effect.name for effect, there in zip(effects, moved, strict=True) if not there}
    assert moved.mean() > 0.8, f"{still} of {families} change nothing"


class Plain(Force):
    """An effect at a joint, as a plugin would define it."""

    name, noun, says = "plain", "plain push", "it pushes"
    at, needs, source = "joint", "", "none"
    coefficients = (Coefficient("coefficient", ("N", "N", "N*m"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        return c[0] * np.cos(moment.x)


class Branching(Plain):
    """An effect that branches on numbers, which cannot be traced."""

    name = "branching"

    def force(self, c, moment):
        return c[0] * (moment.x if (np.asarray(moment.v) > 0).any() else -moment.x)


class Declared(Branching):
    """An effect that declares that it cannot be traced, which is not reported."""

    name = "declared"
    is_traceable = False


class Changing(Plain):
    """An effect whose values change with each call, so that its trace cannot be trusted."""

    name = "changing"
    evaluations = 0

    def force(self, c, moment):
        type(self).evaluations += 1
        return c[0] * float(self.evaluations) * np.ones_like(moment.x)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (Plain, ""),
        (Branching, "converts its arguments to a new array"),
        (Changing, "other numbers"),
        (Declared, ""),
    ],
)
def test_untraceable_effects_are_reported_once_and_evaluated_by_numpy(
    arm, effect, message, capsys, monkeypatch
):
    elbow = next(spot for spot in arm.system.places["joint"] if spot.name == "elbow")
    made = arm(effects=[make_placed_effect(effect, elbow)])
    theta = np.array([[0.2], [0.0]])
    first = made.simulate(theta, SCENARIO)
    if effect is not Changing:
        by_numpy(monkeypatch)
        np.testing.assert_allclose(made.simulate(theta, SCENARIO), first, rtol=1e-9, atol=1e-11)
    assert np.abs(first[0] - first[1]).max() > 1e-4
    made.simulate(theta, SCENARIO)
    told = capsys.readouterr().err
    assert told.count("\n") == (1 if message else 0)
    assert message in told
    assert (
        not message
        or f"effect {effect.name}@elbow cannot be compiled, and NumPy evaluates it" in told
    )


def test_an_effect_alone_and_the_same_one_in_its_family_act_side_by_side(arm, monkeypatch):
    alone, family = (arm.system.effect(f"friction.load@{place}") for place in ("elbow", "*"))
    made = arm(effects=[alone, family])
    size = len(made.parameters)
    theta = np.diag([0.3] * size)
    quick = made.simulate(theta, SCENARIO)
    by_numpy(monkeypatch)
    np.testing.assert_allclose(quick, made.simulate(theta, SCENARIO), rtol=1e-9, atol=1e-11)
    lane = [p.name for p in made.parameters].index("friction.load@*.coefficient@elbow")
    np.testing.assert_array_equal(quick[0], quick[lane])


def test_a_sensor_of_the_drives_shows_what_one_battery_leaves_to_each(arm):
    battery = arm.system.effect("supply.sag")
    made = arm(effects=[battery], observe=["q.shoulder", "tau.shoulder", "tau.elbow"])
    inputs = {"u.m_shoulder": np.full(60, 0.05), "u.m_elbow": np.ones(60)}
    shown = made.simulate(np.array([[0.3], [0.0]]), Scenario(TIMES, {}, inputs))[:, 0, 1:]
    np.testing.assert_allclose(shown[1], [60 * 0.05, 2.0])
    np.testing.assert_allclose(shown[0], np.array([3.0, 2.0]) / (1 + 0.3 * 5.0))


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
def test_steps_in_the_callback_equal_steps_with_forces(arm, tmp_path, monkeypatch, integrator):
    """MuJoCo's callback gives the same bits as forces that are set before each step.

    Calls of MuJoCo are cut in the middle of the runs, and friction acts at two joints at once.
    """
    monkeypatch.setattr(mujoco_batch, "MAX_UNINTERRUPTED_STEPS", 70)
    kind = arm.with_integrator_settings(arm.numerics._replace(integrator=integrator))
    system = kind.system
    names = [
        *("friction.direction@elbow", "friction.stribeck@elbow", "friction.position@shoulder"),
        *("friction.hysteresis@spin", "force.ripple@spin", "servo.deadband@m_shoulder"),
    ]
    made = kind(effects=[system.effect(name) for name in names])
    theta = np.array([[np.mean(p.bounds) for p in made.parameters], [0.0] * len(made.parameters)])
    theta = np.concatenate([theta, 0.5 * theta[:1]])
    results = record_results(monkeypatch, stepping_with_forces, "find_callback")
    quick = made.simulate(theta, SCENARIO)
    assert [result is not None for result in results] == [True]
    monkeypatch.setattr(stepping_with_forces, "find_callback", lambda *_: None)
    slow = made.simulate(theta, SCENARIO)
    assert np.abs(slow[0] - slow[1]).max() > 0.01
    np.testing.assert_array_equal(quick, slow)


def test_forces_that_depend_on_loads_are_not_computed_in_the_callback(arm, monkeypatch):
    made = arm(effects=[arm.system.effect("friction.load@elbow")])
    results = record_results(monkeypatch, stepping_with_forces, "find_callback")
    made.simulate(np.array([[0.3]]), SCENARIO)
    assert results == [None]


def test_the_callback_does_not_replace_that_of_the_user(arm):
    import mujoco

    made = arm(effects=[arm.system.effect("friction.direction@elbow")])
    theta = np.array([[np.mean(p.bounds) for p in made.parameters]])
    first = made.simulate(theta, SCENARIO)
    callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(lambda *_: None)
    mujoco.set_mjcb_control(callback)
    try:
        again = made.simulate(theta, SCENARIO)
        assert mujoco.get_mjcb_control() is not None
    finally:
        mujoco.set_mjcb_control(None)
    np.testing.assert_array_equal(again, first)
