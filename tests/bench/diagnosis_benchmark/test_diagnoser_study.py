"""Tests of a comparison of diagnosers: plugins, rule violations and stored files."""

import csv
import json
import shutil
from pathlib import Path

import pytest

import simgap
from bench.benchmark.problem.experiment_config import load_experiment
from bench.core.plugin_registries import REGISTRIES
from bench.diagnosis_benchmark.answer_store import ANSWERS_FILE, AnswerStore, read_answers
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    RequestedConditions,
)
from bench.diagnosis_benchmark.case_set import CaseSpec, build_case_set, read_config
from sims.core.simulator import InputError
from tests.command_output import run_command

PLUGIN = Path(__file__).with_name("plugin.py")
TOML = """
budget = 60
timeout = 4.0
salt = "public"
[diagnosis]
diagnosers = [{diagnosers}]
[[diagnosis.questions]]
kind = "clean"
systems = ["slider"]
[[diagnosis.questions]]
kind = "single"
systems = ["slider"]
effects = ["drag.linear"]
sizes = [8.0]
rates = [50]
runs = [3]
"""
MISBEHAVING = ("peeks", "hangs", "crashes", "spends", "lies")


def compare(*arguments, code=0):
    """Run the command as in a separate process: registered plugins are removed afterwards."""
    before = [registry.snapshot() for registry in REGISTRIES]
    try:
        return run_command("compare", *arguments, code=code)
    finally:
        for registry, snapshot in zip(REGISTRIES, before, strict=True):
            registry.restore(snapshot)


@pytest.fixture
def undrawn(monkeypatch):
    """Disable the figures, which have tests of their own."""
    monkeypatch.setattr("bench.diagnosis_benchmark.diagnoser_report.draw_figures", lambda *_: {})


def written(folder, *diagnosers, more=""):
    path = folder / "tiny.toml"
    names = ", ".join(f'"{name}"' for name in diagnosers)
    path.write_text(TOML.format(diagnosers=names) + more)
    return path


def items(folder):
    with (folder / "items.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished_study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnosis")
    path = written(folder, "fifteen", *MISBEHAVING)
    out = folder / "out"
    knowing = folder / "knowing.py"
    knowing.write_text(PLUGIN.read_text().replace('WHERE = "/tmp"', f"WHERE = {str(out)!r}"))
    compare(path, "--plugin", knowing, "--out", out, "--jobs", 1, code=1)
    return out


def test_a_diagnoser_of_a_plugin_file_is_in_the_table(finished_study):
    out = finished_study
    own = [row for row in items(out) if row["diagnoser"] == "fifteen"]
    assert [row["status"] for row in own] == ["done", "done"]
    assert all(0 < int(row["simulations"]) <= 6 for row in own)
    with (out / "table.csv").open() as file:
        lines = {(row["diagnoser"], row["metric"]): row for row in csv.DictReader(file)}
    assert lines["fifteen", "false alarms"]["of"] == "1"
    assert lines["fifteen", "named, alone"]["of"] == "1"


def test_a_diagnoser_cannot_read_the_hidden_causes(finished_study):
    out = finished_study
    peeks = [row for row in items(out) if row["diagnoser"] == "peeks"]
    assert {(row["status"], row["verdict"]) for row in peeks} == {("done", "adequate")}


@pytest.mark.usefixtures("undrawn")
def test_a_trusted_diagnoser_could_read_the_hidden_causes(finished_study, tmp_path):
    out = finished_study
    path, knowing = written(tmp_path, "peeks"), out.parent / "knowing.py"
    given = ["--plugin", str(knowing), "--out", str(tmp_path / "out"), "--jobs", "0"]
    compare(path, *given)
    rows = items(tmp_path / "out")
    assert {(row["verdict"], row["trusted"]) for row in rows} == {("unknown", "True")}


def test_failed_answers_stay_in_the_table_and_stop_no_other(finished_study):
    out = finished_study
    rows = {row["diagnoser"]: row for row in items(out) if row["kind"] == "single"}
    assert rows["hangs"]["status"] == "timeout"
    assert rows["crashes"]["status"] == "crashed"
    assert rows["crashes"]["reason"] == "RuntimeError: no idea"
    assert "simulations requested, 60 are allowed" in rows["spends"]["reason"]
    assert "impossible number of simulations" in rows["lies"]["reason"]
    assert {rows[name]["outcome"] for name in ("hangs", "crashes", "spends", "lies")} == {"failed"}
    clean = {row["diagnoser"]: row for row in items(out) if row["kind"] == "clean"}
    assert clean["hangs"]["alarm"] == "True"  # a missing answer is not reliable


def test_python_reads_the_folder_of_the_command(finished_study):
    out = finished_study
    run = simgap.ComparisonResult(out)
    assert len(run.runs) == 2 * (1 + len(MISBEHAVING))
    assert run.runs["alarm"].dtype == bool
    status = run.statuses.set_index(["diagnoser", "question"])["status"]
    assert set(status["hangs"]) == {"timeout"}
    best = run.summary()
    assert set(best["diagnoser"]) == {"fifteen", *MISBEHAVING}
    assert best.set_index("diagnoser").loc["hangs", "without an answer"] == 1.0
    wrong = run.tables["failures"]
    assert set(wrong["right_by"][wrong["diagnoser"] == "hangs"]) == {"peeks", "nobody"}
    assert "12 answers, 8 of them failed or skipped" in repr(run)
    with pytest.raises(InputError, match="figures of a comparison of diagnosers are files"):
        run.figure("board")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Without an answer (crashed, too late or too costly): crashes 2, hangs 2" in page
    assert str(out) in page


def test_a_damaged_table_is_one_line(finished_study, tmp_path):
    out = finished_study
    folder = tmp_path / "copy"
    shutil.copytree(out, folder)
    table = folder / "items.csv"
    table.write_text(table.read_text().replace(",True,", ",maybe,"))
    with pytest.raises(InputError, match=r"items.csv, line \d+: .*True or False.*maybe"):
        simgap.ComparisonResult(folder).runs  # noqa: B018


@pytest.mark.usefixtures("undrawn")
def test_cases_a_diagnoser_does_not_support_count_nowhere(tmp_path):
    path, out = written(tmp_path, "fifteen", "declines"), tmp_path / "out"
    given = ["--plugin", str(PLUGIN), "--out", str(out), "--jobs", "0"]
    said = "declines does not support 2 of the cases: it knows no sliders"
    assert said in compare(path, *given).out
    run = simgap.ComparisonResult(out)
    rows = run.runs.set_index("diagnoser")
    assert set(rows.loc["declines", "outcome"]) == {"skipped"}
    counted = run.table.set_index(["diagnoser", "metric"])["of"]
    assert counted["declines", "false alarms"] == counted["declines", "without an answer"] == 0
    assert counted["fifteen", "false alarms"] == 1
    assert "declines" not in set(run.tables["failures"]["diagnoser"])
    page = (out / "report.html").read_text(encoding="utf-8")
    assert f"{said}." in page


@pytest.mark.usefixtures("undrawn")
def test_a_study_resumes(finished_study, tmp_path):
    path = written(tmp_path, "fifteen")
    out = tmp_path / "out"
    given = ["--plugin", str(PLUGIN), "--jobs", "1"]
    compare(path, "--out", out, *given)
    lines = (out / ANSWERS_FILE).read_text().splitlines(keepends=True)
    (out / ANSWERS_FILE).write_text(lines[0] + lines[1][:40])  # as if the run had been killed
    assert "1 of 2 answers given" in run_command("status", out, code=1).out
    compare("--resume", out, "--jobs", 1)
    assert set(read_answers(out)) == {"clean/slider/0", "single/slider/drag.linear/8/50/3/0"}
    first = json.loads(lines[0])
    again = read_answers(out)[first["question"]]["rows"]["fifteen"]
    assert again == first["rows"][0]  # and was not evaluated again
    (said,) = json.loads(run_command("plot", out, "--json").out)["comparisons"]
    shares = {line["metric"]: line for line in said["results"]}
    assert shares["false alarms"]["of"] == shares["named, alone"]["of"] == 1
    assert str(out / "report.html") in said["files"]


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_secret_salt_draws_other_questions_and_is_stored_at_the_end(tmp_path):
    path = written(tmp_path, "fifteen")
    path.write_text(path.read_text().replace('salt = "public"\n', ""))
    out, public = tmp_path / "out", load_experiment(str(written(tmp_path, "fifteen")))
    path.write_text(path.read_text().replace('salt = "public"\n', ""))
    secret = ["--secret", "nobody knows", "--plugin", str(PLUGIN), "--jobs", "1"]
    compare(path, "--out", out, *secret)
    configuration = (out / "experiment.toml").read_text()
    assert "nobody knows" in configuration  # revealed, as the study is complete
    names = {one["item"]["name"] for one in read_answers(out).values()}
    drawn = {q.draw_case(0).name for q in build_case_set(read_config(public))}
    assert not names & drawn


def test_a_seed_does_not_reveal_the_salt():
    question = CaseSpec("clean", "slider", None, None, ANY_CONDITIONS, 0)
    public, secret = (question.draw_case(3, salt) for salt in ("public", "a"))
    assert public.name == "clean-slider-3000"
    assert secret.seed == question.draw_case(9, "a").seed
    assert secret.seed not in (public.seed, question.draw_case(3, "b").seed)


def test_recording_conditions_are_as_requested():
    asked = RequestedConditions(50, 3, "ar1")
    item = CaseSpec("clean", "pendulum", None, None, asked, 0).draw_case(0)
    assert (item.rate, item.runs, item.noise) == (50, 3, "ar1")
    assert type(item).from_document(json.loads(json.dumps(item.to_document()))) == item


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[[diagnosis.questions]]\nkind = "strange"', "unknown kind 'strange'"),
        ('[[diagnosis.questions]]\nkind = "clean"\nsystems = ["boat"]', "unknown system 'boat'"),
        ('[[diagnosis.questions]]\nkind = "single"\nsizes = [-1.0]', "sizes: expected above 0"),
        ('[[diagnosis.questions]]\nkind = "clean"\neffects = ["wind"]', "no effects are named"),
        ('[[diagnosis.questions]]\nkind = "clean"\nhow = 3', "unknown entry"),
        ('[[diagnosis.questions]]\nkind = "clean"\ncount = 0', "count: expected 1 to"),
    ],
)
def test_a_fault_in_the_table_is_one_line(tmp_path, more, message):
    path = written(tmp_path, "simgap", more=more)
    error = compare(path, "--out", tmp_path / "out", code=2).err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_unknown_diagnoser_is_refused(tmp_path):
    path = written(tmp_path, "oracle")
    error = compare(path, "--out", tmp_path / "out", code=2).err
    assert "unknown diagnoser 'oracle'; there are: classifier" in error


def test_two_studies_in_one_folder_are_refused(tmp_path):
    held = AnswerStore(tmp_path)
    with pytest.raises(InputError, match="another simgap process uses this folder"):
        AnswerStore(tmp_path)
    held.close()
    AnswerStore(tmp_path).close()


def test_shipped_experiments_have_the_stated_numbers_of_questions():
    names = ("small", "full", "machines")
    small, full, machines = (
        build_case_set(read_config(load_experiment(f"diagnosis-{name}"))) for name in names
    )
    assert len({q.name for q in small}) == len(small) == 56
    assert len({q.name for q in full}) == len(full) == 662
    assert len({q.name for q in machines}) == len(machines) == 98
    assert {q.system for q in machines} == {"servo", "arm2"}
    assert {q.kind for q in small} == {"clean", "single", "double", "foreign"}
