"""Tests of `simgap.compare` and `simgap.sweep`: the results of the commands, from Python."""

import matplotlib
import numpy as np
import pandas as pd
import pytest
import tomli_w

import simgap
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.docs.documentation_pages import ROOT
from tests.sample_experiments import SPRING
from tests.without_drawing import undrawn


class Halving(simgap.Tuner):
    """Tuner that repeatedly halves the distance to the centre of the training range."""

    def tune(self, task, rng):
        point = task.start
        while True:
            yield point
            point = (point + task.training.mean(axis=0)) / 2


class Careless(simgap.Tuner):
    def tune(self, task, rng):
        yield task.start
        nobody = {}
        nobody["looked here"]


SETTINGS = {**SPRING, "targets": 2, "seeds": 1, "budget": 6, "tuners": ["random", "nelder_mead"]}


@pytest.fixture
def experiment(tmp_path, spring):
    path = tmp_path / "small.toml"
    path.write_text(tomli_w.dumps(SETTINGS))
    return path


def untimed(table):
    return table.drop(columns=[name for name in table if "seconds" in name])


@pytest.mark.slow
def test_python_and_the_command_make_the_same(experiment, tmp_path):
    command = ["compare", str(experiment), "--plugin", str(PLUGINS / "spring.py"), "--jobs", "1"]
    with undrawn():
        run_command(*command, "--out", tmp_path / "command")
    for jobs in (0, 1):
        run = simgap.compare(
            experiment,
            plugins=[PLUGINS / "spring.py"],
            jobs=jobs,
            out=tmp_path / f"{jobs}",
            pdf=bool(jobs),
        )
        assert run.folder == tmp_path / f"{jobs}"
        pd.testing.assert_frame_equal(
            untimed(run.table).drop(columns="trusted"),
            untimed(pd.read_csv(tmp_path / "command" / "table.csv")).drop(columns="trusted"),
            check_exact=True,
        )
        assert set(run.table["trusted"]) == set(run.statuses["trusted"]) == {jobs == 0}
        assert len(run.runs) == 2 * 2 * 2 * 7
        assert run.statuses["status"].tolist() == ["done"] * 8
        pictures = {path.suffix for path in (run.folder / "figures").iterdir()}
        assert pictures == ({".png", ".pdf"} if jobs else {".png"})


@pytest.mark.slow
def test_a_class_is_compared_its_figures_and_summary_are_at_hand(experiment, tmp_path):
    backend = matplotlib.get_backend()
    run = simgap.compare(experiment, tuners=["random", Halving], jobs=0, out=tmp_path / "out")
    assert set(run.table["tuner"]) == {"random", "halving"}
    assert run.figures[:2] == ["error", "distance"]
    figure = run.figure("error")
    assert isinstance(figure, matplotlib.figure.Figure)
    assert len(figure.axes) == 2
    assert matplotlib.get_backend() == backend
    with pytest.raises(
        simgap.InputError,
        match="unknown figure 'eror'; there are: cost, directions, distance, error",
    ):
        run.figure("eror")
    best = run.summary().groupby("range")["mean"].min()
    shown = run._repr_html_()
    assert f"{best['in']:.3g}" in shown
    assert (
        repr(run) == f"<comparison small: 8 runs, 0 of them failed or skipped; {tmp_path / 'out'}>"
    )
    assert len(shown) < 5000


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_fault_in_a_class_shows_its_own_line_and_the_others_go_on(experiment, tmp_path, capfd):
    run = simgap.compare(experiment, tuners=["random", Careless], jobs=0, out=tmp_path / "out")
    reasons = run.statuses.set_index("tuner").loc["careless", "reason"]
    assert all('nobody["looked here"]' in reason for reason in reasons)
    assert 'nobody["looked here"]' in capfd.readouterr().err
    assert "2 of them failed" not in repr(run)
    assert "4 of them failed" in repr(run)


def test_what_cannot_be_is_one_line_in_the_callers_language(experiment, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    for given, message in [
        ({"tuners": ["cma"]}, "unknown tuner 'cma'; did you mean cma_es"),
        ({"tuners": [3]}, r"tuners\[0\]: expected a name or a subclass of Tuner, found 3"),
        ({"tuners": [Halving()]}, "expected a name or a subclass of Tuner, found a Halving"),
        ({"budget": 0}, "budget: expected a whole number of at least 1, found 0"),
        ({"out": tmp_path / "full"}, "full: exists and is not empty"),
        ({"cluster": "nowhere"}, "nowhere"),
    ]:
        with pytest.raises(simgap.InputError, match=message) as caught:
            simgap.compare(experiment, jobs=0, **given)
        assert "--" not in str(caught.value).replace("--resume", "")
        assert str(caught.value).isprintable()


def test_a_bounce_shot_has_tables_too(tmp_path):
    run = simgap.ComparisonResult(ROOT / "results" / "reference" / "bounce-shot")
    assert len(run.runs) == len(run.statuses) == 300 * run.statuses["tuner"].nunique()
    assert run.table.set_index(["method", "ball"]).loc[("nominal", "table-tennis"), "shots"] == 50
    assert run.figures == []
    with pytest.raises(simgap.InputError, match=r"figures of a bounce shot are files: .*figures"):
        run.figure("error")
    assert run.experiment.name in repr(run)
    assert "<table" in run._repr_html_()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_sweep_is_several_comparisons_on_the_same_targets(experiment, tmp_path):
    experiment.write_text(tomli_w.dumps({**SETTINGS, "sweep": {"budget": [3, 5]}}))
    with pytest.raises(simgap.InputError, match=r"sweeps over values: use simgap\.sweep"):
        simgap.compare(experiment, jobs=0)
    runs = simgap.sweep(experiment, jobs=0, out=tmp_path / "out")
    assert [run.experiment.name for run in runs] == ["small[budget=3]", "small[budget=5]"]
    assert [run.runs["k"].max() for run in runs] == [3, 5]
    first = [run.runs[run.runs["k"] <= 3].drop(columns=["run", "experiment"]) for run in runs]
    truths = [part.filter(like="true_").to_numpy() for part in first]
    np.testing.assert_array_equal(*truths)

    command = ["compare", str(experiment), "--plugin", str(PLUGINS / "spring.py"), "--jobs", "0"]
    said = run_command(*command, "--out", tmp_path / "again").out
    assert "\nsmall[budget=3]\n" in said
    for run in runs:
        again = pd.read_csv(tmp_path / "again" / run.experiment.name / "table.csv")
        pd.testing.assert_frame_equal(untimed(run.table), untimed(again), check_exact=True)
    assert (
        run_command("status", tmp_path / "again").out.count("8 of 8 runs finished, complete") == 2
    )
    run_command("compare", "--resume", tmp_path / "again")
    run_command("plot", tmp_path / "again")


def test_a_fault_in_one_of_a_sweep_leaves_nothing(experiment, tmp_path):
    document = {**SETTINGS, "sweep": {"observe": [["x"], ["no_such"]]}}
    experiment.write_text(tomli_w.dumps(document))
    with pytest.raises(simgap.InputError, match="no_such"):
        simgap.sweep(experiment, jobs=0, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
