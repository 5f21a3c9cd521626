"""Tests that the pages on results describe all written files, columns and figures, and
no others.
"""

import json
import re

import pandas as pd
import pytest
import tomli_w

from bench.benchmark.comparison_printed_figures import FIGURE_FILES
from bench.benchmark.comparison_study import Comparison
from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.statistics.error_curves import ERROR_METRICS
from bench.benchmark.statistics.paired_tests import PAIR_COLUMNS
from bench.benchmark.statistics.training_amortisation import BREAK_EVEN_COLUMNS
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.bounce_shot.hit_rate_table import RESULT_COLUMNS as SHOT_COLUMNS
from bench.bounce_shot.shot_config import read_shot_config
from bench.bounce_shot.shot_planner import TunedModel
from bench.bounce_shot.shot_sampling import draw_shots
from bench.bounce_shot.shot_storage import get_shot_path, read_shot, store_shot
from sims.core.toml_validation import read_toml
from sims.vision.pinhole_camera import FilmDescription, PinholeCamera, format_camera_file
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.docs.documentation_pages import quoted, section, tables, text_of
from tests.sample_experiments import SPRING, spring_experiment

PAGES = ("results.md", "results-explain.md", "results-films.md")
PAGE = "\n".join(text_of(page) for page in PAGES)
SPRING_PLUGIN = str(PLUGINS / "spring.py")
PARAMETERS, CHANNELS, TUNERS = ("rate", "decay"), ("x",), ("random", "least_squares", "small")
TABLES = (
    "status",
    "training",
    "identifiability",
    "table",
    "ert",
    "pairs",
    "break_even",
    "who_wins",
)
SMALL = {"tuner": "regressor", "options": {"epochs": 2, "points": 20}}


OF_ROBOTS = {"extended.xml", "extended.urdf", "robot"}
"""Files and figures that only the explanation of a robot has."""


def list_documented_names(heading, below=PAGE):
    """Return the names in the first column of the first table below a heading."""
    return [name for row in tables(section(below, heading))[0][1:] for name in quoted(row[0])]


def list_required_names(heading, below=PAGE):
    """Return the names of `list_documented_names` without optional keys."""
    rows = tables(section(below, heading))[0][1:]
    return [
        name
        for row in rows
        if not re.search("left out where|absent if", row[-1])
        for name in quoted(row[0])
    ]


def written_out(names, **placeholders):
    """Replace PARAMETER, CHANNEL and TUNER in names by each of their values."""
    whole = []
    for name in names:
        (mark,) = re.findall("PARAMETER|CHANNEL|TUNER", name) or [None]
        whole += [name.replace(mark, one) for one in placeholders[mark]] if mark else [name]
    return whole


def columns(path):
    """Return the header of a CSV file."""
    return list(pd.read_csv(path, nrows=0).columns)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, spring):
    """Run a comparison of three tuners on two parameters; one of the tuners is learned."""
    experiment = spring_experiment(
        targets=2,
        seeds=1,
        budget=4,
        training_budget=40,
        noise={"x": 0.01},
        held_out={"scenarios": 1},
        tuners={"random": {}, "least_squares": {}, "small": SMALL},
    )
    path = tmp_path_factory.mktemp("results") / "spring"
    comparison = Comparison.begin(prepare_study(experiment, [SPRING_PLUGIN], path, jobs=1))
    comparison.run(jobs=1)
    comparison.report(lambda _: None)
    return path


def test_the_folder_holds_the_files_of_the_page(folder):
    files = {f"{f.name}/" if f.is_dir() else f.name for f in folder.iterdir()}
    assert files == set(list_documented_names("## compare"))


@pytest.mark.parametrize("name", TABLES)
def test_every_column_of_a_table_is_on_the_page_in_this_order(folder, name):
    names = written_out(list_documented_names(f"### `{name}.csv`"), PARAMETER=PARAMETERS)
    assert columns(folder / f"{name}.csv") == names


def test_every_column_of_the_runs_is_on_the_page(folder):
    runs = pd.read_parquet(folder / "runs.parquet")
    names = written_out(
        list_documented_names("### `runs.parquet`"), PARAMETER=PARAMETERS, CHANNEL=CHANNELS
    )
    assert set(names) - set(runs.columns) == {"param_abs_error"}  # for one parameter
    assert set(runs.columns) <= set(names)
    assert len(names) == len(set(names))


def test_every_metric_and_status_is_on_the_page(folder):
    rows = tables(section(PAGE, "### `table.csv`"))[0]
    # The cell of the metrics also names the file that has them as columns.
    (metrics,) = [row[2] for row in rows if row[0] == "`metric`"]
    assert set(quoted(metrics)) - {"runs.parquet"} == set(ERROR_METRICS)
    statuses = tables(section(PAGE, "### `status.csv`"))[1][1:]
    failed = {quoted(row[0])[0] for row in statuses if row[2] != "no"}
    assert failed == set(FAILED_OR_SKIPPED_STATUSES)


def test_the_environment_is_described(folder):
    environment = json.loads((folder / "environment.json").read_text(encoding="utf-8"))
    assert list(environment) == list_documented_names("### `environment.json`")


def test_every_figure_is_described(folder):
    figures = {path.stem for path in (folder / "figures").glob("*.png")}
    names = set(list_documented_names("### Figures of a comparison"))
    assert figures <= names
    # Drawn only for targets from another simulator, beyond the training range, or with sloppy
    # directions.
    assert names - figures <= {"misfit-vs-simulations", "error-vs-distance"}
    rows = tables(section(PAGE, "### Figures of a comparison"))[0][1:]
    assert {quoted(row[1])[0]: quoted(row[0])[0] for row in rows} == FIGURE_FILES


def test_several_comparisons(folder, tmp_path):
    run_command("plot", folder, folder, "--out", tmp_path / "all")
    # The Nemenyi test needs five problems; two are enough for everything else.
    written = {path.name for path in (tmp_path / "all").iterdir() if path.is_file()}
    assert written | {"nemenyi.csv"} == set(list_documented_names("## plot of several comparisons"))
    names = written_out(list_documented_names("### `ranks.csv`"), TUNER=TUNERS)
    assert set(columns(tmp_path / "all" / "ranks.csv")) == set(names)
    assert {*PAIR_COLUMNS, "trusted"} == set(columns(tmp_path / "all" / "pairs.csv"))
    assert {*BREAK_EVEN_COLUMNS, "trusted"} == set(list_documented_names("### `break_even.csv`"))


def test_the_tables_of_the_bounce_shot(tmp_path):
    assert list_documented_names("### `table.csv` of shots") == [*SHOT_COLUMNS, "trusted"]
    experiment = load_experiment("bounce-shot")
    settings = read_shot_config(experiment)
    # A shot without a plan is not executed, but its row has all columns.
    nothing = TunedModel("nominal", 0.5, {}, 0, 0.0, "no plan")
    setup = draw_shots(experiment, settings)[0]
    get_shot_path(tmp_path, setup).parent.mkdir()
    store_shot(tmp_path, setup, settings, [nothing], 1.0)
    (row,) = read_shot(tmp_path, setup)["rows"]
    assert [*row, "trusted"] == list_documented_names("### `shots.csv`")


def test_the_losses_of_a_training(tmp_path, monkeypatch, spring):
    monkeypatch.chdir(tmp_path)
    document = {**SPRING, "training_budget": 40, "targets": 1, "tuners": {"small": SMALL}}
    (tmp_path / "ahead.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    of = ["small", "spring", "--experiment", "ahead.toml", "--plugin", SPRING_PLUGIN]
    run_command("train", *of, "--seeds", "1", "--out", "out")
    assert columns(tmp_path / "out" / "loss.csv") == list_documented_names("### `loss.csv`")
    assert [f.stem for f in (tmp_path / "out" / "figures").glob("*.png")] == ["loss"]


@pytest.fixture(scope="module")
def explained(tmp_path_factory):
    """Simulate a swing with a hidden drag, and run `explain` and `score` on it."""
    folder = tmp_path_factory.mktemp("explained")
    swing, out = folder / "swing.csv", folder / "out"
    hidden = ["--effect", "drag.linear=2e-4", "--noise", "q=0.002", "--rate", "50"]
    run_command("simulate", "pendulum", *hidden, "--runs", "3", "--out", swing)
    run_command("explain", swing, "--out", out)
    return folder


def test_the_parameters_of_a_simulated_recording(explained):
    assert list(read_toml(explained / "swing.truth.toml")) == list_documented_names(
        "### `NAME.truth.toml`"
    )


def test_the_folder_of_an_explanation(explained):
    files = {f.name for f in (explained / "out").iterdir() if f.suffix not in (".png", ".pdf")}
    figures = {f.stem for f in (explained / "out").glob("*.png")}
    assert files | figures | OF_ROBOTS == set(list_documented_names("## explain"))
    assert figures == set(list_documented_names("### Figures of an explanation")) - OF_ROBOTS
    extended = read_toml(explained / "out" / "extended.toml")
    assert set(extended) == set(list_documented_names("### `extended.toml`"))


def test_the_score(explained):
    model, recording = explained / "out" / "extended.toml", explained / "swing.csv"
    assert list(
        json.loads(run_command("score", model, recording, "--json").out)
    ) == list_documented_names("## score")


def test_the_camera_of_a_film(tmp_path):
    path = tmp_path / "film.camera.toml"
    path.write_text(
        format_camera_file(FilmDescription(PinholeCamera(0.0, 5.0, 2.0), 0.1)), encoding="utf-8"
    )
    keys = {f"{table}.{key}" for table, entries in read_toml(path).items() for key in entries}
    assert keys == set(list_documented_names("### `NAME.camera.toml`"))


def test_the_verdict(explained):
    page = text_of("reference/verdict.md")
    answer = json.loads((explained / "out" / "verdict.json").read_text(encoding="utf-8"))
    assert list(answer) == list_required_names("## The keys", page)
    (inertia,) = answer["parameters"].values()
    assert list(inertia) == list_required_names("## An estimate", page)
    assert list(answer["causes"][0]) == list_required_names("## A cause", page)
    assert list(answer["heldout"]) == list_required_names("## The gain on held-out runs", page)
    assert list(answer["candidates"][0]) == list_required_names("## A candidate", page)
