"""Tests that cached data of a robot are freed with it: explaining many logs does not increase
memory.
"""

import gc
import weakref

import numpy as np
import pytest

import simgap
from bench.core.plugin_registries import make_robot_simulator
from sims.core.simulator import Scenario
from sims.robot.robot_model import cache_per_robot
from sims.robot.robot_system import RobotSystem
from tests.sims.robot.sample_arms import ARM
from tests.sims.robot.sample_arms import robot as read
from tests.sims.robot.test_robot_example import EXAMPLE

TIMES = np.arange(20) / 100.0
EFFECTS = ["friction.coulomb@shoulder", "drag.quadratic@elbow", "joint.flexibility@elbow"]


def used(path):
    """Return weak references to the simulator class of a file and its robot, after use.

    The simulation had effects evaluated per step and one in series with a joint, and all places
    were searched.
    """
    kind = make_robot_simulator(path)
    made = kind(effects=[*EFFECTS, "joint.coupling@elbow"])
    theta = np.array([[0.1 * p.bounds[1] for p in made.parameters]])
    made.simulate(theta, Scenario(TIMES, {}, {}))
    made.close()
    return weakref.ref(kind), weakref.ref(kind.robot)


def test_a_robot_that_nobody_holds_is_gone(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    held = used(tmp_path / "arm.xml")
    gc.collect()
    assert [one() for one in held] == [None, None]


@pytest.fixture
def calls():
    return []


@pytest.fixture
def counted(calls):
    @cache_per_robot
    def counted(robot, number):
        calls.append(number)
        return robot.name, number

    return counted


def test_a_robot_is_asked_once_of_the_same(tmp_path, counted, calls):
    first, second = read(tmp_path), read(tmp_path)
    found = [counted(first, 1), counted(first, 2), counted(first, 1), counted(second, 1)]
    assert found == [("arm", 1), ("arm", 2), ("arm", 1), ("arm", 1)]
    assert calls == [1, 2, 1]


def robots():
    """Return the number of robot systems in memory."""
    gc.collect()
    return len(RobotSystem.__subclasses__())


@pytest.mark.slow
def test_what_was_explained_is_gone():
    before = robots()
    # The budget is long enough to search places and refit causes.
    cut = simgap.explain(EXAMPLE / "log.csv", budget=2.0).answer.cut
    assert cut is not None
    assert robots() == before
