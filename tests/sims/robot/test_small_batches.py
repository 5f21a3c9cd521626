"""Tests that few elements use a batch of their own and move as in a large batch."""

import numpy as np

from bench.core.plugin_registries import make_robot_simulator
from sims.core.simulator import Scenario
from sims.robot.dynamics.mujoco_batch import get_batch_cache
from tests.sims.robot.sample_arms import ARM

TIMES = np.arange(40) / 100.0
SCENARIO = Scenario(TIMES, {"q.elbow": 0.4}, {"u.m_elbow": np.sin(9.0 * TIMES)})


def test_a_single_element_moves_as_in_a_batch_and_costs_no_more(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    kind = make_robot_simulator(tmp_path / "arm.xml", free=["damping@*", "mass@fore"])
    simulator = kind(observe=["q.shoulder", "q.elbow"])
    theta = np.random.default_rng(1).uniform(0.0, 0.1, (12, len(simulator.parameters)))
    together = simulator.simulate(theta, SCENARIO)
    alone = np.concatenate([simulator.simulate(row[None], SCENARIO) for row in theta])
    np.testing.assert_array_equal(alone, together)
    assert np.ptp(together[:, -1], axis=0).min() > 1e-4
    held = {mujoco_batch.count for mujoco_batch in get_batch_cache(kind.robot).batches}
    assert held == {1, 64}, "a batch of one, and the largest for twelve"
