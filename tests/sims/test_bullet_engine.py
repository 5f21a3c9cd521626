"""Tests specific to Bullet: silent import, lifetime of its worlds, memory leaks."""

import gc
import subprocess
import sys

import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.engines.external import bullet_world
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider

NATIVE = {"native_contact": True}
KINDS = [(Ball, {}), (Ball, NATIVE), (Pendulum, {}), (Slider, {}), (Servo, {})]
SCENARIO = Scenario(np.arange(50) / 50)


def make_simulator(kind, settings):
    return kind(engine="pybullet", **settings)


def theta_for(kind, count=1, seed=0):
    low, high = np.array([p.bounds for p in kind.parameters]).T
    return np.random.default_rng(seed).uniform(low, high, size=(count, len(low)))


def connected():
    p = bullet_world.import_pybullet()
    return [i for i in range(64) if p.getConnectionInfo(i)["isConnected"]]


def python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_import_is_lazy_and_quiet():
    lazy = python(
        "import sys\nfrom sims.systems.ball import Ball\n"
        "from sims.systems.pendulum import Pendulum\n"
        "Ball(engine='pybullet'); Pendulum(engine='pybullet'); print('pybullet' in sys.modules)"
    )
    assert lazy.stdout == "False\n"
    used = python(
        "from sims.engines.external import bullet_world\n"
        "print('before', flush=True); bullet_world.import_pybullet(); print('after')"
    )
    assert (used.stdout, used.stderr) == ("before\nafter\n", "")


def test_import_survives_closed_streams():
    assert (
        python(
            "import os; os.close(1); "
            "from sims.engines.external import bullet_world; bullet_world.import_pybullet()"
        ).returncode
        == 0
    )


@pytest.mark.parametrize(("kind", "settings"), KINDS)
@pytest.mark.parametrize("time_step", [0.0, -1.0, np.nan, np.inf, "fast", True])
def test_impossible_time_steps_are_refused(kind, settings, time_step):
    with pytest.raises(InputError, match="time_step must be a positive number of seconds"):
        make_simulator(kind, {**settings, "time_step": time_step})


@pytest.mark.parametrize(("kind", "settings"), KINDS)
def test_worlds_are_opened_late_and_closed(kind, settings):
    gc.collect()
    before = connected()
    simulator, theta = make_simulator(kind, settings), theta_for(kind)
    assert connected() == before
    first = simulator.simulate(theta, SCENARIO)
    assert len(connected()) == len(before) + 1
    simulator.close()
    simulator.close()
    assert connected() == before
    np.testing.assert_array_equal(simulator.simulate(theta, SCENARIO), first)
    del simulator
    gc.collect()
    assert connected() == before


GROWTH = """
import gc, numpy as np, psutil
from sims.core.simulator import Scenario
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider
simulator, theta, count = {kind}(engine="{engine}", **{settings}), np.array({theta}), {count}
scenarios = [Scenario(np.arange({samples}) / 50, {initial}, constants=k) for k in {constants}]
def rollouts(count):
    for i in range(count):
        simulator.simulate(theta, scenarios[i % len(scenarios)])
    gc.collect()
    return psutil.Process().memory_info().rss
print(-rollouts(count // 4) + rollouts(count))
"""


def growth(kind, count, samples, constants, engine="pybullet", **settings):
    """Return the memory growth in bytes of a separate process over `count` rollouts, after a
    warm-up of a quarter as many.
    """
    values = {
        "kind": kind.__name__,
        "engine": engine,
        "settings": settings,
        "theta": theta_for(kind).tolist(),
        "initial": {"z": 0.51} if kind is Ball else {},
        "constants": constants,
    }
    return int(python(GROWTH.format(**values, count=count, samples=samples)).stdout)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "settings"), [KINDS[0], KINDS[2]])
def test_ten_thousand_rollouts_leak_nothing(kind, settings):
    assert growth(kind, 10_000, 4, [{}], **settings) < 10_000 * 100


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "settings"), KINDS[:3:2])
def test_rebuilding_worlds_leaks_nothing(kind, settings):
    gravities = [{"gravity": 9.8}, {"gravity": 9.81}]
    # The allocator may grow once at random; a leak grows every time.
    grown = (growth(kind, 800, 2, gravities, **settings) for _ in range(4))
    assert any(size < 800 * 1000 for size in grown)
