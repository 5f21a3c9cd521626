"""Tests specific to MuJoCo: lazy import, contact, lifetime of its worlds, suppressed output, memory
leaks.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sims.core.effect import Coefficient, Force
from sims.core.simulator import InputError, Scenario
from sims.engines.external.mujoco_ball_contact import compute_damping_ratio
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider
from tests.sims.test_bullet_engine import growth

KINDS = [Ball, Pendulum, Slider, Servo]


def test_import_is_lazy():
    code = (
        "import sys\nfrom sims.systems.ball import Ball\nball = Ball(engine='mujoco')\n"
        "print('mujoco' in sys.modules, "
        "sys.modules['sims.engines.external.mujoco_engine'].__name__)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "False sims.engines.external.mujoco_engine\n"


def test_instability_is_silent_and_writes_no_file(tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    heard = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        pendulum = Pendulum(engine="mujoco", time_step=0.1, fixed={"force.bias": 4e5})
        assert np.isnan(
            pendulum.simulate(np.array([[1e-3]]), Scenario(np.arange(1e4) / 10, {"qd": 1e300}))
        ).all()
        assert heard == []
        assert mujoco.get_mju_user_warning() is not None  # the user's own handler is restored
    finally:
        mujoco.set_mju_user_warning(before)
    assert list(Path(tmp_path).iterdir()) == []


@pytest.mark.parametrize("effects", [{}, {"friction.stribeck": [0.3, 0.2, 0.1], "wind": 0.2}])
@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_no_bit(effects, threads):
    t = np.arange(40) / 100
    runs = [Scenario(t, {"x": 0.1 * k, "v": 1.0}, {"u": np.sin(9 * t + k)}) for k in range(7)]
    theta = np.linspace(0.5, 2.0, 7)[:, None]
    one, many = (
        Slider(engine="mujoco", fixed=effects, threads=count).simulate_batch(theta, runs)
        for count in (1, threads)
    )
    np.testing.assert_array_equal(many, one)


@pytest.mark.parametrize("threads", [0, 1.5, "all", 10**6])
def test_impossible_numbers_of_threads_are_refused(threads):
    with pytest.raises(InputError, match="threads must be a whole number from 1 to"):
        Slider(engine="mujoco", threads=threads)


class FiniteOnly(Force):
    """A force that accepts finite numbers only, like a lookup table."""

    name, says = "test.finite", "there is a table"
    coefficients = (Coefficient("size", ("m/s^2", "N", "N*m"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        assert np.isfinite(moment.x).all()
        return c[0] * np.sign(moment.x)


@pytest.mark.parametrize("engine", ["mujoco", "pybullet"])
@pytest.mark.parametrize(("kind", "rate"), [(Pendulum, "qd"), (Ball, "vz")])
def test_effects_are_evaluated_at_finite_states_only(kind, rate, engine):
    simulator = kind(engine=engine, effects=[FiniteOnly], fixed={"drag.quadratic": 1e-4})
    theta = np.array([[simulator.parameters[0].nominal, 0.1]] * 2)
    runs = [Scenario(np.arange(20) / 100, {rate: value}) for value in (1.0, 1e300)]
    found = simulator.simulate_batch(theta, runs)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("restitution", [0.1, 0.37, 0.7, 0.9, 0.95, 1.0])
def test_damping_ratio_against_the_spring_and_damper_itself(restitution):
    # x'' = -max(0, x + 2 D x') / ..., integrated until the force would pull.
    ratio, x, v, h = compute_damping_ratio(restitution), 0.0, 1.0, 1e-4
    while (force := x + 2.0 * ratio * v) >= 0.0:  # depth and its rate
        v -= h * force
        x += h * v
    assert -v == pytest.approx(restitution, abs=5e-4)
    assert compute_damping_ratio(0.0) == pytest.approx(2.0)


@pytest.mark.parametrize(("restitution", "friction"), [(0.8, 0.0), (0.6, 0.1)])
def test_soft_contact_has_the_restitution_and_friction_asked_for_as_the_step_shrinks(
    restitution, friction
):
    start = Scenario(np.arange(40) / 100, {"z": 0.6, "vz": -2.0, "vx": 3.0})
    errors = []
    for step in (4e-4, 1e-4):
        settings = {"engine": "mujoco", "native_contact": True, "time_step": step}
        rough = {"contact.friction": friction}
        ball = Ball({"gravity": 0.0}, ["x", "z"], **settings, fixed=rough)
        velocity = np.diff(ball.simulate(np.array([[restitution]]), start)[0], axis=0)[-1] * 100
        errors.append(
            np.abs(velocity - [3.0 - friction * (1 + restitution) * 2.0, 2.0 * restitution]).max()
        )
    assert errors[0] < 0.06
    assert errors[1] < errors[0] / 3


def test_soft_contact_sinks_in_by_weight_over_stiffness():
    ball = Ball(engine="mujoco", native_contact=True, stiffness=2e4)
    z, a = ball.simulate(np.array([[0.2]]), Scenario(np.arange(500) / 100, {"z": 0.6}))[0, -1, 2:]
    assert z == pytest.approx(0.5 - 9.81 / 2e4, rel=1e-3)
    assert a == 9.81


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Slider, pytest.param(Ball, marks=pytest.mark.long)])
def test_four_thousand_rollouts_leak_nothing(kind):
    assert growth(kind, 4_000, 4, [{}], engine="mujoco") < 4_000 * 250


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Ball, Pendulum])
def test_rebuilding_worlds_leaks_nothing(kind):
    # A world takes 0.5 MB; the allocator's own memory varies by a few MB.
    assert (
        growth(kind, 400, 2, [{"gravity": 9.8}, {"gravity": 9.81}], engine="mujoco") < 400 * 50_000
    )
