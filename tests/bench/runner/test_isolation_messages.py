"""Tests of messages about isolation: errors it causes, discarded files and import times."""

import csv

import pytest
import tomli_w

from bench.benchmark.isolation.process_errors import ISOLATION_NOTE
from bench.benchmark.problem.experiment_config import TunerEntry
from bench.benchmark.runner.tuner_author_notes import Notes
from bench.cli.main import main
from tests.bench.isolation.isolated_process import experiment, need, outcome
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING

pytestmark = pytest.mark.usefixtures("undrawn", "spring", "fresh_registries")

REFUSED = ("reads_beside", "reads_here", "starts_program", "starts_pool", "asks_server")


def compared(tmp_path, capsys, tuners, plugin, *options, targets=1):
    """Run `simgap compare`; return its output and the reasons of status.csv by tuner."""
    changes = {"targets": targets, "seeds": 1, "budget": 3, "ranges": ["in"]}
    path = tmp_path / "e.toml"
    path.write_text(tomli_w.dumps({**SPRING, **changes, "tuners": {name: {} for name in tuners}}))
    plugins = ["--plugin", str(PLUGINS / "spring.py"), "--plugin", str(plugin)]
    out = tmp_path / "out"
    main(["compare", str(path), *plugins, "--jobs", "1", "--out", str(out), *options])
    with (out / "status.csv").open() as file:
        return capsys.readouterr().out, {
            row["tuner"]: row["reason"] for row in csv.DictReader(file)
        }


def test_errors_of_isolation_say_so_and_others_do_not(tmp_path, capsys):
    for seal in ("files", "calls"):
        need(seal)
    tuners = [*REFUSED, "mistaken", "keeps_log"]
    said, reasons = compared(tmp_path, capsys, tuners, PLUGINS / "isolated.py")
    assert ISOLATION_NOTE.endswith("use --trust while developing")
    for name in REFUSED:
        assert reasons[name].endswith(f"; {ISOLATION_NOTE}"), reasons[name]
    assert reasons["mistaken"].endswith("ValueError: no PermissionError\n")
    assert f"\n{', '.join(REFUSED)}: {ISOLATION_NOTE}\n" in said
    assert said.count(ISOLATION_NOTE) == 1
    assert said.endswith(
        "\n2 files written by tuner keeps_log (log.txt, out/points.csv) were discarded with its "
        "sandbox\n"
    )


def test_a_trusted_tuner_gets_no_message_about_isolation(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tuners, plugin = ["reads_here", "keeps_log"], PLUGINS / "isolated.py"
    said, reasons = compared(tmp_path, capsys, tuners, plugin, "--trust")
    assert "No such file or directory" in reasons["reads_here"]
    assert ISOLATION_NOTE not in said + reasons["reads_here"]
    assert "discarded" not in said
    assert (tmp_path / "log.txt").exists()


@pytest.mark.parametrize("isolation", ["run", "tuner"])
def test_slow_imports_are_measured_and_a_shared_process_suggested(
    isolation, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("bench.benchmark.runner.tuner_author_notes.SLOW_IMPORTS", 0.25)
    slow = tmp_path / "slow.py"
    text = (PLUGINS / "isolated.py").read_text()
    slow.write_text(f"import time\n\ntime.sleep(0.3)\n{text[text.index('import') :]}")
    said, _ = compared(tmp_path, capsys, ["keeps_log"], slow, "--isolation", isolation, targets=2)
    lines = [line for line in said.splitlines() if "its imports take" in line]
    assert len(lines) == (isolation == "run")
    for line in lines:
        assert line.startswith("tuner keeps_log: its imports take 0."), line
        assert line.endswith(
            "in each of 2 runs; with --isolation tuner, all runs of one seed share them"
        )


def test_a_plugin_that_reads_a_file_on_import_is_refused_with_the_reason(tmp_path):
    need("files")
    plugin = tmp_path / "reads.py"
    (tmp_path / "weights.txt").write_text("1")
    plugin.write_text(
        "from pathlib import Path\n\nfrom simgap import Tuner\n\n"
        "weights = Path(__file__).with_name('weights.txt').read_text()\n"
    )
    error = run_command(
        "compare", "ball-drop", "--plugin", plugin, "--tuners", "random", code=2
    ).err
    assert error.count("\n") == 1
    assert "PermissionError" in error
    assert error.endswith(f"; {ISOLATION_NOTE}\n")


def test_files_count_once_where_a_process_serves_several_runs():
    made = experiment("logging", isolation="tuner")
    notes = Notes("tuner")
    for target in (0, 1):
        notes.add("logging", outcome(made, 0, target))
    assert notes.lines() == [
        "2 files written by tuner logging (log.txt, second.txt) were discarded with its sandbox"
    ]


@pytest.mark.parametrize(
    ("message", "files", "names"),
    [
        ('{"count": 1e999, "names": []}', 0, ()),
        ('{"count": -3, "names": ["a"]}', 0, ()),
        ('{"count": 2, "names": {"a": 1}}', 0, ()),
        ('{"count": 2, "names": ["a\\n\\u001b[2J", 7]}', 2, ("a \ufffd[2J", "7")),
        ('{"count": 99999999999, "names": []}', 1_000_000, ()),
        ("[", 0, ()),
    ],
)
def test_what_a_process_says_of_its_files_is_no_more_than_a_line(message, files, names):
    made = experiment("boasting").chosen(
        tuners=(TunerEntry("boasting", "boasting", {"message": message}),)
    )
    ended = outcome(made)
    assert ended.trace.status == "converged"
    assert tuple(ended.written) == (files, names)
