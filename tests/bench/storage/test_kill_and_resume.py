"""Short version of `make chaos` on a cluster; test_comparison_study kills a local comparison."""

import pytest

from tests.kill_and_resume import chaos


@pytest.mark.slow
def test_killed_at_a_random_moment_the_table_is_the_undisturbed_one(tmp_path):
    hits, _, runs = chaos(tmp_path, 1, seed=7, on_cluster=True, targets=3)
    assert sum(hits.values()) == 1
    assert runs == 3 * 2 * (2 + 2 + 2 + 1)
