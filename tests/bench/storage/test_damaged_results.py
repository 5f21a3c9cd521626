"""Tests of damaged result folders: each reader gives one line that names the file."""

import shutil

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from bench.api.comparison_result import ComparisonResult
from bench.benchmark.comparison_study import Comparison
from bench.benchmark.runner.experiment_runner import run_experiment
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.statistics.error_curves import ERROR_TABLE_COLUMNS
from bench.benchmark.storage.result_folder import read_checked_comparison, read_comparison
from bench.benchmark.storage.run_journal import RunJournal, read_plan
from bench.benchmark.storage.table_schemas import (
    ERROR_TABLE_COLUMNS as TABLE,
)
from bench.benchmark.storage.table_schemas import (
    IDENTIFIABILITY_COLUMNS,
    RUN_COLUMNS,
    SHOT_TABLE_COLUMNS,
    STATUS_COLUMNS,
    TRAINING_COLUMNS,
    expand_columns,
)
from bench.bounce_shot.hit_rate_table import RESULT_COLUMNS as OF_SHOTS
from sims.core.simulator import InputError
from tests.bench.storage.damaged_files import (
    BOTH,
    DONE,
    HALF,
    JOURNAL,
    PARQUET,
    PLAN,
    ROWS_OF_JOURNAL,
    STATUS_CSV,
    both,
    cell,
    column,
    gone,
    lines,
    rows,
    text,
)
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import spring_experiment

SPRING_PLUGIN = str(PLUGINS / "spring.py")


@pytest.fixture(scope="module")
def folders(tmp_path_factory, spring):
    """Folder with a finished comparison and with one whose runs are all in its journal."""
    experiment = spring_experiment(
        targets=2, seeds=2, budget=3, tuners={"random": {}, "nelder_mead": {"seeds": 1}}
    )
    place = tmp_path_factory.mktemp("damage")
    made = Comparison.begin(prepare_study(experiment, [SPRING_PLUGIN], place / "done", jobs=0))
    made.run(jobs=0)
    begun = Comparison.begin(prepare_study(experiment, [SPRING_PLUGIN], place / "half", jobs=0))
    run_experiment(begun.results, [SPRING_PLUGIN], 0)
    begun.close()
    return place


def by_api(folder):
    """Read the runs with the Python API; return the message like a command."""
    with pytest.raises(InputError) as caught:
        ComparisonResult(folder).runs  # noqa: B018
    return f"simgap: {caught.value}\n"


def command(*arguments):
    return run_command(*arguments, code=2).err


COMMANDS = {
    "status": lambda folder: command("status", folder),
    "plot": lambda folder: command("plot", folder),
    "across": lambda folder: command("plot", folder, folder, "--out", folder / "all"),
    "resume": lambda folder: command("compare", "--resume", folder, "--jobs", 0),
    "api": by_api,
}


def damaged(folders, kind, damage, tmp_path):
    shutil.copytree(folders / kind, tmp_path / kind)
    damage(tmp_path / kind)
    return tmp_path / kind


def is_one_line(message, folder, name):
    assert message.count("\n") == 1
    assert message[:-1].isprintable(), message
    assert 20 < len(message) < 900, message
    assert str(folder / name) in message, message
    assert not (folder / "figures").exists()
    assert not (folder / "all").exists()


@pytest.mark.parametrize("damage", [*DONE, *BOTH])
def test_a_damaged_folder_is_one_line_that_names_the_file(damage, folders, tmp_path):
    act = (DONE | BOTH)[damage]
    folder = damaged(folders, "done", act, tmp_path)
    before = sorted(path.name for path in folder.iterdir())
    for who, does in COMMANDS.items():
        # On resume, an edited experiment.toml is reported as a change, and the folder is named.
        changed = who == "resume" and act.file == "experiment.toml"
        is_one_line(does(folder), folder, "" if changed else act.file)
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.mark.parametrize("damage", [*HALF, *BOTH])
def test_so_is_one_that_is_under_way(damage, folders, tmp_path):
    act = (HALF | BOTH)[damage]
    folder = damaged(folders, "half", act, tmp_path)
    for who in ("status", "resume"):
        is_one_line(COMMANDS[who](folder), folder, act.file)


@pytest.mark.parametrize("damage", ROWS_OF_JOURNAL)
def test_rows_of_a_journal_are_checked_before_more_are_made(damage, folders, tmp_path):
    act = ROWS_OF_JOURNAL[damage]
    folder = damaged(folders, "half", act, tmp_path)
    is_one_line(COMMANDS["resume"](folder), folder, act.file)
    again = RunJournal(folder)  # the folder is not locked
    again.close()


def test_what_is_said_names_file_row_expected_found_and_remedy(folders, tmp_path):
    def read_damaged(act):
        folder = damaged(folders, "done", act, tmp_path)
        with pytest.raises(InputError) as caught:
            read_comparison(folder)
        shutil.rmtree(folder)
        return str(caught.value).removeprefix(str(folder))

    remedy = "; restore the file, or start a new comparison"
    assert read_damaged(cell("loss", 1, -2.0)) == (
        f"/runs.parquet, row 1: loss: expected a number of at least 0, found -2.0{remedy}"
    )
    assert read_damaged(DONE["truncated"]).startswith("/runs.parquet: not a complete comparison: ")
    assert read_damaged(cell("k", 5, 3)).startswith(
        "/runs.parquet, row 5: k: expected 1, the next of ran"
    )
    assert read_damaged(rows(lambda f: f.drop(columns="loss"))).startswith(
        "/runs.parquet: columns: expected one named loss, found 'run, experiment, tuner,"
    )
    quoted = lines(STATUS_CSV, lambda ls: [ls[0], ls[1].replace("done,", 'done,"a\n\nb"'), *ls[2:]])
    assert read_damaged(both(quoted, text(STATUS_CSV, "done,,", "over,,"))) == (
        "/status.csv, line 5: status: expected one of done, converged, crashed, timeout, diverged, "
        f"skipped, found 'over'{remedy}"
    )
    short = both(quoted, lines(STATUS_CSV, lambda ls: [*ls[:-1], "random"]))
    assert read_damaged(short) == f"/status.csv, line 15: expected 10 cells, found 1{remedy}"
    assert read_damaged(lines(STATUS_CSV, lambda ls: ls[:-1])) == (
        f"/status.csv: expected a run of nelder_mead on wide-001 with seed 0, found none{remedy}"
    )


def test_results_of_one_that_is_under_way_are_written_again_by_resuming(folders, tmp_path):
    folder = damaged(folders, "half", lambda _: None, tmp_path)
    for name in (PARQUET, STATUS_CSV, "training.csv"):
        shutil.copy(folders / "done" / name, folder / name)
    assert len(read_comparison(folder).statuses) == 12
    (folder / STATUS_CSV).write_bytes(b"\xff")
    message = COMMANDS["plot"](folder)
    assert message.count("\n") == 1
    assert f"write it again with simgap compare --resume {folder}" in message
    # Its results are not written.
    assert "12 of 12 runs finished\n" in run_command("status", folder, code=1).out
    comparison = Comparison.resume(folder)
    assert comparison.run(jobs=0).is_complete
    assert len(read_checked_comparison(folder).statuses) == 12


def test_without_a_plan_nothing_is_complete(folders, tmp_path):
    folder = damaged(folders, "half", gone(PLAN), tmp_path)
    assert "complete" not in run_command("status", folder, code=1).out
    begun = Comparison.resume(folder)
    begun.close()
    assert len(read_plan(folder)) == 12


def test_a_damaged_journal_that_was_deleted_is_made_again(folders, tmp_path):
    folder = damaged(folders, "half", gone(JOURNAL), tmp_path)
    run_command("status", folder, code=1)
    comparison = Comparison.resume(folder)
    assert comparison.results.run_sink.statuses == {}
    assert comparison.run(jobs=0).is_complete
    assert len(read_comparison(folder).statuses) == 12


def test_tuners_that_were_skipped_have_no_rows(folders, tmp_path):
    folder = damaged(folders, "done", lambda _: None, tmp_path)
    rows(lambda f: f[f["tuner"] != "nelder_mead"])(folder)
    skipped = "nelder_mead,nelder_mead,spring,,0,skipped,no such package,0,0.0,True"
    made = [line for line in (folder / STATUS_CSV).read_text().splitlines() if "nelder" not in line]
    (folder / STATUS_CSV).write_text("\n".join([*made, skipped]) + "\n")
    assert read_comparison(folder).statuses["status"].tolist() == ["done"] * 8 + ["skipped"]
    (folder / STATUS_CSV).write_text(
        f"{made[0]}\n{skipped}\n{skipped.replace('nelder_mead', 'random')}"
    )
    parquet.write_table(pa.table({}), folder / PARQUET)
    assert read_comparison(folder).runs.empty
    run_command("status", folder)


def test_a_column_that_older_folders_lack_has_its_default(folders, tmp_path):
    folder = damaged(folders, "done", lambda _: None, tmp_path)
    assert read_comparison(folder).runs["trusted"].all(), "without workers tuners are trusted"
    rows(lambda f: f.drop(columns="trusted"))(folder)
    lines(STATUS_CSV, lambda ls: [line.rpartition(",")[0] for line in ls])(folder)
    assert not read_comparison(folder).runs["trusted"].any()
    assert not read_comparison(folder).statuses["trusted"].any()
    assert "trusted" not in read_comparison(folder, ["run", "k"]).runs
    column("trusted", True)(folder)
    assert read_comparison(folder).runs["trusted"].all()
    cell("trusted", 1, False)(folder)
    with pytest.raises(InputError, match="row 1: trusted: expected True as in the row before"):
        read_comparison(folder)
    column("trusted", "yes")(folder)
    with pytest.raises(InputError, match="trusted: expected True or False, found a column of type"):
        read_comparison(folder)


def test_a_damaged_table_is_found_where_all_is_checked(folders, tmp_path):
    folder = damaged(folders, "done", lambda _: None, tmp_path)
    (folder / "table.csv").write_text("experiment,tuner\nx,y\n")
    assert len(read_comparison(folder).statuses) == 12, "plot writes it again"
    with pytest.raises(
        InputError,
        match=r"table.csv: columns: .* write it again with simgap "
        "plot ",
    ):
        read_checked_comparison(folder)


def test_what_is_written_is_what_is_declared(folders):
    folder, names = folders / "done", (["rate", "decay"], ["x"])
    runs = parquet.read_schema(folder / PARQUET).names
    optional = {column.name for column in RUN_COLUMNS if not column.required}
    wanted = {column.name for column in expand_columns(RUN_COLUMNS, *names)}
    assert set(runs) <= wanted
    assert wanted - set(runs) <= optional
    for name, declared in (
        ("status", STATUS_COLUMNS),
        ("training", TRAINING_COLUMNS),
        ("identifiability", IDENTIFIABILITY_COLUMNS),
    ):
        written = list(pd.read_csv(folder / f"{name}.csv", nrows=0).columns)
        assert written == [c.name for c in expand_columns(declared, *names)]


def test_tables_are_declared_as_they_are_written():
    assert [column.name for column in TABLE] == [*ERROR_TABLE_COLUMNS, "salt", "trusted"]
    assert [column.name for column in SHOT_TABLE_COLUMNS] == [*OF_SHOTS, "trusted"]
