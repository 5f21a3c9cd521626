"""Tests of multiple shooting: segments of runs, their purpose and the fits that start from them."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.multiple_shooting import (
    SEGMENTS_PER_RUN,
    join_segment_fits,
    make_segment_evaluator,
)
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.search import effect_search
from bench.diagnosis.search.alternative_causes import refine_best_model
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from tests.bench.diagnosis.explained_samples import (
    evaluator,
    fit_model,
    recorded,
    searched,
    white,
    with_runs,
)

TIMES = np.arange(0, 12.0, 0.02)
SIGMA = [0.002, 0.01]
"""Standard deviations of angle (rad) and rate (rad/s)."""
STARTS = [{"q": 1.2}, {"q": -0.8, "qd": 2.0}]
LONG = recorded(Pendulum(), [0.0035], STARTS, TIMES, noise=SIGMA)


def test_pieces_are_the_runs_cut_up_and_nothing_else():
    there = evaluator(LONG)
    cut = make_segment_evaluator(there)
    assert len(cut.prepared_runs) == 2 * SEGMENTS_PER_RUN
    again = np.concatenate([t.scenario.times for t in cut.prepared_runs[:SEGMENTS_PER_RUN]])
    assert again.tolist() == TIMES.tolist(), "time goes on, as what is periodic must"
    assert (
        np.concatenate([t.observed for t in cut.prepared_runs[SEGMENTS_PER_RUN:]]).tolist()
        == there.prepared_runs[1].observed.tolist()
    )
    assert [p.name for p in cut.parameters] == [p.name for p in there.parameters]
    assert cut.longest_duration == there.longest_duration


def test_what_is_known_of_the_beginning_is_known_of_the_first_piece_alone():
    told = with_runs(LONG, [replace(run, initial={"q": 1.2}) for run in LONG.runs])
    known = make_segment_evaluator(evaluator(told)).known_state_mask[:, 0]
    assert known.tolist() == ([True] + [False] * (SEGMENTS_PER_RUN - 1)) * 2


def test_runs_too_short_for_two_pieces_are_left_alone():
    # This is one sample fewer than two segments need.
    times = np.arange(39) * 0.02
    short = recorded(Pendulum(), [0.0035], STARTS[:1], times, noise=SIGMA)
    assert make_segment_evaluator(evaluator(short)) is None
    both = with_runs(short, [*short.runs, LONG.runs[0]])
    assert len(make_segment_evaluator(evaluator(both)).prepared_runs) == 1 + SEGMENTS_PER_RUN


def test_over_pieces_the_sum_of_squares_has_one_minimum_where_whole_runs_have_many():
    there = evaluator(LONG)
    cut = make_segment_evaluator(there)

    def minima(some):
        inertias = np.geomspace(0.0028, 0.0047, 40)
        starts = []
        for inertia in inertias:
            theta = some.get_nominal_theta()
            theta[0] = inertia
            starts.append(FitStart((), theta, some.initial_state_guesses))
        # Fit the initial states at each inertia.
        fits = TrajectoryFitter(some, white(some, SIGMA), fits_parameters=False).fit_models(
            starts, 8
        )
        cost = np.array([f.cost for f in fits])
        left, here, right = cost[:-2], cost[1:-1], cost[2:]
        lower = (here < left) & (here < right)
        return int(lower.sum()), inertias[cost.argmin()]

    many, _ = minima(there)
    one, best = minima(cut)
    assert many >= 3
    assert one == 1
    assert best == pytest.approx(0.0035, rel=0.02)


def test_a_fit_of_pieces_begins_that_of_whole_runs_with_their_first_pieces():
    there = evaluator(LONG)
    cut = make_segment_evaluator(there)
    # On whole runs, a fit from this start does not reach the true parameters.
    theta = cut.get_nominal_theta()
    theta[0] = 0.0045
    found = fit_model(cut, white(cut, SIGMA), theta=theta, iterations=12)
    start = join_segment_fits(there, found)
    assert start.initial_states.tolist() == found.initial_states[[0, SEGMENTS_PER_RUN]].tolist()
    without = FitStart((), theta, there.initial_state_guesses)
    fits = TrajectoryFitter(there, white(there, SIGMA)).fit_models([start, without], 20)
    assert fits[0].theta[0] == pytest.approx(0.0035, rel=1e-3)
    assert fits[1].cost > 100.0 * fits[0].cost


@pytest.mark.parametrize(("driven", "cuts"), [(0.0, True), (1.0, False)], ids=["free", "driven"])
def test_a_search_goes_over_pieces_unless_the_motion_forgets_how_it_began(
    driven, cuts, monkeypatch
):
    asked = []
    monkeypatch.setattr(effect_search, "make_segment_evaluator", asked.append)
    times = TIMES[:200]
    inputs = {"goal": 0.5 * np.sin(2.0 * times), "torque_enable": np.full(times.size, driven)}
    starts = [({"q": angle}, inputs) for angle in (0.4, -0.2)]
    swung = recorded(Servo(), [0.5, 4.0, 2e-3], starts, times, noise=1e-3)
    looking, _ = searched(swung, 1e-3, candidates=["drag.quadratic"])
    looking.refit_from_segments(1)
    assert bool(asked) is cuts


def test_competitors_that_were_not_selected_are_tested_before_a_cause_is_named(monkeypatch):
    monkeypatch.setattr(effect_search, "MAX_REFITTED_CANDIDATES", 1)
    dragged = Pendulum(effects=["drag.quadratic"])
    starts = [*STARTS, {"q": 2.0}]
    data = recorded(dragged, [0.0035, 4e-7], starts, TIMES[:250], SIGMA)
    library = [
        "drag.linear",
        "drag.quadratic",
        "friction.coulomb",
        "friction.load",
        "spring.linear",
    ]
    looking, _ = searched(data, SIGMA, candidates=library)
    found = refine_best_model(looking, looking.run())
    tried = {n for names in looking.models for n in names}
    assert {"drag.linear", "friction.coulomb", "friction.load"} <= tried
    assert found.effects == ("drag.quadratic",)


def test_what_bounces_is_left_whole():
    times = np.arange(200) * 0.02
    starts = [{"z": 2.0}, {"z": 3.0}]
    falls = recorded(Ball(observe=["z"]), [0.6], starts, times, noise=0.002)
    assert make_segment_evaluator(evaluator(falls)) is None
