"""Tests that batch elements integrated together, also next to failed ones, give the same bits as
one by one.
"""

import numpy as np
import pytest

from sims import effects
from sims.core.simulator import InputError, Scenario
from sims.core.system import Coefficient, Force
from sims.engines.adapters import bullet_joints, mujoco_ball_batch, mujoco_joint_batch
from sims.engines.adapters import bullet_world as bullet
from sims.engines.adapters.mujoco_bodies import CompiledWorld
from sims.engines.external import batch_grouping, joint_batch
from sims.engines.external.external_forces import (
    integrate_velocity,
    integrate_velocity_batch,
    subtract_dry_friction,
    subtract_dry_friction_batch,
)
from sims.systems import ball_mujoco_world as mujoco_world_of_balls
from sims.systems import pendulum_bullet_world, pendulum_mujoco_world
from tests.sims.engine_agreement import OTHERS, SIMULATORS, THETA

pytest.importorskip("mujoco.batch")

EFFECTS = {
    "none": {},
    "damping": {"drag.linear": 2e-3},
    "known": {"drag.quadratic": 3e-4, "friction.coulomb": 0.015, "drag.linear": 1e-3},
    "asked": {"force.bias": 0.02, "friction.stribeck": [0.01, 0.01, 0.5], "spring.linear": 0.1},
    "input": {"input.delay": 0.017, "friction.load": 0.05},
}
ALWAYS = dict.fromkeys(mujoco_joint_batch.MIN_BATCH_SIZE, 1)
NEVER = dict.fromkeys(mujoco_joint_batch.MIN_BATCH_SIZE, 10**9)


@pytest.fixture
def split(monkeypatch):
    """Return a function that sets the minimum number of elements integrated together."""

    def choose(fewest):
        for engine in (mujoco_joint_batch, mujoco_ball_batch, bullet_joints):
            for kind, count in fewest.items():
                monkeypatch.setitem(engine.MIN_BATCH_SIZE, kind, count)

    return choose


def signals(kind, count, seed):
    """Return inputs of which the first changes every fifth sample."""
    rng = np.random.default_rng(seed)
    held = np.repeat(rng.uniform(-1.0, 1.0, count), 5)[:count]
    return {c.name: held if place == 0 else np.ones(count) for place, c in enumerate(kind.inputs)}


def runs(kind):
    """Return runs of three lengths: even samples, longer steps, uneven samples."""
    position, velocity = list(kind.states)[:2]
    uneven = np.cumsum(np.where(np.arange(24) % 7, 0.01, 0.013))
    times = (np.arange(40) / 100, np.arange(30) / 90, uneven)
    return [
        Scenario(t, {position: 0.3 + k, velocity: -1.0}, signals(kind, t.size, k))
        for k, t in enumerate(times)
    ]


def lanes(name, chosen, per_run=2, engine="mujoco"):
    """Return a simulator, and batch elements of which only some have each effect."""
    kind = SIMULATORS[name]
    simulator = kind(engine=engine, effects=list(chosen))
    values = np.concatenate([np.ravel(c) for c in chosen.values()] or [[]])
    wanted = len(simulator.parameters) - len(THETA[name])
    rng = np.random.default_rng(len(chosen))
    scale = rng.uniform(0.7, 1.3, (3 * per_run, 1))
    on = rng.random((3 * per_run, wanted)) < 0.7
    theta = np.hstack([np.array(THETA[name]) * scale, values[:wanted] * scale * on])
    return simulator, theta, runs(kind) * per_run


@pytest.mark.parametrize("engine", OTHERS)
@pytest.mark.parametrize("case", EFFECTS)
@pytest.mark.parametrize("name", ["pendulum", "slider", "servo"])
def test_together_is_one_by_one_to_the_bit(name, case, engine, split):
    simulator, theta, scenarios = lanes(name, EFFECTS[case], engine=engine)
    split(NEVER)
    alone = simulator.simulate_batch(theta, scenarios)
    split(ALWAYS)
    assert np.isfinite(alone[:, 0]).all()
    for _ in range(2):  # newly built, then reused
        np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), alone)


@pytest.mark.parametrize("case", ["none", "known", "asked"])
def test_constants_that_differ_and_other_numbers_of_lanes(case, split):
    simulator, theta, scenarios = lanes("pendulum", EFFECTS[case])
    split(ALWAYS)
    heavy = [Scenario(s.times, s.initial, s.inputs, {"mass": 0.7}) for s in scenarios]
    mixed = [pair[k % 2] for k, pair in enumerate(zip(scenarios, heavy, strict=True))]
    found = simulator.simulate_batch(theta, mixed)
    for i in range(len(theta)):
        own = simulator.simulate_batch(theta[i : i + 1], mixed[i : i + 1])[0]
        np.testing.assert_array_equal(found[i, : len(own)], own)


@pytest.mark.parametrize("engine", OTHERS)
@pytest.mark.parametrize("case", ["none", "known", "asked"])
def test_a_lane_that_fails_is_nan_silently_and_harms_no_other(
    case, engine, split, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    simulator, theta, scenarios = lanes("pendulum", EFFECTS[case], engine=engine)
    split(ALWAYS)
    healthy = simulator.simulate_batch(theta, scenarios)
    wild, light = 1, 3
    broken = scenarios.copy()
    broken[wild] = Scenario(scenarios[wild].times, {"q": 0.3, "qd": 1e300}, scenarios[wild].inputs)
    theta = theta.copy()
    theta[light, 0] = 1e-9  # below what MuJoCo can represent
    found = simulator.simulate_batch(theta, broken)
    assert np.isnan(found[[wild, light]]).all()
    others = [0, 2, 4, 5]
    np.testing.assert_array_equal(found[others], healthy[others])
    split(NEVER)
    np.testing.assert_array_equal(found, simulator.simulate_batch(theta, broken))
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_what_mujoco_only_warns_of_is_as_alone(split):
    # Above 1e10 rad/s MuJoCo warns and continues.
    pendulum = SIMULATORS["pendulum"](engine="mujoco")
    theta = np.full((2, 1), THETA["pendulum"])
    fast = [Scenario(np.arange(5) / 100, {"qd": qd}) for qd in (1.0, 3e10)]
    split(NEVER)
    alone = pendulum.simulate_batch(theta, fast)
    assert np.isfinite(alone).all()
    split(ALWAYS)
    np.testing.assert_array_equal(pendulum.simulate_batch(theta, fast), alone)


def test_a_warning_is_forgotten(split, monkeypatch):
    pendulum = SIMULATORS["pendulum"](engine="mujoco")
    theta = np.full((2, 1), THETA["pendulum"])
    split(ALWAYS)
    wild = Scenario(np.arange(5) / 100, {"qd": 3e10})
    assert np.isfinite(pendulum.simulate(theta, wild)).all()
    monkeypatch.setattr(
        batch_grouping, "integrate_one_by_one", lambda alone, discard, lanes: iter(lanes)
    )  # disables integration one by one
    assert np.isfinite(pendulum.simulate(theta, Scenario(wild.times))).all()


class Picky(Force):
    """A force that accepts finite numbers only, like a lookup table."""

    name, says = "test.picky", "there is a table"
    coefficients = (Coefficient("size", ("m/s^2", "N", "N*m"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        assert np.isfinite(moment.x).all()
        return c[0] * np.sign(moment.x)


@pytest.mark.parametrize(("name", "rate"), [("pendulum", "qd"), ("ball", "vz")])
def test_effects_are_asked_about_numbers_alone(name, rate, split, fresh_registries):
    effects.register_effect(Picky)
    forces = {"test.picky": 0.1, "drag.quadratic": 1e-4}
    simulator = SIMULATORS[name](engine="mujoco", fixed=forces)
    split(ALWAYS)
    theta = np.full((2, 1), THETA[name])
    both = [Scenario(np.arange(20) / 100, {rate: value}) for value in (1.0, 1e300)]
    found = simulator.simulate_batch(theta, both)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize(("case", "called"), [("none", "rollout"), ("asked", "step")])
def test_an_interrupt_leaves_nothing_behind(case, called, split, monkeypatch):
    from mujoco import batch

    split(ALWAYS)
    simulator, theta, scenarios = lanes("servo" if case == "asked" else "slider", EFFECTS[case])
    expected = simulator.simulate_batch(theta, scenarios)
    real, calls = getattr(batch.Batch, called), []

    def interrupted(*arguments, **more):
        calls.append(called)
        if len(calls) > 5:
            raise KeyboardInterrupt
        return real(*arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(batch.Batch, called, interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulator.simulate_batch(theta, scenarios)
    np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), expected)


def test_a_long_stretch_is_handed_over_in_parts(split, monkeypatch):
    split(ALWAYS)
    simulator, theta, scenarios = lanes("slider", {})
    expected = simulator.simulate_batch(theta, scenarios)
    monkeypatch.setattr(mujoco_joint_batch, "_UNINTERRUPTED", 20)  # three steps of six elements
    np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), expected)
    monkeypatch.setattr(batch_grouping, "_MAX_BATCH_STEPS", 400)  # integrates the elements in parts
    np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), expected)


@pytest.mark.parametrize("case", ["none", "asked"])
def test_threads_and_a_mujoco_without_batches_change_no_bit(case, split, monkeypatch):
    split(ALWAYS)
    simulator, theta, scenarios = lanes("slider", EFFECTS[case])
    expected = simulator.simulate_batch(theta, scenarios)
    kind = SIMULATORS["slider"]
    threaded = kind(engine="mujoco", effects=list(EFFECTS[case]), threads=2)
    np.testing.assert_array_equal(threaded.simulate_batch(theta, scenarios), expected)
    monkeypatch.setattr(mujoco_joint_batch, "is_batch_available", lambda: False)
    old = kind(engine="mujoco", effects=list(EFFECTS[case]))
    np.testing.assert_array_equal(old.simulate_batch(theta, scenarios), expected)


@pytest.mark.parametrize("threads", [0, 1.5, "all", 10**6])
def test_impossible_threads(threads):
    with pytest.raises(InputError, match="threads must be a whole number from 1 to"):
        SIMULATORS["slider"](engine="mujoco", threads=threads)


def test_a_world_that_writes_what_lanes_share_is_stepped_one_by_one(split, monkeypatch):
    load, tried = pendulum_mujoco_world.load, []

    def shared(model, inertia, constants):
        model.opt.gravity[0] = -inertia
        return load(model, inertia, constants)

    monkeypatch.setattr(pendulum_mujoco_world, "load", shared)
    simulator, theta, scenarios = lanes("pendulum", {})
    split(NEVER)
    expected = simulator.simulate_batch(theta, scenarios)
    split(ALWAYS)
    real = joint_batch.JointBatchIntegrator.integrate
    monkeypatch.setattr(
        joint_batch.JointBatchIntegrator,
        "integrate",
        lambda *given: tried.append(1) or real(*given),
    )
    np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), expected)
    assert tried


def test_a_bullet_world_whose_bodies_may_meet_is_stepped_one_by_one(split, monkeypatch):
    build, built = pendulum_bullet_world.build, []

    def shaped(client, constants):
        p = bullet.import_pybullet()
        p.createMultiBody(1.0, p.createCollisionShape(p.GEOM_SPHERE, physicsClientId=client),
                          basePosition=(9.0, 9.0, 9.0), physicsClientId=client)  # fmt: skip
        built.append(client)
        return build(client, constants)

    simulator, theta, scenarios = lanes("pendulum", EFFECTS["asked"], engine="pybullet")
    split(NEVER)
    expected = simulator.simulate_batch(theta, scenarios)
    simulator.close()
    monkeypatch.setattr(pendulum_bullet_world, "build", shaped)
    crowded = SIMULATORS["pendulum"](engine="pybullet", effects=list(EFFECTS["asked"]))
    split(ALWAYS)
    np.testing.assert_array_equal(crowded.simulate_batch(theta, scenarios), expected)
    assert len(built) == 1 + 3  # one world for single elements, and one attempt for each run
    crowded.close()


def test_all_that_a_world_writes_reaches_its_lane(split, monkeypatch):
    load = pendulum_mujoco_world.load

    def more(model, inertia, constants):
        model.jnt_stiffness[0] = 30.0 * inertia
        model.qpos_spring[0] = 0.1 if inertia > THETA["pendulum"][0] else 0.0
        return load(model, inertia, constants)

    monkeypatch.setattr(pendulum_mujoco_world, "load", more)
    simulator, theta, scenarios = lanes("pendulum", EFFECTS["known"])
    split(NEVER)
    expected = simulator.simulate_batch(theta, scenarios)
    split(ALWAYS)
    np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), expected)


# ---------------------------------------------------------------------- balls

FORCES = {
    "known": {"drag.quadratic": 0.05, "restitution.speed": -0.1, "contact.friction": 0.1},
    "asked": {"lift.magnus": [0.3, 0.1], "drag.linear": 0.2, "contact.friction": 0.1},
    # the periodic force sometimes lifts a resting ball off the ground
    "lifting": {"force.periodic": [0.5, 12.0, 1.0], "force.bias": 0.1},
    "without": {"contact.friction": 0.1},
}


def balls(case, count=8):
    """Return balls that bounce, come to rest, rest on the ground or begin inside it, in several
    runs.
    """
    simulator = SIMULATORS["ball"](engine="mujoco", effects=list(FORCES[case]))
    values = np.concatenate([np.ravel(c) for c in FORCES[case].values()])
    rng = np.random.default_rng(3)
    theta = np.zeros((count, len(simulator.parameters)))
    theta[:, 0] = np.linspace(0.3, 1.0, count)
    theta[:, 1 : 1 + values.size] = values * rng.uniform(0.7, 1.3, (count, 1))
    theta[-2:, 2:] = 0.0  # only the first effect acts
    uneven = np.cumsum(np.where(np.arange(50) % 7, 0.02, 0.013))
    runs = [
        Scenario(np.arange(60) / 50, {"z": 0.7, "vx": 1.0}),
        Scenario(np.arange(40) / 45, {"z": 0.4, "vz": 2.0, "vy": -1.0}),
        Scenario(uneven, {"z": 0.0, "vx": 0.5}),
        Scenario(np.arange(30) / 50, {"z": 0.0, "vz": -3.0}),  # an impact and a whole step
    ]
    return simulator, theta, [runs[i % 4] for i in range(count)]


@pytest.mark.parametrize("case", FORCES)
def test_balls_together_are_balls_one_by_one_to_the_bit(case, split):
    simulator, theta, scenarios = balls(case)
    split(NEVER)
    alone = simulator.simulate_batch(theta, scenarios)
    split(ALWAYS)
    for _ in range(2):  # newly built, then reused
        np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), alone)


def test_the_cases_of_balls_are_what_they_say(split):
    split(ALWAYS)
    _, _, z, *_ = balls("lifting")[0].simulate_batch(*balls("lifting")[1:]).T
    height = z[:, 2]  # of a run that begins on the ground
    on = height <= height[0] + 1e-6
    assert on[0]
    assert not on.all()


def test_mujocos_solver_begins_where_the_lane_was():
    together_ = mujoco_ball_batch.MujocoBallBatch(CompiledWorld(mujoco_world_of_balls.model), 1)
    ball = together_.reset_world({"mass": 0.1, "radius": 0.5, "gravity": 9.81}, 2)
    before = together_._now.before
    before[:] = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    together_.export_element(1)
    np.testing.assert_array_equal(ball.exported_state[2], before[1])
    ball._data.qacc_warmstart[:] = 7.0
    together_.import_element(1)
    np.testing.assert_array_equal(before, [[1.0, 2.0, 3.0], [7.0, 7.0, 7.0]])


def test_a_ball_that_fails_is_nan_silently_and_harms_no_other(split, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    simulator, theta, scenarios = balls("asked")
    split(ALWAYS)
    healthy = simulator.simulate_batch(theta, scenarios)
    broken = scenarios.copy()
    broken[1] = Scenario(scenarios[1].times, {"z": 1.0, "vz": 1e300})
    found = simulator.simulate_batch(theta, broken)
    assert np.isnan(found[1]).all()
    others = [0, *range(2, len(theta))]
    np.testing.assert_array_equal(found[others], healthy[others])
    np.testing.assert_array_equal(simulator.simulate_batch(theta, scenarios), healthy)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_arrays_of_kicks_are_kicks():
    rng = np.random.default_rng(4)
    choices = np.array([-3.0, -1.0, -0.2, -0.0, 0.0, 0.1, 0.5, 2.0])
    v, force = rng.choice(choices, (2, 2000)) * rng.choice([1.0, rng.random()], (2, 2000))
    limit = np.abs(rng.choice(choices, 2000))
    inverse, duration = rng.uniform(0.1, 3.0, (2, 2000))
    each = list(zip(v.tolist(), force.tolist(), limit.tolist(), strict=True))
    np.testing.assert_array_equal(
        subtract_dry_friction_batch(v, force, limit),
        [subtract_dry_friction(*numbers) for numbers in each],
    )
    rest = list(zip(inverse.tolist(), duration.tolist(), strict=True))
    expected = [integrate_velocity(*one, *two) for one, two in zip(each, rest, strict=True)]
    np.testing.assert_array_equal(
        integrate_velocity_batch(v, force, limit, inverse, duration), expected
    )
    free = [integrate_velocity(a, f, 0.0, *two) for (a, f, _), two in zip(each, rest, strict=True)]
    np.testing.assert_array_equal(integrate_velocity_batch(v, force, None, inverse, duration), free)
