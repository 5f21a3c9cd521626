"""Tests of bounce-shot studies: Wilson interval, restitution from a filmed drop, shots, command."""

import importlib.util
import json
import math
from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from bench.api.comparison_result import ComparisonResult
from bench.benchmark.problem.experiment_config import list_experiment_names, load_experiment
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from bench.benchmark.runner.worker_pools import PoolLostError
from bench.benchmark.statistics.proportion_interval import compute_proportion_interval
from bench.bounce_shot import drop_tuning, shot_study
from bench.bounce_shot.drop_recording import record_drop
from bench.bounce_shot.drop_tuning import (
    ShotInputs,
    build_pixel_runs,
    select_transferable_effects,
    tune_and_plan,
)
from bench.bounce_shot.hit_rate_table import ALL_BALLS, build_result_table
from bench.bounce_shot.shot_config import read_shot_config
from bench.bounce_shot.shot_execution import execute_shot
from bench.bounce_shot.shot_planner import TunedModel
from bench.bounce_shot.shot_sampling import draw_shot, draw_shots
from bench.bounce_shot.true_world import InclinedGround, simulate_shot
from bench.core.plugin_registries import REGISTRIES
from sims.core.simulator import InputError
from sims.recording.recording import read_recording
from sims.systems.ball import Ball
from tests.command_output import run_command
from tests.conftest import PLUGINS

vision = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("av", "cv2"))),
    reason='PyAV and OpenCV are not installed: pip install -e ".[vision]"',
)


SMALL = """
simulator = "ball"
observe = ["z"]
targets = 1
settings = { engine = "batch" }
tuners = { least_squares = {} }"""

DROPS = """
budget = 6
constants = { gravity = 9.81, radius = 0.03 }
noise = { z = 0.01 }
initial = { z = [1.4, 1.8] }
sampling = { rate = 60.0, samples = 100 }
shot = { balls = ["golf"] }
"""


@pytest.fixture(scope="module")
def experiment():
    return load_experiment("bounce-shot").with_tuners(["least_squares"])


def test_wilson_interval_of_known_counts():
    assert compute_proportion_interval(8, 10) == pytest.approx((0.4901625, 0.9433178), abs=1e-6)
    assert compute_proportion_interval(0, 10) == pytest.approx((0.0, 0.2775328), abs=1e-6)
    assert compute_proportion_interval(50, 50)[1] == 1.0
    exact = binomtest(261, 300).proportion_ci(0.95, method="wilson")
    assert compute_proportion_interval(261, 300) == pytest.approx(
        (exact.low, exact.high), abs=1e-12
    )
    assert all(math.isnan(v) for v in compute_proportion_interval(0, 0))


def test_table_counts_misses_that_never_met_the_plane():
    row = {
        "method": "m",
        "simulations": 10,
        "seconds": 0.1,
        "status": "done",
        "prediction_error": 0.02,
    }
    rows = [
        {**row, "ball": b, "hit": o < 0.15, "off": o}
        for b, o in (("a", 0.1), ("a", 0.2), ("b", 0.05))
    ]
    rows.append(
        {
            **row,
            "ball": "b",
            "hit": False,
            "off": math.nan,
            "prediction_error": math.nan,
            "status": "no plan",
        }
    )
    lines = build_result_table(pd.DataFrame(rows)).set_index("ball")
    assert lines.hits.to_dict() == {"a": 1, "b": 1, ALL_BALLS: 2}
    assert lines.rate[ALL_BALLS] == 0.5
    assert (lines.low[ALL_BALLS], lines.high[ALL_BALLS]) == pytest.approx(
        compute_proportion_interval(2, 4)
    )
    assert lines.off_90[ALL_BALLS] == math.inf
    assert lines.failures.to_dict() == {"a": 0, "b": 1, ALL_BALLS: 1}


def test_what_belongs_to_the_camera_stays_there_and_a_vertical_force_becomes_gravity():
    found = {
        "drag.quadratic": (0.1,), "restitution.speed": (-0.1,),
        "sensor.bias": (0.01,), "clock.skew": (0.01,),
        "force.bias": (0.5,), "wind": (0.1, 1.0, 0.0),
    }  # fmt: skip
    carried = select_transferable_effects(found, 9.81)
    assert carried == {
        "drag.quadratic": (0.1,), "restitution.speed": (-0.1,), "gravity.scale": (-0.5 / 9.81,),
        "wind": (0.1, 1.0, 0.0),
    }  # fmt: skip


def test_deals_do_not_depend_on_methods_or_numbers(experiment):
    settings = read_shot_config(experiment)
    few, many = (draw_shots(replace(experiment, targets=n), settings) for n in (1, 3))
    assert [d.name for d in few] == [f"{ball}-000" for ball in settings.balls]
    assert many[: len(few)] == few
    assert len({d.ball.restitution for d in many}) == len(many)
    assert all(0.7 <= d.scene.hoop_x <= 1.1 and 0.30 <= d.scene.angle <= 0.40 for d in many)


@vision
@pytest.mark.parametrize("kind", ["squash", "golf"])
def test_a_filmed_drop_is_tracked_to_millimetres(experiment, tmp_path, kind):
    """At its bounce, a squash ball touches its shadow, which then moves on as the ball did."""
    settings, path = read_shot_config(experiment), tmp_path / "drop.csv"
    dealt = draw_shot(experiment, settings, kind, 0)
    record_drop(experiment, dealt, settings, path)
    recording = read_recording(path, Ball, whole=True)
    run = recording.runs[0]
    radius = recording.constants["radius"]
    true = simulate_shot(
        dealt.ball,
        InclinedGround(0.0, settings.friction),
        (0.0, 0.0, run.channels["z"][0]),
        run.times,
    )[:, 2]
    rms = float(np.sqrt(np.nanmean((run.channels["z"] - true) ** 2)))
    assert np.isfinite(run.channels["z"]).mean() > 0.95
    assert rms < 4e-3
    assert radius == dealt.ball.radius
    assert recording.noise["z"] < 4e-3
    assert {path.with_suffix(end).is_file() for end in (".mp4", ".camera.toml", ".png")} == {True}


def test_recorded_drop_reads_as_any_recording_of_a_ball(experiment, tmp_path):
    settings, path = replace(read_shot_config(experiment), filmed=0.0), tmp_path / "drop.csv"
    experiment = replace(experiment, noise={"z": 0.01})
    dealt = draw_shot(experiment, settings, "tennis", 0)
    record_drop(experiment, dealt, settings, path)
    record_drop(experiment, dealt, settings, path)  # an existing recording is kept
    recording = read_recording(path, Ball, whole=True)
    z = recording.runs[0].channels["z"]
    assert len(z) == 150
    assert recording.noise == {"z": 0.01}
    assert recording.constants["radius"] == 0.0335
    fall = z[: round(60 * 0.45)]
    t = np.arange(len(fall)) / 60
    assert np.polyfit(t, fall, 2)[0] == pytest.approx(-9.81 / 2, rel=0.06)


@pytest.mark.slow
@vision
def test_on_vision_a_tuner_learns_restitution_from_rows_and_never_where_the_camera_stood(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path / "cache"))
    experiment = load_experiment("bounce-shot").with_tuners(["tunenet-vision", "least_squares"])
    experiment = experiment.chosen(training_budget=400)
    settings, path = read_shot_config(experiment), tmp_path / "drop.csv"
    assert settings.rows == ("tunenet-vision",)
    watching, metres = (
        drop_tuning.make_tuning_experiment(experiment, settings, entry)
        for entry in experiment.tuners
    )
    assert (watching.simulator, watching.observe, metres.simulator) == (
        "ball-filmed",
        ("z", "v"),
        "ball",
    )
    weights = {
        "tunenet-vision": train_or_load(watching, TrainingRequest(experiment.tuners[0], 0)).path
    }
    found = {}
    for kind in ("golf", "squash"):
        dealt = draw_shot(experiment, settings, kind, 0)
        record_drop(experiment, dealt, settings, path)
        seen = build_pixel_runs(read_recording(path, Ball, whole=True), watching, dealt.ball.radius)
        assert not [name for s in seen.scenarios for name in s.constants if "camera" in name]
        assert np.isnan(seen.observed[:, 0]).all()
        # The ball ends on the ground, lower in the image than at its release.
        assert np.isfinite(seen.observed[:, 1]).mean() > 0.9
        assert (
            np.nanmax(seen.observed[:, 1]) - seen.observed[np.isfinite(seen.observed[:, 1])][0, 1]
            > 100
        )
        for left in ("drop.camera.toml", "drop.mp4"):
            (tmp_path / left).unlink()
        known = ShotInputs(dealt.name, path, dealt.scene, weights)
        recording = read_recording(path, Ball, whole=True)
        by_rows, by_metres = (
            drop_tuning._tune_model(experiment, settings, entry, known, recording, {})
            for entry in experiment.tuners
        )
        assert by_rows.restitution == pytest.approx(by_metres.restitution, abs=0.06)
        assert by_rows.simulations <= experiment.budget
        found[kind] = by_rows.restitution
        for left in ("drop.csv", "drop.toml", "drop.png"):
            (tmp_path / left).unlink()
    assert found["golf"] - found["squash"] > 0.2  # the tables give 0.86 and 0.54


@pytest.mark.slow
@vision
def test_a_drop_that_cannot_be_tracked_is_a_row_and_not_the_end(experiment, tmp_path):
    """In a film with a height of 16 pixels, a golf ball covers a fifth of a pixel."""
    text = f"""{SMALL}
budget = 2
sampling = {{ rate = 60.0, samples = 60 }}
shot = {{ balls = ["golf"], filmed = 16 }}
"""
    (tmp_path / "small.toml").write_text(text)
    out = tmp_path / "out"
    said = run_command("compare", tmp_path / "small.toml", "--jobs", 1, "--out", out).out
    rows = pd.read_csv(out / "status.csv")
    assert set(rows["status"]) == {"no recording"}
    assert rows["reason"].str.contains("no ball found").all()
    assert not pd.read_csv(out / "shots.csv")["hit"].any()
    assert pd.read_csv(out / "shots.csv")["seen"].eq(0).all()
    assert "no recording: least_squares in 1 shots" in said


def test_methods_get_the_recording_and_the_scene_and_not_the_ball():
    known = {"name", "recording", "scene", "weights"}
    assert {f.name for f in fields(ShotInputs)} == known | {"tuned", "hidden"}, (
        "and who, and where not"
    )


def test_untuned_misses_where_restitution_differs_and_tuned_hits(experiment, tmp_path, monkeypatch):
    """A failure of explain becomes a row of the table and does not stop the study."""

    def broken(_):
        return TunedModel("explain", 0.5, {}, 0, 0.0, "crashed", "no"), {}

    monkeypatch.setattr(drop_tuning, "_explain_drop", broken)
    settings = read_shot_config(experiment)
    dealt = draw_shot(experiment, settings, "rubber", 1)
    path = tmp_path / "drop.csv"
    record_drop(experiment, dealt, settings, path)
    made = {
        model.method: model
        for model in tune_and_plan(experiment, settings, ShotInputs("x", path, dealt.scene, {}))
    }
    assert list(made) == ["nominal", "least_squares", "explain"]
    assert made["nominal"].restitution == 0.5
    assert made["least_squares"].restitution == pytest.approx(dealt.ball.restitution, abs=0.03)
    assert made["least_squares"].simulations <= experiment.budget
    untuned, tuned = (execute_shot(dealt, settings, made[m]) for m in ("nominal", "least_squares"))
    assert not untuned.is_hit
    assert untuned.miss_distance > 0.5
    assert tuned.is_hit
    assert tuned.prediction_error < 0.04 < untuned.prediction_error
    assert math.isnan(made["explain"].height)
    perfect = replace(made["least_squares"], height=math.nan)
    assert not execute_shot(dealt, settings, perfect).is_hit


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hoop": 1}, "unknown entry of .shot. in experiment bounce-shot 'hoop'; did you mean "),
        ({"balls": ["moon"]}, "unknown ball 'moon'"),
        ({"angle": 0.3}, r"shot.angle: expected \[low, high\], found 0.3"),
        ({"hoop_x": [2, 1]}, "expected 0 <= low <= high"),
        (
            {"rows": ["tunenet-visoin"], "filmed": 320},
            "unknown tuner in shot.rows of experiment bounce-shot 'tunenet-v",
        ),
        ({"rows": ["tunenet-vision"], "filmed": 0}, "shot.rows: only a film has pixel rows"),
        ({"balls": []}, "shot.balls: expected at least one ball"),
        ({"release": "small"}, "shot.release: expected a number of at least 0, found 'small'"),
    ],
)
def test_faults_of_the_table_are_one_line(experiment, change, message):
    with pytest.raises(InputError, match=message):
        read_shot_config(replace(experiment, shot=change))


def test_world_that_cannot_be_had_is_skipped_with_its_reason(experiment, tmp_path, monkeypatch):
    monkeypatch.setattr(
        shot_study.true_world, "find_missing_requirement", lambda: "the world needs mujoco"
    )
    assert (
        "skipped: the world needs mujoco"
        in run_command("compare", "bounce-shot", "--out", tmp_path / "out").out
    )


@pytest.mark.long
def test_command_from_recorded_drop_to_table_and_again_from_what_is_kept(tmp_path):
    assert "bounce-shot" in list_experiment_names()
    (tmp_path / "mine.toml").write_text(SMALL + DROPS)
    out = tmp_path / "out"
    run_command("compare", tmp_path / "mine.toml", "--jobs", "1", "--out", out)
    lines = pd.read_csv(out / "table.csv").set_index(["method", "ball"])
    assert list(lines.index.unique("method")) == [
        "nominal",
        "least_squares",
        "explain",
        "least_squares + explain",
    ]
    assert lines.loc[("least_squares", "golf"), "shots"] == 1
    assert lines.loc[("least_squares", ALL_BALLS), "simulations"] <= 6
    assert set(pd.read_csv(out / "status.csv")["status"]) <= {"done", "converged"}
    for figure in ("success", "off", "shots"):
        assert (out / "figures" / f"{figure}.png").stat().st_size > 10_000
        assert not (out / "figures" / f"{figure}.pdf").exists()
    assert (out / "figures" / "shot.gif").stat().st_size > 10_000
    kept = (out / "shots" / "golf-000.json").read_text()
    assert {row["method"] for row in json.loads(kept)["rows"]} == set(lines.index.unique("method"))
    before = (out / "table.csv").read_text()
    run_command("compare", "--resume", out)
    assert (out / "shots" / "golf-000.json").read_text() == kept
    assert (out / "table.csv").read_text() == before
    assert "1 of 1 shots made, complete" in run_command("status", out).out
    (out / "shots" / "golf-000.json").write_text("{")
    assert "damaged; delete it" in run_command("compare", "--resume", out, code=2).err


def explained(_):
    return TunedModel("explain", 0.5, {}, 0, 0.0, "done"), {}


@pytest.fixture
def crashing(tmp_path, monkeypatch, fresh_registries):
    """Return the arguments of a study with a failing tuner; explain and figures are stubs."""
    monkeypatch.setattr(drop_tuning, "_explain_drop", explained)
    monkeypatch.setattr("bench.bounce_shot.shot_report.draw_figures", lambda *_: {})
    monkeypatch.setattr("bench.bounce_shot.shot_report.write_animation", lambda *_: "animation")
    path = tmp_path / "mine.toml"
    path.write_text(
        SMALL.replace("least_squares = {}", "least_squares = {}, crashing = {}") + DROPS
    )
    return [str(path), "--plugin", str(PLUGINS / "awkward.py"), "--jobs", "0"]


def test_without_workers_failures_count_unless_allowed_and_it_is_plotted_again(crashing, tmp_path):
    out = tmp_path / "out"
    said = run_command("compare", *crashing, "--out", out, code=1)
    assert "crashed: crashing in 1 shots; RuntimeError: boom" in said.out
    assert said.err.count("RuntimeError: boom") == 2, "as it is and after explain, when it happens"
    run_command("compare", *crashing, "--allow-failures", "--out", tmp_path / "allowed")
    table = (out / "table.csv").read_bytes()
    (out / "table.csv").unlink()
    run_command("plot", out, "--plugin", crashing[2])
    assert (out / "table.csv").read_bytes() == table
    said = run_command("status", out, "--runs").out
    assert "mine: 1 of 1 shots made, complete" in said
    assert "  golf  1 made" in said
    assert "made       golf-000" in said
    said = run_command("plot", out, out, "--out", tmp_path / "across", code=2).err
    assert f"{out}: expected the folder of a comparison, found a bounce shot" in said
    assert (
        f"simgap: --out {out}: exists and is not empty"
        in run_command("compare", *crashing, "--out", out, code=2).err
    )


def test_a_damaged_shot_is_one_line_whoever_reads_it(crashing, tmp_path):
    out = tmp_path / "out"
    run_command("compare", *crashing, "--out", out, code=1)
    path = out / "shots" / "golf-000.json"
    sound = path.read_text()

    def change_stored_value(where, row, key, value):
        held = json.loads(sound)
        held[where][row][key] = value
        return json.dumps(held)

    for text, says in (
        ("[]", "damaged; delete it"),
        ('{"models": [], "rows": 3}', "damaged; delete it"),
        (sound.replace('"hit"', '"hot"', 1), ", 1: columns: expected one named hit"),
        (
            change_stored_value("models", 1, "status", "perfect"),
            ", 2: status: expected one of done, conv",
        ),
        (
            change_stored_value("models", 0, "height", "high"),
            ", 1: height: expected a number of at least 0",
        ),
        (
            change_stored_value("models", 0, "effects", {"drag": ["x"]}),
            ", 1: effects: expected a number, fo",
        ),
        (
            change_stored_value("rows", 2, "simulations", -1),
            ", 3: simulations: expected a whole number of at",
        ),
        (
            change_stored_value("rows", 0, "seen", 1.5),
            ", 1: seen: expected a number from 0 to 1, found 1.5",
        ),
        (change_stored_value("rows", 0, "hit", 1), ", 1: hit: expected True or False, found 1"),
        (
            change_stored_value("rows", 0, "shot", "golf-001"),
            "expected a row of golf-000 for each model",
        ),
    ):
        path.write_text(text)
        for arguments in (["status"], ["plot"], ["compare", "--resume"]):
            said = run_command(*arguments, out, code=2).err
            assert str(path) in said
            assert says in said
            assert said.count("\n") == 1
    path.write_text(sound)
    run_command("status", out)
    for name in ("shots", "table", "status"):
        table = out / f"{name}.csv"
        kept = table.read_text()
        table.write_text(kept.replace(",", ";"))
        with pytest.raises(InputError, match=rf"{name}.csv: columns: expected one named"):
            _ = [
                ComparisonResult(out).runs,
                ComparisonResult(out).table,
                ComparisonResult(out).statuses,
            ]
        table.write_text(kept)
    assert ComparisonResult(out).runs["hit"].dtype == bool


def test_interrupted_it_is_resumed_with_its_own_plugins_and_what_changed_is_refused(
    crashing, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    path = tmp_path / "mine.toml"
    path.write_text(path.read_text().replace("targets = 1", "targets = 2"))
    shoot = drop_tuning.tune_and_plan

    def interrupted(experiment, settings, known):
        if known.name.endswith("001"):
            raise KeyboardInterrupt
        return shoot(experiment, settings, known)

    monkeypatch.setattr(drop_tuning, "tune_and_plan", interrupted)
    said = run_command("compare", *crashing, "--out", out, code=130)
    assert "simgap: interrupted; 1 of 2 shots are made and stored" in said.err
    assert f"simgap: to finish: simgap compare --resume {out}" in said.err
    assert len(pd.read_csv(out / "status.csv")) == 6, "what there is is reported"
    assert "missing    golf-001" in run_command("status", out, code=1).out
    monkeypatch.setattr(drop_tuning, "tune_and_plan", shoot)
    first = (out / "shots" / "golf-000.json").read_bytes()

    def resumed(*options, code=0):
        return run_command("compare", "--resume", out, "--jobs", 0, *options, code=code).err

    assert "leave out budget" in resumed("--budget", 5, code=2)
    with monkeypatch.context() as patch:
        patch.setattr(
            "bench.benchmark.runner.run_fingerprint.hash_source_folders", lambda *_: "0123456789"
        )
        assert "its code changed since it was started" in resumed(code=2)
    for registry in REGISTRIES:
        registry.restore({})
    resumed("--allow-failures")  # the plugin is known from the folder
    assert (out / "shots" / "golf-000.json").read_bytes() == first
    assert len(pd.read_csv(out / "status.csv")) == 12


def test_what_is_lost_on_the_way_is_said_and_no_untrained_tuner_is_shot_with(
    tmp_path, monkeypatch, fresh_registries
):
    """A lost pool leaves a folder to resume; a failed training ends the study."""

    class Gone:
        def __init__(self, error):
            self._error = error

        def load_plugins(self, plugins):
            pass

        def iterate_results(self, calls, seconds):
            if isinstance(self._error, PoolLostError):
                raise self._error
            yield 0, self._error

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

    path = tmp_path / "mine.toml"
    path.write_text(SMALL.replace("least_squares = {}", "regressor = {}") + DROPS)
    begun = shot_study.BounceShotStudy.begin(
        prepare_study(load_experiment(str(path)), folder=tmp_path / "out", jobs=1)
    )
    made = begun.run(jobs=1, pool=Gone(PoolLostError("the scheduler cannot be reached")))
    assert (made.finished, made.planned, made.stopped) == (0, 1, "the scheduler cannot be reached")
    said = []
    assert begun.report(said.append) == 0
    assert said == ["no shot was made"]
    with pytest.raises(RuntimeError, match="cannot learn"):
        begun.run(jobs=1, pool=Gone(RuntimeError("cannot learn")))
