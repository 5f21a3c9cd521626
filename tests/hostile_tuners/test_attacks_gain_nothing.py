"""Tests that attempts to read the true parameters or another run's result gain nothing."""

import socket
import threading
from contextlib import suppress

import pandas as pd
import pytest

from bench.benchmark.isolation.isolation_layers import ISOLATION_LAYERS
from tests.hostile_tuners import attack_arena

NAMES = {name: sorted(attack_arena.cheats(name)) for name in ("parameter_attacks", "between")}
CHEATERS = [*NAMES["parameter_attacks"], *NAMES["between"], "at-import"]
TRUSTED = ["problem-of-worker", "drawn-again", "journal", "frames"]
"""Attacks that succeed in the harness's own process, one or more of each kind."""
WORKING_CHANNELS = ["globals", "environ", "stamps", "rights", "locks"]
"""Channels that work without isolation; they leave traces only in the copy of their plugin file."""
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Start servers outside the comparison that answer every request and record it."""
    address, asked = str(tmp_path_factory.mktemp("outside") / "socket"), []
    servers, threads = [socket.socket(socket.AF_UNIX), socket.socket(socket.AF_INET)], []
    for one, where in zip(servers, (address, ("127.0.0.1", 0)), strict=True):
        one.bind(where)
        one.listen()

        def serve(one=one):
            # `accept` fails when the server is shut down.
            with suppress(OSError):
                while True:
                    link, _ = one.accept()
                    asked.append(link.recv(1024))
                    link.sendall(bytes(16))
                    link.close()

        threads.append(threading.Thread(target=serve, daemon=True))
        threads[-1].start()
    yield {"address": address, "port": servers[1].getsockname()[1]}, asked
    for one, thread in zip(servers, threads, strict=True):
        one.shutdown(socket.SHUT_RDWR)
        thread.join()
        one.close()


def entries(folder, server):
    places = [str(folder / "run"), str(folder)]
    tuners = {name: {"options": {"places": places}} for name in NAMES["parameter_attacks"]}
    tuners["network"]["options"] |= server
    salt = str(folder)
    tuners |= {name: {"options": {"places": places, "salt": salt}} for name in NAMES["between"]}
    return {**tuners, "at-import": {}}


@pytest.fixture(scope="module")
def met(tmp_path_factory, server):
    """Run all attackers together with honest tuners.

    One process serves all runs of a tuner, so objects it keeps still exist during its later runs.
    """
    folder = tmp_path_factory.mktemp("met")
    tuners = {**attack_arena.HONEST_TUNERS, **entries(folder, server[0])}
    plugins, salt = ("parameter_attacks", "between", "at_import"), ("--salt", attack_arena.SALT)
    made = attack_arena.compared(folder, tuners, plugins, salt, isolation="tuner")
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Run the honest tuners alone."""
    folder = tmp_path_factory.mktemp("alone")
    made = attack_arena.compared(
        folder, attack_arena.HONEST_TUNERS, (), ("--salt", attack_arena.SALT), isolation="tuner"
    )
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture(scope="module")
def trusted(tmp_path_factory):
    """Run some attackers without isolation and with a public salt."""
    folder = tmp_path_factory.mktemp("trusted")
    every = entries(folder, {})
    tuners = {name: every[name] for name in (*TRUSTED, *WORKING_CHANNELS)}
    options = ("--salt", "public", "--trust", "--jobs", "1")
    # The reference runs first, because the attackers read the journal.
    tuners = {"random": attack_arena.HONEST_TUNERS["random"], **tuners}
    made = attack_arena.compared(folder, tuners, ("parameter_attacks", "between"), options)
    assert made.returncode == 0, made.stderr
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEATERS)
def test_a_cheater_is_no_better_than_random_search(met, name):
    assert attack_arena.gains(met, name) > attack_arena.MAX_P_VALUE


@pytest.mark.parametrize("name", TRUSTED)
def test_the_same_cheater_gains_where_it_is_trusted(trusted, name):
    assert attack_arena.gains(trusted, name) < 1e-3


def reasons(folder, name):
    statuses = attack_arena.stored(folder).statuses
    return list(statuses[statuses["tuner"] == name]["reason"])


@pytest.mark.parametrize("name", NAMES["between"])
def test_no_run_hears_of_another(met, name):
    if name == "siblings" and "processes" not in held():
        pytest.skip(f"no isolation layer here: {ISOLATION_LAYERS['processes']}")
    assert set(reasons(met, name)) == {"the tuner stopped"}


@pytest.mark.parametrize("name", WORKING_CHANNELS)
def test_a_trusted_run_hears_of_another(trusted, name):
    assert any(reason.startswith("received ") for reason in reasons(trusted, name))


def held():
    """Return the isolation layers that work on this machine."""
    from bench.benchmark.runner.tuner_process_start import get_fork_server

    child = get_fork_server().start_process("bench.benchmark.isolation.tuner_server:serve_requests")
    child.wait_until_ready()
    child.end()
    return child.seals


def test_every_run_of_a_cheater_has_a_status_and_its_rows(met):
    statuses = attack_arena.stored(met).statuses
    cheaters = statuses[~statuses["tuner"].isin(attack_arena.HONEST_TUNERS)]
    assert set(cheaters["status"]) == {"done", "converged"}
    assert set(cheaters["tuner"]) == set(CHEATERS)
    assert (cheaters.groupby("tuner").size() == 9).all()
    assert (cheaters["simulations"] == 12).all()


def test_other_tuners_have_the_same_rows_with_and_without_cheaters(met, alone):
    among, apart = (
        attack_arena.rows(attack_arena.stored(f).runs, attack_arena.HONEST_TUNERS)
        for f in (met, alone)
    )
    assert len(apart) > 300
    pd.testing.assert_frame_equal(among, apart, check_exact=True)


def test_nothing_outlives_the_cheaters(met, alone, server):
    assert attack_arena.left(met) == ([], [])
    assert server[1] == [], "nobody outside was asked"
