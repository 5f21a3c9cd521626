"""Tests of `simgap verify`: results follow from salt and rows; changed results are detected."""

import json
import os
import shutil
import stat

import pandas as pd
import pytest
import tomli_w

from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.storage.result_folder import read_configuration
from bench.figures.figure_layout import TRUSTED_TUNERS_NOTE
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import undrawn

SECRET = "a secret of the tests"
PLUGIN = ["--plugin", str(PLUGINS / "spring.py")]


@pytest.fixture(scope="module")
def finished_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verify")
    document = {
        **SPRING, "salt": "", "targets": 2, "seeds": 1, "budget": 5, "noise": {"x": 0.01},
        "held_out": {"scenarios": 1}, "tuners": ["random", "least_squares"],
    }  # fmt: skip
    (folder / "e.toml").write_text(tomli_w.dumps(document))
    command = ["compare", str(folder / "e.toml"), *PLUGIN, "--jobs", "1", "--salt", SECRET]
    with undrawn():
        run_command(*command, "--out", folder / "out")
    return folder / "out"


@pytest.fixture
def folder(finished_folder, tmp_path):
    shutil.copytree(finished_folder, tmp_path / "copy")
    return tmp_path / "copy"


def verified(folder, *options, code=0):
    """Return all that the verification of a folder prints."""
    return "".join(run_command("verify", folder, *options, code=code))


def test_what_was_made_follows(finished_folder):
    said = verified(finished_folder)
    assert "the salt has the SHA-256 that was committed" in said
    assert "4 targets drawn again, 48 rows compared" in said
    assert "48 of 48 rows simulated again" in said
    assert said.endswith("all results are reproducible\n")
    held = read_configuration(finished_folder).experiment
    assert (held.salt, held.trusted) == (SECRET, False)
    assert set(pd.read_csv(finished_folder / "table.csv")["salt"]) == {"secret"}
    assert "process" in json.loads((finished_folder / "environment.json").read_text())["seals"]


def changed_rows(folder, column, change, where=slice(None)):
    path = folder / "runs.parquet"
    rows = pd.read_parquet(path)
    rows.loc[where, column] = change(rows.loc[where, column])
    rows.to_parquet(path, index=False)


def half(rows):
    return rows / 2


@pytest.mark.parametrize(
    ("column", "where"),
    [
        ("true_rate", slice(None)),
        ("param_error", slice(None)),
        ("param_error", slice(7, 7)),
        ("outside", slice(12, 23)),
        ("loss", slice(3, 3)),
        ("obs_error", slice(9, 9)),
        ("heldout_error", slice(20, 20)),
    ],
)
def test_a_number_that_was_made_better_does_not_follow(folder, column, where):
    changed_rows(folder, column, half, where)
    said = verified(folder, "--all", code=1)
    assert column in said
    row = int(said.split("runs.parquet, row ")[1].split(":")[0])
    assert (where.start or 0) < row


def test_a_table_that_does_not_come_of_the_rows(folder):
    lines = pd.read_csv(folder / "table.csv", keep_default_na=False)
    lines.loc[2, "mean"] = float(lines.loc[2, "mean"]) / 2
    lines.to_csv(folder / "table.csv", index=False)
    said = verified(folder, code=1)
    assert f"{folder}/table.csv, row 4: mean: expected" in said


@pytest.mark.parametrize("old", [SECRET, "salt_sha256 = "])
def test_another_salt_is_refused(folder, old):
    path = folder / "experiment.toml"
    text = path.read_text()
    place = text.index(old) + len(old) + (1 if old.endswith(" ") else -1)
    other = "0" if text[place] != "0" else "1"
    path.write_text(text[:place] + other + text[place + 1 :])
    said = verified(folder, code=2)
    assert "one of the two was changed" in said


@pytest.mark.usefixtures("undrawn")
def test_the_salt_is_for_the_owner_alone_until_the_end_and_a_resumed_folder_goes_on_with_it(
    finished_folder, tmp_path, monkeypatch
):
    from bench.benchmark.comparison_study import Comparison
    from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment

    held = read_configuration(finished_folder)
    experiment = held.experiment.chosen(salt="", salt_sha256="")
    load_plugins_for_experiment(held.plugins, experiment)
    begun = Comparison.begin(prepare_study(experiment, held.plugins, tmp_path / "out", 1, SECRET))
    begun.close()
    kept = tmp_path / "out" / "segments" / "salt"
    assert kept.read_text() == SECRET
    assert stat.S_IMODE(os.stat(kept).st_mode) == 0o600
    text = (tmp_path / "out" / "experiment.toml").read_text()
    assert SECRET not in text
    assert held.experiment.salt_sha256 in text
    verified(tmp_path / "out", code=2)
    run_command("compare", "--resume", tmp_path / "out", "--jobs", "1")
    assert not kept.exists()
    columns = [f"true_{name}" for name in ("rate", "decay")]
    pd.testing.assert_frame_equal(
        *(pd.read_parquet(f / "runs.parquet")[columns] for f in (finished_folder, tmp_path / "out"))
    )


def test_a_folder_whose_salt_is_gone_is_not_resumed(finished_folder, tmp_path):
    from bench.benchmark.comparison_study import Comparison
    from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment

    held = read_configuration(finished_folder)
    load_plugins_for_experiment(held.plugins, held.experiment)
    begun = Comparison.begin(
        prepare_study(
            held.experiment.chosen(salt="", salt_sha256=""),
            held.plugins,
            tmp_path / "out",
            1,
            SECRET,
        )
    )
    begun.close()
    for content in (None, "another"):
        kept = tmp_path / "out" / "segments" / "salt"
        kept.unlink() if content is None else kept.write_text(content)
        said = run_command("compare", "--resume", tmp_path / "out", code=2).err
        assert str(kept) in said
        assert SECRET not in said


def test_a_salt_in_addition_to_the_experiments_own_is_refused(tmp_path):
    (tmp_path / "e.toml").write_text(tomli_w.dumps(SPRING))
    command = ["compare", str(tmp_path / "e.toml"), *PLUGIN, "--out", str(tmp_path / "out")]
    assert "states a public salt" in run_command(*command, "--salt", "another", code=2).err
    assert not (tmp_path / "out").exists()


def test_isolation_of_this_machine_and_of_a_folder_is_printed(finished_folder):
    said = run_command("status").out
    assert "process    active" in said
    said = run_command("status", finished_folder).out
    assert "isolated: a process for each run" in said
    assert "revealed" in said


@pytest.mark.slow
def test_trusted_runs_are_marked_in_every_table_and_figure(tmp_path, monkeypatch):
    (tmp_path / "e.toml").write_text(
        tomli_w.dumps({**SPRING, "targets": 2, "seeds": 1, "budget": 3, "tuners": ["random"]})
    )
    titles = []
    from bench.figures import figure_output

    plain = figure_output.render_png
    monkeypatch.setattr(
        figure_output,
        "render_png",
        lambda f, dpi=figure_output.DPI: titles.append(f.get_suptitle()) or plain(f, 40),
    )
    command = ["compare", str(tmp_path / "e.toml"), *PLUGIN, "--out", str(tmp_path / "out")]
    said = run_command(*command, "--trust", "--jobs", "1").out
    assert TRUSTED_TUNERS_NOTE in said
    assert "public salt" in said
    assert titles
    assert all(title.endswith("(trusted)") for title in titles), titles
    for path in sorted((tmp_path / "out").glob("*.csv")):
        if path.name != "identifiability.csv":  # this file does not depend on a tuner
            assert pd.read_csv(path).get("trusted", pd.Series([False])).all(), path.name
    assert pd.read_parquet(tmp_path / "out" / "runs.parquet")["trusted"].all()
    assert (
        "trusted: its tuners run without isolation" in run_command("status", tmp_path / "out").out
    )
