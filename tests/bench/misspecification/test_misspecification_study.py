"""Tests of a model-misspecification study, from its start to its figures, with a known bias.

The shot's restitution falls with the impact speed, e = e0 v^c, and its simulator has no c. One
impact is observed, at the speed v = sqrt(2 g H) cos(a) off an incline of angle a, so the best fit
is e0 v^c for every tuner: biased by e0 (v^c - 1).
"""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import simgap
from bench.benchmark.problem.experiment_config import (
    Experiment,
    expand_sweep,
    load_experiment,
    parse_experiment,
)
from bench.benchmark.problem.experiment_recording import make_scenario
from bench.benchmark.problem.targets import draw_target, draw_targets
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.study_base import prepare_study
from bench.core.plugin_registries import simulators
from bench.misspecification import misspecification_statistics
from bench.misspecification.calibration_recording import MODEL_LABELS, write_calibration_recording
from bench.misspecification.misspecification_study import (
    MisspecificationStudy,
    make_base_experiment,
    make_extended_experiment,
)
from bench.studies.study_kinds import begin_studies, get_study_class
from sims import extended_simulator as extending
from sims.core.simulator import InputError
from sims.recording.recording import read_recording
from tests.command_output import run_command

EXPONENT, GRAVITY = -0.1, 9.81
SHOT = load_experiment("misspecified-shot")
WIDTH = 0.4
"""Width of the training range of restitution, 0.5 to 0.9."""


def small(**changes) -> Experiment:
    """Return a short shot experiment: three targets, a least-squares tuner and a random one."""
    chosen = SHOT.with_tuners(["least_squares", "random"]).with_seeds(1)
    # Held-out shots start higher, where the dependence on speed is largest.
    return replace(chosen, targets=3, budget=12, salt="public", trusted=True, **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    study = MisspecificationStudy.begin(
        prepare_study(small(), folder=tmp_path_factory.mktemp("two") / "shot", jobs=0)
    )
    assert study.run(jobs=0).is_complete
    said = []
    assert study.report(said.append) == 0
    (study.folder / "said.txt").write_text("\n".join(said), encoding="utf-8")
    return study.folder


def mean(folder, metric, model, tuner="least_squares"):
    table = pd.read_csv(folder / "table.csv")
    chosen = (table["metric"] == metric) & (table["model"] == model) & (table["tuner"] == tuner)
    (row,) = table[chosen].to_dict("records")
    return row


def test_the_bias_of_the_plain_simulator_is_the_one_of_theory(folder):
    problem = TuningProblem(small())
    expected = []
    for target in draw_targets(problem):
        constants = target.blinded.fitting.scenarios[0].constants
        fall, angle = constants["drop_height"], constants["incline_angle"]
        speed = np.sqrt(2 * GRAVITY * fall) * np.cos(angle)
        expected.append(target.truth[0] * (speed**EXPONENT - 1) / WIDTH)
    row = mean(folder, "bias", "plain")
    assert row["mean"] == pytest.approx(np.mean(expected), abs=0.01)
    assert row["low"] <= row["mean"] <= row["high"] < 0
    assert mean(folder, "absolute_error", "plain")["mean"] == pytest.approx(-row["mean"], abs=1e-9)


def test_the_extension_takes_nearly_all_of_it_away(folder):
    left = abs(mean(folder, "bias", "extended")["mean"])
    assert left < 0.15 * abs(mean(folder, "bias", "plain")["mean"])
    predicted = [mean(folder, "heldout_error", model)["mean"] for model in MODEL_LABELS]
    assert predicted[1] < 0.5 * predicted[0]


def test_the_extension_was_found_on_a_recording_that_tells_nothing_of_the_targets(folder):
    answer = json.loads((folder / "explain" / "verdict.json").read_text())
    assert [cause["effect"] for cause in answer["causes"]] == ["restitution.speed"]
    found = extending.read_extended(folder / "explain" / "extended.toml").effects[
        "restitution.speed"
    ]
    (number,) = found.values()
    assert number.value == pytest.approx(EXPONENT, abs=0.02)
    assert number.value != EXPONENT, "fitted to noisy data, not copied from the experiment"
    recording = read_recording(folder / "calibration.csv", simulators.get("bounce-shot"))
    assert len(recording.runs) == 6
    assert sum(run.held_out for run in recording.runs) == 2
    drawn = {run.constants["drop_height"] for run in recording.runs}
    met = {
        target.blinded.fitting.scenarios[0].constants["drop_height"]
        for target in draw_targets(TuningProblem(small()))
    }
    assert len(drawn) == 6
    assert not drawn & met


def test_the_parameters_of_the_recording_differ_from_all_targets(tmp_path):
    made = write_calibration_recording(small(), "secret", tmp_path / "a.csv")
    again = write_calibration_recording(small(), "secret", tmp_path / "b.csv")
    other = write_calibration_recording(small(), "another", tmp_path / "c.csv")
    assert made == pytest.approx(again, abs=0)
    assert made[0] != other[0]
    truths = [target.truth[0] for target in draw_targets(TuningProblem(small(), "secret"))]
    assert made[0] not in truths
    # Six runs of 120 samples and two channels determine the noise to a tenth.
    seen = read_recording(tmp_path / "a.csv", simulators.get("bounce-shot")).runs
    world = TuningProblem(small(), "secret").world
    left = [
        run.channels["z"]
        - world.simulate(made[None], replace(make_scenario(run, world, {}), initial={}))[0][:, 1]
        for run in seen
    ]
    assert np.std(np.concatenate(left)) == pytest.approx(0.003, rel=0.1)


def test_both_comparisons_meet_the_same_targets(folder):
    runs = [pd.read_parquet(folder / model / "runs.parquet") for model in MODEL_LABELS]
    truths = [r.drop_duplicates("target").set_index("target")["true_restitution"] for r in runs]
    assert truths[0].equals(truths[1])
    assert set(runs[0]["experiment"]) == {"misspecified-shot-plain"}


def test_what_is_complete_is_taken_up_and_nothing_is_made_again(folder):
    before_it = (folder / "plain" / "runs.parquet").stat().st_mtime_ns
    study = MisspecificationStudy.resume(folder)
    assert study.run(jobs=0).is_complete
    assert (folder / "plain" / "runs.parquet").stat().st_mtime_ns == before_it
    standing = study.status()
    assert standing.is_complete
    assert len(standing.ends) == 2 * 3 * 2
    assert {end.group for end in standing.ends} >= {"plain random", "extended least_squares"}


def test_it_is_reported_in_words_tables_and_figures(folder):
    said = (folder / "said.txt").read_text()
    found = "the true system has restitution.speed -0.1; explain reports named: restitution.speed"
    assert found in said
    assert "Kendall's tau" in said
    for name in ("bias", "prediction", "ranks"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 5000
    compared = simgap.ComparisonResult(folder)
    assert list(compared.tables) == ["table", "ranks", "ranking"]
    assert set(compared.runs["model"]) == set(MODEL_LABELS)
    assert len(compared.statuses) == 12
    with pytest.raises(InputError, match="figures of a study of two comparisons are files"):
        compared.figure("error")
    assert "name one of the two in it" in run_command("verify", folder, code=2).err
    assert "12 of 12 runs finished, complete" in run_command("status", folder).out


def test_failures_count_and_rank_last(folder):
    one = misspecification_statistics.load_scores(folder, small())
    spoilt = one.errors.copy()
    first = (spoilt["model"] == "plain") & (spoilt["tuner"] == "least_squares")
    row = spoilt.index[first][0]
    spoilt.loc[
        row,
        [
            misspecification_statistics.PARAMETERS,
            misspecification_statistics.PREDICTION,
            "restitution",
            "|restitution|",
        ],
    ] = np.nan
    spoilt.loc[row, "failures"] = 1
    broken = replace(one, errors=spoilt)
    ranks = misspecification_statistics.build_rank_table(broken).set_index(["metric", "tuner"])[
        "plain"
    ]
    whole = misspecification_statistics.build_rank_table(one).set_index(["metric", "tuner"])[
        "plain"
    ]
    key = (misspecification_statistics.PARAMETERS, "least_squares")
    assert ranks[key] > whole[key]
    lines = misspecification_statistics.build_score_table(broken)
    counted = lines[(lines["model"] == "plain") & (lines["tuner"] == "least_squares")]
    assert set(counted["failures"]) == {1}
    assert np.isfinite(counted["mean"]).all(), "of the targets that are left"


def test_what_is_tuned_goes_on_being_tuned():
    pendulum = load_experiment("misspecified-pendulum")
    found = {"drag.linear": [6e-4], "spring.linear": [0.03]}
    extended = make_extended_experiment(pendulum, found)
    assert extended.settings["fixed"] == {"spring.linear": [0.03]}
    assert list(extended.settings["effects"]) == ["drag.linear"]
    assert (make_base_experiment(pendulum).calibration, extended.calibration) == (None, None)
    assert (
        TuningProblem(extended).cube.dim
        == TuningProblem(make_base_experiment(pendulum)).cube.dim
        == 2
    )


def test_coefficients_stand_in_the_effects_order(tmp_path):
    file = tmp_path / "extended.toml"
    file.write_text(
        'format = 1\nname = "p_extended"\nsystem = "ball"\nengine = "batch"\nobserve = ["x", "z"]\n'
        '[effects.wind]\ny = {value = 2.0, unit = "m/s"}\ndrag = {value = 0.1, unit = "1/m"}\n'
    )
    found = extending.open_extended(file, simulators.get)[0]
    assert extending.list_effect_coefficients(found, simulators.get("ball")) == {
        "wind": [0.1, 0.0, 2.0]
    }


@pytest.mark.parametrize("name", ["ball", "pendulum", "slider", "servo", "shot"])
def test_worlds_have_what_the_simulators_lack(name):
    experiment = load_experiment(f"misspecified-{name}")
    assert get_study_class(experiment) is MisspecificationStudy
    problem = TuningProblem(experiment)
    target = draw_target(problem, "in", 0)
    point = problem.cube.to_unit_cube(target.truth)[None]
    ours = problem.simulate(point, target.blinded.fitting.scenarios)[0]
    left = (ours - target.blinded.fitting.observed) / problem.noise
    # Without a missing effect, the residual at the true parameters would be noise only (RMS 1).
    assert np.sqrt(np.mean(left**2)) > 3


def test_a_file_may_name_others_with_its_own_numbers(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'simulator = "ball"\ntargets = 9\nbudget = 90\ntuners = ["random"]\n'
    )
    document = {"experiments": ["mine.toml", "misspecified-ball"], "targets": 4, "budget": 5}
    both = parse_experiment("both", document, tmp_path / "both.toml")
    mine, ball = expand_sweep(both)
    assert (mine.name, mine.targets, mine.budget) == ("mine", 4, 5)
    assert [entry.label for entry in mine.tuners] == ["random"], "its own where none are named"
    assert (ball.targets, ball.world["fixed"]) == (4, {"drag.quadratic": 0.1})
    small = expand_sweep(
        parse_experiment("few", {**document, "tuners": ["cma_es"]}, tmp_path / "few.toml")
    )
    assert {entry.label for one in small for entry in one.tuners} == {"cma_es"}
    with pytest.raises(InputError, match=r"experiment both: names .*misspecified-ball; run these"):
        TuningProblem(both)
    (tmp_path / "both.toml").write_text('experiments = ["misspecified-ball"]\n')
    with pytest.raises(InputError, match="names experiments itself"):
        expand_sweep(parse_experiment("all", {"experiments": ["both.toml"]}, tmp_path / "all.toml"))


def test_named_experiments_have_salts_of_their_own(tmp_path):
    document = {
        "experiments": ["misspecified-ball", "misspecified-shot"],
        "targets": 1,
        "seeds": 1,
        "budget": 1,
        "tuners": ["random"],
    }
    begun = begin_studies(
        parse_experiment("two", document, tmp_path / "two.toml"), folder=tmp_path / "out"
    )
    held = [study.configuration.experiment for study in begun]
    assert [study.folder.name for study in begun] == ["misspecified-ball", "misspecified-shot"]
    assert len({one.salt_sha256 for one in held}) == 2, "one that is complete gives away no other's"
    assert all(not one.salt for one in held)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"calibration": {"runs": 2, "held_out": 2}}, "expected fewer than the 2 runs, found 2"),
        ({"calibration": {"runs": 0, "held_out": 0}}, "expected fewer than the 0 runs"),
        ({"calibration": {"run": 3}}, "'run'"),
        ({"calibration": {}, "shot": {"filmed": 0}}, "needs simulated targets, and no shot"),
    ],
)
def test_a_calibration_that_cannot_be_is_refused(tmp_path, change, message):
    document = {"simulator": "ball", "tuners": ["random"], **change}
    with pytest.raises(InputError, match=message):
        parse_experiment("x", document, tmp_path / "x.toml")


def test_targets_that_not_all_have_met_are_left_out(folder):
    one = misspecification_statistics.load_scores(folder, small()).errors
    lacking = one.drop(one.index[(one["target"] == "in-001") & (one["model"] == "extended")][0])
    assert set(misspecification_statistics._select_complete_targets(one)["target"]) == {
        "in-000",
        "in-001",
        "in-002",
    }
    left = misspecification_statistics._select_complete_targets(lacking)
    assert set(left["target"]) == {"in-000", "in-002"}
    assert len(left) == 2 * 2 * 2
    # A target with a missing seed counts as incomplete.
    seeds = one.assign(runs=3)
    seeds.loc[seeds.index[0], "runs"] = 2
    assert set(misspecification_statistics._select_complete_targets(seeds)["target"]) == {
        "in-001",
        "in-002",
    }
