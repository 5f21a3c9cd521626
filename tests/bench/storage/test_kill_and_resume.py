"""Short version of `make chaos`."""

import pytest

from tests.kill_and_resume import chaos


@pytest.mark.slow
@pytest.mark.parametrize("on_cluster", [False, True], ids=["local", "cluster"])
def test_killed_at_random_moments_the_table_is_the_undisturbed_one(tmp_path, on_cluster):
    kills = 1 if on_cluster else 2
    hits, _, runs = chaos(tmp_path, kills, seed=7, on_cluster=on_cluster, targets=3)
    assert sum(hits.values()) == kills
    assert runs == 3 * 2 * (2 + 2 + 2 + 1)
