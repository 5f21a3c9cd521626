import numpy as np
import pandas as pd
import pytest

from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.runner.experiment_runner import (
    ExperimentRun,
    prepare_experiment,
    run_experiment,
)
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.core.plugin_registries import load_plugins
from tests.conftest import PLUGINS
from tests.plugins.awkward import hashed
from tests.sample_experiments import spring_experiment

PLUGIN_FILES = [str(PLUGINS / "spring.py"), str(PLUGINS / "awkward.py")]
MEASURED = ["tuner_seconds", "simulator_seconds"]


@pytest.fixture(scope="module", autouse=True)
def plugins():
    load_plugins(PLUGIN_FILES[:1])


def compared(experiment, jobs=2) -> ExperimentRun:
    load_plugins_for_experiment(PLUGIN_FILES, experiment)
    results = prepare_experiment(experiment)
    run_experiment(results, PLUGIN_FILES, jobs)
    return results


def frame(results):
    columns = results.run_sink.columns
    return pd.concat([pd.DataFrame(columns[i]) for i in sorted(columns)], ignore_index=True)


EVERYTHING = {
    "random": {},
    "nelder_mead": {},
    "cma_es": {},
    "least_squares": {},
    "entropy_search": {"seeds": 1},
    "crashing": {},
    "dying": {"seeds": 1},
    "nan_proposing": {},
    "over_asking": {},
    "stopping": {"seeds": 1},
}


@pytest.fixture(scope="module")
def two_workers():
    return compared(spring_experiment(tuners=EVERYTHING), jobs=2)


def test_other_tuners_in_the_comparison_change_nothing(two_workers):
    alone = frame(compared(spring_experiment(tuners={"cma_es": {}}), jobs=2)).drop(columns=MEASURED)
    among = (
        frame(two_workers).drop(columns=MEASURED).query("tuner == 'cma_es'").reset_index(drop=True)
    )
    pd.testing.assert_frame_equal(alone, among)


def test_every_end_has_its_status_and_keeps_its_rows(two_workers):
    statuses = pd.DataFrame([vars(s) for s in two_workers.run_sink.statuses.values()])
    kinds = {tuner: set(group["status"]) for tuner, group in statuses.groupby("tuner")}
    assert kinds["crashing"] == kinds["dying"] == {"crashed"}
    assert kinds["nan_proposing"] == {"diverged"}
    assert kinds["over_asking"] == kinds["random"] == {"done"}
    assert kinds["stopping"] == {"converged"}
    assert set(statuses.query("tuner == 'stopping'")["reason"]) == {"found nothing better"}
    used = statuses.groupby("tuner")["simulations"].agg(["min", "max"])
    assert tuple(used.loc["over_asking"]) == (12, 12)
    assert tuple(used.loc["crashing"]) == (1, 1)
    assert tuple(used.loc["dying"]) == (1, 1), "what was simulated is known, whatever then died"
    rows = frame(two_workers)
    assert set(rows["run"]) == set(statuses["run"])
    assert (
        rows.groupby("run")["k"].max() == statuses.set_index("run")["simulations"].sort_index()
    ).all()


def test_pairing_all_tuners_share_target_start_and_true_parameters(two_workers):
    rows = frame(two_workers)
    first = rows[rows["k"] == 0].groupby("target")
    assert (first["true_rate"].nunique() == 1).all()
    assert (first["recommendation_rate"].nunique() == 1).all()
    truths = rows.groupby("target")["true_rate"].first()
    inside = truths[[t for t in truths.index if t.startswith("in")]]
    assert ((inside >= 2.0) & (inside <= 4.0)).all()


def test_obs_error_is_the_rmse_of_the_recommended_simulation(two_workers):
    rows = frame(two_workers).query("tuner == 'cma_es' and target == 'in-001' and seed == 1")
    problem = two_workers.problem
    target = next(t for t in draw_targets(problem) if t.blinded.name == "in-001")
    for _, row in rows.iterrows():
        theta = np.array([[row["recommendation_rate"], row["recommendation_decay"]]])
        simulated = problem.simulator.simulate(theta, target.blinded.fitting.scenarios[0])[0]
        rmse = np.sqrt(np.mean((simulated - target.blinded.fitting.observed) ** 2))
        assert row["obs_error"] == pytest.approx(rmse, rel=1e-9)


def test_tuner_that_searches_everything_finds_no_true_parameters():
    once = {"targets": 1, "seeds": 1, "ranges": ["in"]}
    target = draw_targets(prepare_experiment(spring_experiment(**once)).problem)[0]
    cube = prepare_experiment(spring_experiment(**once)).problem.cube
    seen = target.blinded.fitting.observed.ravel()
    truths = np.concatenate([target.truth, cube.to_unit_cube(target.truth)])
    wanted = [hashed(float(x)) for x in [*seen, *truths]]
    results = compared(
        spring_experiment(tuners={"snooping": {"options": {"wanted": wanted}}}, **once), jobs=1
    )
    (status,) = results.run_sink.statuses.values()
    assert status.status == "converged", status.reason
    numbers, *places = map(int, status.reason.split())
    assert numbers > 60
    assert set(places) == set(range(len(seen))), "all observations, and no true parameters"


def test_snooping_would_find_true_parameters_that_are_there():
    from tests.plugins.awkward import walk

    numbers = set()
    walk({"deep": [{"deeper": np.array([0.123456789])}]}, numbers, set(), 6)
    assert numbers == {0.123456789}


@pytest.mark.slow
def test_hanging_tuner_is_killed_at_its_limit(monkeypatch):
    monkeypatch.setattr("bench.benchmark.runner.worker_pools.HARD_LIMIT_GRACE_SECONDS", 0.5)
    results = compared(
        spring_experiment(tuners={"hanging": {}, "random": {}}, targets=1, seeds=1, timeout=3.0)
    )
    statuses = {s.tuner: s for s in results.run_sink.statuses.values()}
    assert statuses["hanging"].status == "timeout"
    assert statuses["random"].status == "done"


def test_noise_is_added_to_the_target_only_and_sets_the_scale():
    experiment = spring_experiment(noise={"x": 0.05})
    problem = prepare_experiment(experiment).problem
    targets = draw_targets(problem)
    residuals = [
        t.blinded.fitting.observed
        - problem.simulate(problem.cube.to_unit_cube(t.truth)[None], t.blinded.fitting.scenarios)[0]
        for t in targets
    ]
    assert np.std(residuals) == pytest.approx(0.05, rel=0.1)
    assert problem.scale == pytest.approx([0.05])
    again = draw_targets(prepare_experiment(experiment).problem)
    np.testing.assert_array_equal(
        targets[3].blinded.fitting.observed, again[3].blinded.fitting.observed
    )
