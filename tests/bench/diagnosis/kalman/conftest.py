"""Fixture of the example robot, followed with its model file."""

import pytest

from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from tests.bench.diagnosis.explained_samples import white


@pytest.fixture(scope="module")
def followed(example_arm):
    """Return two runs of the example robot, followed with its model file."""
    noise = white(example_arm, 0.001)
    return FollowedRuns.follow(example_arm, example_arm.get_nominal_theta(), noise)
