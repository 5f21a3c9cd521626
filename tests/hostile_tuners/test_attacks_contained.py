"""Tests that attacks on the machine, the harness or other tuners affect only the attacker's run."""

import os

import pandas as pd
import pytest

from bench.benchmark.isolation.isolation_layers import ISOLATION_LAYERS
from tests.hostile_tuners import attack_arena

KINDS = {
    **attack_arena.cheats("force"),
    **attack_arena.cheats("talk"),
    **attack_arena.cheats("learning_attacks"),
}
NEEDED = {
    "shared-hog": "calls",
    "file-hog": "calls",
    "spoiling": "files",
    "full-disk": "disk",
    "many-files": "disk",
}
"""Isolation layer without which an attacker would harm the machine that runs the test."""
HONEST_TUNERS = {"random": {}, "nelder_mead": {}, "least_squares": {}}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def held():
    """Return the isolation layers that work on this machine."""
    from bench.benchmark.runner.tuner_process_start import get_fork_server

    child = get_fork_server().start_process("bench.benchmark.isolation.tuner_server:serve_requests")
    child.wait_until_ready()
    child.end()
    return child.seals


@pytest.fixture(scope="module")
def met(tmp_path_factory, held):
    """Run all attackers together with honest tuners; the cache of trained weights has one file."""
    folder = tmp_path_factory.mktemp("met")
    cache = folder / "cache"
    cache.mkdir()
    (cache / "x.npz").write_bytes(b"of another")
    given = {"options": {"places": [str(folder / "run"), str(folder), str(cache)]}}
    tuners = {
        name: given if name in attack_arena.cheats("force") else {}
        for name in KINDS
        if NEEDED.get(name, "process") in held
    }
    plugins, salt = ("force", "talk", "learning_attacks"), ("--salt", attack_arena.SALT)
    small = {"targets": 1, "seeds": 1, "timeout": 1.5, "training_budget": 20}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMGAP_CACHE", str(cache))
        made = attack_arena.compared(folder, {**HONEST_TUNERS, **tuners}, plugins, salt, **small)
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture(scope="module")
def statuses(met):
    return attack_arena.stored(met).statuses.set_index("tuner")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(KINDS))
def test_its_run_ends_in_the_status_that_it_deserves(statuses, held, name):
    if NEEDED.get(name, "process") not in held:
        pytest.skip(f"no isolation layer here: {ISOLATION_LAYERS[NEEDED[name]]}")
    ends, status = KINDS[name].ends, statuses.loc[name]
    assert status["status"] in ((ends,) if isinstance(ends, str) else ends), status["reason"]
    assert "got through" not in status["reason"]
    assert "bench/benchmark/runner" not in status["reason"], "it is no failure of the harness"
    assert not set(status["reason"]) & set("\0\x1b\r")


def test_other_tuners_have_the_same_rows_with_and_without_them(met, tmp_path):
    made = attack_arena.compared(
        tmp_path, HONEST_TUNERS, (), ("--salt", attack_arena.SALT),
        targets=1, seeds=1, timeout=1.5, training_budget=20,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    among, apart = (
        attack_arena.rows(attack_arena.stored(f).runs, HONEST_TUNERS) for f in (met, tmp_path)
    )
    assert len(apart) > 30
    pd.testing.assert_frame_equal(among, apart, check_exact=True)


def test_nothing_outlives_them_and_nothing_is_damaged(met):
    assert attack_arena.left(met) == ([], [])
    weights = met / "cache" / "x.npz"
    assert weights.read_bytes() == b"of another"
    assert os.stat(weights).st_mode & 0o777
    assert {path.name.partition("-")[0] for path in (met / "cache").iterdir()} <= {
        "x.npz", "school", "behind",
    }  # fmt: skip


def test_who_pretends_to_be_the_world_is_not_let_in(tmp_path):
    world = tmp_path / "world"
    made = attack_arena.compared(world, {"random": {}, "world": {}}, ("world",), targets=1)
    assert made.returncode == 2
    assert made.stderr.splitlines()[-1].startswith("simgap: plugin ")
    assert "simulator 'spring'" in made.stderr
    assert not (world / "world.imported").exists(), "its code has run where true parameters are"
    assert not (world / "run").exists()
