import csv
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest
import tomli_w

from bench.api.train import DEFAULT_EXPERIMENTS, LossRecorder, default_experiment, select_training
from bench.benchmark.problem.experiment_config import (
    TunerEntry,
    list_experiment_names,
    load_experiment,
)
from bench.benchmark.runner.trained_weights import WeightsError
from bench.benchmark.runner.tuner_process_start import make_tuner_spec
from bench.benchmark.runner.tuner_training import (
    TrainingRequest,
    compute_training_key,
    load_trained_tuner,
    train_or_load,
)
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import COMMAND

pytestmark = pytest.mark.usefixtures("undrawn")
PLUGIN = str(PLUGINS / "spring.py")
TUNER = {"tuner": "tunenet", "options": {"epochs": 4, "points": 30}}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch, spring):
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "cache"


def write_experiment(folder):
    document = {
        **SPRING,
        "training_budget": 56,
        "targets": 1,
        "seeds": 2,
        "tuners": {"small": TUNER},
    }
    path = folder / "ahead.toml"
    path.write_text(tomli_w.dumps(document))
    return path


@pytest.fixture
def experiment(tmp_path):
    return write_experiment(tmp_path)


@pytest.fixture(scope="module")
def trained_cache(tmp_path_factory, spring):
    """Return a cache with the trained weights of both seeds."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMGAP_CACHE", str(folder / "cache"))
        patch.chdir(folder)
        train_spring(write_experiment(folder))
    return folder / "cache"


def train_spring(experiment, *more, code=0):
    words = ["train", "small", "spring", "--experiment", experiment, "--plugin", PLUGIN, *more]
    return run_command(*words, code=code)


@pytest.mark.slow
def test_trains_what_compare_then_finds(experiment, tmp_path, cache):
    said = train_spring(experiment, "--out", tmp_path / "out")
    files = sorted(cache.iterdir())
    assert [file.suffix for file in files] == [".npz", ".npz"]
    stamps = [file.stat().st_mtime_ns for file in files]
    assert "trained with 56 simulations in" in said.out
    assert "seed 1, noisy: 100%" in said.err
    rows = list(csv.DictReader((tmp_path / "out" / "loss.csv").read_text().splitlines()))
    assert [(r["seed"], r["stage"], r["epoch"]) for r in rows[:5]] == [
        ("0", "clean", "1"), ("0", "clean", "2"), ("0", "clean", "3"), ("0", "clean", "4"),
        ("0", "noisy", "1"),
    ]  # fmt: skip
    assert float(rows[3]["training_loss"]) < float(rows[0]["training_loss"])
    assert {path.name for path in (tmp_path / "out" / "figures").iterdir()} == {"loss.png"}
    run_command("compare", experiment, "--plugin", PLUGIN, "--budget", 2, "--out", tmp_path / "c")
    assert sorted(cache.iterdir()) == files
    assert [file.stat().st_mtime_ns for file in files] == stamps
    assert "trained earlier with 56 simulations" in train_spring(experiment).out


def test_hybrid_starts_from_the_same_network_as_tunenet(experiment):
    settings = load_experiment(str(experiment))
    requests = [
        TrainingRequest(TunerEntry("x", name, TUNER["options"]), 1)
        for name in ("tunenet", "hybrid")
    ]
    one, two = (dict(np.load(train_or_load(settings, request).path)) for request in requests)
    arrays = [name for name in one if "." in name]
    assert len(arrays) > 6
    for name in arrays:
        np.testing.assert_array_equal(one[name], two[name])


def test_looking_on_changes_nothing(experiment):
    """Training gives the same weights with an observer (`simgap train`) and without (`compare`)."""
    settings, entry = (
        load_experiment(str(experiment)),
        TunerEntry("small", "tunenet", TUNER["options"]),
    )
    watched = train_or_load(
        settings, TrainingRequest(entry, 0), LossRecorder(settings, lambda *_: lambda: None)
    )
    first = dict(np.load(watched.path))
    assert watched.simulations == 56
    apart = TrainingRequest(entry, 0, make_tuner_spec(entry))
    # Isolated training also gives the same weights, with and without an observer.
    for lesson, watch in (
        (TrainingRequest(entry, 0), None),
        (apart, None),
        (apart, LossRecorder(settings, lambda *_: lambda: None)),
    ):
        again = dict(np.load(train_or_load(settings, lesson, watch, anew=True).path))
        assert all(
            np.array_equal(first[name], again[name])
            for name in first
            if not name.startswith("__simulations")
        )
        assert watch is None or len(watch.rows) > 2


def test_budget_and_seeds(experiment, cache):
    said = train_spring(experiment, "--budget", 40, "--seeds", 1).out
    assert len(list(cache.iterdir())) == 1
    assert "trained with 40 simulations" in said
    assert f"simgap compare {experiment} --training-budget 40" in said


def truncated(path):
    path.write_bytes(path.read_bytes()[:2000])


def emptied(path):
    path.write_bytes(b"")


def flipped(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(bytes(content))


def pickled(path):
    with path.open("wb") as file:
        np.savez(file, weights=np.array([{"a": 1}], dtype=object))


def foreign(path):
    with path.open("wb") as file:
        np.savez(file, weights=np.zeros(3))


def another(path):
    """Replace a weights file by one trained with another seed or for other shapes."""
    other = next(file for file in path.parent.iterdir() if file != path)
    path.write_bytes(other.read_bytes())


def reshaped(path):
    arrays = dict(np.load(path))
    arrays["clean.joined.weight"] = arrays["clean.joined.weight"][:, :-1]
    with path.open("wb") as file:
        np.savez(file, **arrays)


def not_a_number(path):
    arrays = dict(np.load(path))
    arrays["clean.output.bias"][:] = np.nan
    with path.open("wb") as file:
        np.savez(file, **arrays)


BREAKS = [truncated, emptied, flipped, pickled, foreign, another, reshaped, not_a_number]


@pytest.mark.slow
@pytest.mark.parametrize("spoil", BREAKS, ids=lambda spoil: spoil.__name__)
def test_broken_weights_are_refused_with_one_line(experiment, cache, trained_cache, spoil):
    shutil.copytree(trained_cache, cache)
    entry = TunerEntry("small", "tunenet", TUNER["options"])
    path = cache / f"{compute_training_key(load_experiment(str(experiment)), entry, 0)}.npz"
    spoil(path)
    said = train_spring(experiment, code=2).err.strip()
    assert said.startswith(f"simgap: {path}: ")
    assert len(said.splitlines()) == 1
    assert "expected" in said
    assert said.endswith("delete it to train again")
    with pytest.raises(WeightsError):
        load_trained_tuner(entry, path)
    if spoil is truncated:
        words = ["compare", experiment, "--plugin", PLUGIN, "--out", cache.parent / "c"]
        assert run_command(*words, code=2).err.strip().splitlines()[-1] == said
        train_spring(experiment, "--again")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cma_es", "slider"], "tuner cma_es does not learn: there is nothing to train"),
        (["tunenet", "slyder"], "unknown simulator 'slyder'"),
        (["tunnet", "slider"], "unknown tuner 'tunnet'"),
        (
            ["tunenet", "servo", "--experiment", "ball-drop"],
            "experiment ball-drop: its simulator is ball, not servo",
        ),
        (
            ["tunenet", "bounce-shot"],
            "simulator bounce-shot: expected an experiment that tunes it; no built-in experiment",
        ),
    ],
)
def test_faults_are_one_line(arguments, message):
    error = run_command("train", *arguments, code=2).err
    assert message in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("simulator", "experiment"),
    [("ball", "ball-drop"), ("ball-drop", "ball-drop"), ("ball-tilt", "ball-tilt")],
)
def test_a_simulator_with_several_experiments_has_a_default(simulator, experiment):
    chosen, entry = select_training("tunenet", simulator)
    assert (chosen.name, entry.label) == (experiment, "tunenet")


def test_every_tuned_simulator_of_the_project_has_exactly_one_default_experiment():
    loaded = [load_experiment(name) for name in list_experiment_names()]
    tuned = {e.simulator for e in loaded if e.simulator and not e.calibration}
    for simulator in tuned:
        assert load_experiment(default_experiment(simulator)).simulator == simulator
    assert set(DEFAULT_EXPERIMENTS) <= tuned


def test_the_default_experiment_is_printed_and_finds_the_weights(tmp_path):
    words = ["tunenet", "ball", "--budget", "40", "--seeds", "1", "--out", str(tmp_path / "out")]
    said = run_command("train", *words).out.splitlines()
    assert said[0] == "experiment: ball-drop"
    assert said[-1] == "used by: simgap compare ball-drop --training-budget 40"
    assert (tmp_path / "out" / "loss.csv").is_file()


def test_a_value_that_cannot_be_is_one_line():
    assert run_command("train", "tunenet", "slider", "--budget", 0, code=2).err == (
        "simgap: argument --budget: expected a whole number of at least 1, found '0'; "
        "see simgap train --help\n"
    )


@pytest.mark.slow
def test_an_interrupted_training_leaves_nothing(experiment, tmp_path, cache):
    document = {
        **SPRING,
        "training_budget": 60,
        "tuners": {"small": {**TUNER, "options": {"epochs": 100_000}}},
    }
    experiment.write_text(tomli_w.dumps(document))
    command = [*COMMAND, "train", "small", "spring", "--experiment", str(experiment)]
    process = subprocess.Popen(
        [*command, "--plugin", PLUGIN],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr.read(1)  # the progress bar has started, so the training is running
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert error.strip().endswith("simgap: interrupted before the first result")
    assert not cache.exists() or not list(cache.iterdir())
