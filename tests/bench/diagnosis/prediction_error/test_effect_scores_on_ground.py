"""Tests of scores of a robot on the ground, against rolling without slip, v = omega r."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.pipeline.base_model import filter_and_fit
from bench.diagnosis.pipeline.recording_preparation import prepare_runs
from bench.diagnosis.pipeline.simulated_runs import DiagnosisContext
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effect_scores_on_ground import OutputErrorScores
from tests.bench.diagnosis.simulated_logs import follow, write_log
from tests.exams.planted.model_files import ROVER

RADIUS, TRACK, SPEED = 0.05, 0.2, 6.0
"""Radius and distance of the wheels, m, and their commanded speed, rad/s."""
PLANTED = 0.02
"""Relative change of the radius of the left wheel in the recording."""
SIDES = "left", "right"
UNITS = ["m"] * 3 + ["1"] * 4 + ["rad"] * 2
CHANNELS = [f"q.base.{c}" for c in ("x", "y", "z", "qw", "qx", "qy", "qz")] + ["q.left", "q.right"]
NOISE = np.array([4e-4] * 3 + [5e-4] * 4 + [4e-4] * 2)
RAISED = 0.1 / 0.13
"""Height of the frame of the chassis by that of the axle 0.03 m behind it, for its caster 0.1 m
in front of it touches the floor.
"""


def write_recording(folder: Path, seed: int = 0) -> Path:
    """Write runs straight on and with turns, simulated by plain MuJoCo; run 2 is held out."""
    model = mujoco.MjModel.from_xml_string(ROVER)
    model.geom("left_tyre").size[0] *= 1.0 + PLANTED
    rng, runs, times = np.random.default_rng(seed), [], np.arange(101) / 100
    turns = SPEED + np.sin(2 * np.pi * np.outer(times, (1.3, 2.1))) * 3.0
    straight = np.full((101, 2), SPEED)
    for commands in (straight, 0.7 * straight, turns, turns[:, ::-1]):
        # The robot settles with drives that stand still.
        positions = follow(model, np.vstack([np.zeros((50, 2)), commands.round(4)]), 5)[50:]
        readings = positions + NOISE * rng.standard_normal(positions.shape)
        runs.append((times, commands.round(4), readings))
    tables = ['model = "robot.xml"', *(f'[inputs."u.m_{s}"]\nunit = "rad/s"' for s in SIDES)]
    for name, unit, noise in zip(CHANNELS, UNITS, NOISE.tolist(), strict=True):
        tables.append(f'[channels."{name}"]\nunit = "{unit}"\nnoise = {noise}')
    description = "\n".join([*tables, "[runs.2]\nheld_out = true\n"])
    columns = f"u.m_left,u.m_right,{','.join(CHANNELS)}"
    return write_log(folder, description, columns, runs, robot=ROVER)


def compute_scores(folder, seed=0):
    """Record a rover with one large wheel, and score the effects of its model."""
    path = write_recording(folder, seed)
    runs = prepare_runs([path], DiagnosisContext(ExplainOptions(), ForkedWorkerPool(1)))
    search = runs.create_search(filter_and_fit(runs).fit, runs.make_rng())
    return OutputErrorScores(SearchContext.of(search))


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    return compute_scores(tmp_path_factory.mktemp("rover"))


def test_the_response_to_a_radius_is_that_of_rolling(scores):
    """A left wheel with the radius r (1 + c) rolls by r c farther per turn.

    The middle of the axle moves by the mean of both wheels, and the axle turns by their difference,
    divided by their distance.
    """
    evaluator, library = scores.context.evaluator, scores.context.columns.library
    (probe,) = [p for p in library.probes if p.effect == "geom.radius@left_tyre"]
    response = scores._simulate_geometry(probe)[1]  # The second piece begins at full speed.
    x, y, z, yaw = (evaluator.channels.index(f"q.base.{c}") for c in ("x", "y", "z", "yaw"))
    # The drives need 0.06 s for the new speeds.
    change = response[-1] - response[20]
    left, right = (evaluator.channels.index(f"q.{side}") for side in SIDES)
    base = scores.context.filters.base
    simulated = base.first_state_fitter.simulate(base.theta, base.get_first_states())
    turned = np.ptp(simulated[1, 20:, left])
    heading = simulated[1, -1, yaw]
    forward = change[x] * np.cos(heading) + change[y] * np.sin(heading)
    rolled_left, rolled_right = RADIUS * (turned + change[left]), RADIUS * change[right]
    # The wide tyres creep sideways while they turn.
    creep = 0.05 * RADIUS * turned
    assert forward == pytest.approx((rolled_left + rolled_right) / 2, abs=creep)
    assert change[yaw] == pytest.approx((rolled_right - rolled_left) / TRACK, abs=creep / TRACK)
    # The middle of the axle is raised by half of what the wheel is.
    assert response[:, z].mean() == pytest.approx(RAISED * RADIUS / 2, rel=0.15)


def test_a_planted_radius_explains_most_of_the_residual(tmp_path):
    """The standard deviation over the noise of a recording is 5 %, that of the mean 2.5 %."""
    estimates = []
    for seed in range(4):
        folder = tmp_path / str(seed)
        folder.mkdir()
        scores = compute_scores(folder, seed)
        start = scores.simulations.refine(scores.list_starts()[0])
        assert start.effects == ("geom.radius@left_tyre",)
        (index,) = scores.context.evaluator.get_coefficient_indices("geom.radius@left_tyre")
        estimates.append(start.theta[index])
        base_cost = scores.simulations.compute_cost(scores.context.filters.base.theta)
        assert scores.simulations.compute_cost(start.theta) < 0.2 * base_cost
    assert np.mean(estimates) == pytest.approx(PLANTED, rel=0.05)
    assert estimates == pytest.approx([PLANTED] * 4, rel=0.15)
