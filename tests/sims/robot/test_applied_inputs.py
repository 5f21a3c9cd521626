"""Tests of computing the applied inputs of several drives together."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.robot.dynamics.applied_inputs import compute_inputs_over_steps
from tests.sims.robot.sample_arms import ARM
from tests.sims.robot.test_series_joints import make_simulator

STEP, STEPS = 0.002, 305
TIMES = np.arange(61) / 100.0
RNG = np.random.default_rng(8)
COMMANDS = {name: 0.05 * RNG.normal(size=61).cumsum() for name in ("u.m_shoulder", "u.m_elbow")}
EFFECTS = {
    "input.delay@m_shoulder": 0.013,
    "input.delay@m_elbow": 0.021,
    "input.rate@m_shoulder": 1.5,
    "input.rate@m_elbow": 2.5,
    "input.lag@m_elbow": 0.03,
    "backlash@m_shoulder": 0.02,
}
ACTIVE_EFFECTS = (
    {"input.delay@m_shoulder"},
    {"input.rate@m_elbow"},
    set(),
    {"input.delay@m_shoulder", "input.rate@m_shoulder", "input.rate@m_elbow"},
    {"input.delay@m_elbow", "input.rate@m_elbow", "input.lag@m_elbow"},
    {"backlash@m_shoulder", "input.delay@m_elbow"},
)


def acting(active_effects):
    kind = make_simulator(ARM)
    effects = kind(observe=["q.elbow"], effects=list(EFFECTS)).effects
    return tuple(
        (
            effect,
            np.array([[[EFFECTS[effect.name] * (effect.name in lane)] for lane in active_effects]]),
        )
        for effect in effects
    )


@pytest.mark.parametrize("share", [1.0, 1e-6])
@pytest.mark.parametrize("offset", [0.0, 0.0031])
def test_applied_inputs_do_not_depend_on_other_elements_or_drives(offset, share):
    earlier = {"u.m_elbow": np.array([[-0.3, -0.1], [0.4, 0.2]])}
    run = Scenario(
        TIMES, {}, COMMANDS, offset=offset, before=earlier, linear=frozenset({"u.m_elbow"})
    )

    def compute_inputs(active_effects, names=COMMANDS):
        signals = {name: COMMANDS[name] for name in names}
        return compute_inputs_over_steps(
            STEP, run, signals, acting(active_effects), len(active_effects), STEPS, share
        )

    together = compute_inputs(ACTIVE_EFFECTS)
    bare = compute_inputs(ACTIVE_EFFECTS[2:3])
    for number, lane in enumerate(ACTIVE_EFFECTS):
        alone = compute_inputs([lane])
        for name, own in together.items():
            np.testing.assert_array_equal(own[number], alone[name][0])
            np.testing.assert_array_equal(
                own[number], compute_inputs(ACTIVE_EFFECTS, [name])[name][number]
            )
            touched = any(effect.endswith(name[1:].replace(".", "@")) for effect in lane)
            assert (own[number] != bare[name][0]).any() == touched
