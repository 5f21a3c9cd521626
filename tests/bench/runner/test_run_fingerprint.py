"""Tests of code digests: each cause of a changed result changes the run id or the weights key."""

import shutil
import sys
import textwrap
from contextlib import contextmanager
from dataclasses import fields, replace
from importlib import import_module

import pytest

from bench.benchmark.problem.experiment_config import (
    Experiment,
    TunerEntry,
    load_experiment,
    parse_experiment,
)
from bench.benchmark.runner.experiment_runner import prepare_experiment
from bench.benchmark.runner.run_fingerprint import compute_fingerprint, hash_class_source
from bench.benchmark.runner.tuner_training import compute_training_key
from bench.core.plugin_registries import REGISTRIES, load_plugins, tuners
from methods.tuner import Tuner
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator, FittedValue, write_extended
from tests.notebook_cells import define_in_cell
from tests.sample_experiments import SPRING, spring_experiment

REGRESSOR = TunerEntry("regressor", "regressor")
PLUGIN = """
from methods.tuner import Tuner

class Mine(Tuner):
    name = "mine"
    learned = True
    step = {step}

    def tune(self, task, rng):
        yield task.start
"""


pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")


@contextmanager
def alone(*plugins):
    """Load these plugins only, and restore the registries afterwards."""
    before = [registry.snapshot() for registry in REGISTRIES]
    load_plugins(plugins)
    yield
    for registry, snapshot in zip(REGISTRIES, before, strict=True):
        registry.restore(snapshot)


def extended(path, scale):
    """Write an extended pendulum whose numbers are all multiplied by `scale`."""
    model = ExtendedSimulator(
        "pendulum_extended", "pendulum", "batch", "A swing, measured",
        {"inertia": FittedValue(3.1e-3 * scale, "kg*m^2", 3.0e-3 * scale, 3.2e-3 * scale)},
        {"drag.linear": {"coefficient": FittedValue(7e-4 * scale, "N*m*s/rad", None, None)}},
        {"mass": 0.2 * scale}, ["q"],
    )  # fmt: skip
    write_extended(model, path)
    return path


def swing(path):
    document = {**SPRING, "simulator": "pendulum_extended", "observe": ["q"], "initial": {"q": 1.0}}
    return parse_experiment("swing", document, path)


def names_with(plugin, experiment, entry):
    """Return the training key and the run ids with only this plugin loaded."""
    with alone(plugin):
        plan = prepare_experiment(replace(experiment, tuners=(entry,), trusted=True)).plan
        return compute_training_key(experiment, entry, 0), {job.request.run for job in plan}


def test_extended_simulators_of_one_name_and_other_numbers_share_no_weights_and_no_run(
    tmp_path, monkeypatch
):
    names = []
    for folder, scale in (("a", 1.0), ("b", 1.5), ("c", 1.0)):
        (tmp_path / folder).mkdir()
        path = extended(tmp_path / folder / "extended.toml", scale)
        names.append(names_with(path, swing(path), REGRESSOR))
    (one, runs), (other, other_runs), again = names
    assert one != other
    assert not runs & other_runs
    assert again == (one, runs), "the same content elsewhere is the same simulator"


def test_the_system_that_a_plugin_declares_is_part_of_what_extends_it(tmp_path):
    text = """
    from sims.systems.pendulum import Pendulum
    from sims.systems.pendulum import PendulumSystem

    class System(PendulumSystem):
        name = "swing"

    class Swing(Pendulum):
        system = System
        number = {number}
    """
    keys = []
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "swing.py").write_text(textwrap.dedent(text.format(number=number)))
        path = extended(folder / "extended.toml", 1.0)
        path.write_text(path.read_text().replace('system = "pendulum"', 'system = "swing"'))
        with alone(folder / "swing.py", path):
            keys.append(compute_training_key(swing(path), REGRESSOR, 0))
    assert keys[0] != keys[1]


def test_plugin_file_is_part_of_the_names_wherever_it_lies(tmp_path):
    names = []
    for folder, step in (("a", 1), ("b", 2), ("c", 1)):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "mine.py"
        path.write_text(PLUGIN.format(step=step))
        names.append(names_with(path, spring_experiment(), TunerEntry("mine", "mine")))
    assert names[0][0] != names[1][0]
    assert not names[0][1] & names[1][1]
    assert names[0] == names[2]


def test_plugin_files_of_one_name_in_two_folders_are_distinguished(tmp_path):
    for step, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        text = PLUGIN.format(step=step).replace('"mine"', f'"mine_{folder}"')
        (tmp_path / folder / "mine.py").write_text(text)

    def digests(*folders):
        with alone(*(tmp_path / folder / "mine.py" for folder in folders)):
            return {folder: hash_class_source(tuners.get(f"mine_{folder}")) for folder in folders}

    together = digests("a", "b")
    assert together["a"] != together["b"]
    assert {**digests("a"), **digests("b")} == together, "other loaded modules do not matter"


def test_effect_of_a_plugin_file_is_part_of_what_names_it(tmp_path):
    text = """
    from sims.effects.drag import LinearDrag

    class Mine(LinearDrag):
        name = "drag.mine"
        number = {number}
    """
    keys = []
    for number in (1, 2):
        path = tmp_path / f"effect{number}.py"
        path.write_text(textwrap.dedent(text.format(number=number)))
        with alone(path):
            settings = {"engine": "batch", "fixed": {"drag.mine": 1e-4}}
            document = {**SPRING, "simulator": "pendulum", "observe": ["q"], "initial": {"q": 1.0}}
            experiment = parse_experiment("swing", {**document, "settings": settings}, path)
            keys.append(compute_training_key(experiment, REGRESSOR, 0))
    assert keys[0] != keys[1]


@pytest.mark.slow
def test_any_file_of_the_rooms_that_make_runs_changes_keys_and_ids(tmp_path, monkeypatch):
    from bench.benchmark.runner import run_fingerprint

    for room in run_fingerprint.COMPARISON_SOURCE_FOLDERS:
        shutil.copytree(
            run_fingerprint.PROJECT_ROOT / room,
            tmp_path / room,
            ignore=shutil.ignore_patterns("__pycache__"),
        )
    experiment = spring_experiment()
    before = compute_training_key(experiment, REGRESSOR, 0)

    def names():
        run_fingerprint.hash_source_folders.cache_clear()
        ids = {job.request.run for job in prepare_experiment(experiment).plan}
        return (
            run_fingerprint.hash_source_folders(),
            compute_training_key(experiment, REGRESSOR, 0),
            ids,
        )

    monkeypatch.setattr(run_fingerprint, "PROJECT_ROOT", tmp_path)
    try:
        whole, _, ids = names()
        files = [file for file in tmp_path.rglob("*") if file.is_file()]
        for told in (
            "methods/learning/input_features.py",
            "sims/engines/external/mujoco_engine.py",
            "bench/core/random_streams.py",
        ):
            assert tmp_path / told in files
        changed = set()
        for file in files:
            text = file.read_bytes()
            file.write_bytes(text + b"\n")
            run_fingerprint.hash_source_folders.cache_clear()
            changed.add(run_fingerprint.hash_source_folders())
            file.write_bytes(text)
        assert len(changed - {whole}) == len(files)
        for file in files[:: len(files) // 5]:
            text = file.read_bytes()
            file.write_bytes(text + b"\n")
            _, now, now_ids = names()
            assert now != before
            assert not now_ids & ids
            file.write_bytes(text)
    finally:
        monkeypatch.undo()
        run_fingerprint.hash_source_folders.cache_clear()
    assert compute_training_key(experiment, REGRESSOR, 0) == before


def test_what_explains_a_drop_makes_its_shot_and_no_run_of_a_comparison(tmp_path, monkeypatch):
    from bench.benchmark.runner import run_fingerprint

    for room in run_fingerprint.BOUNCE_SHOT_SOURCE_FOLDERS:
        (tmp_path / room).mkdir(parents=True)
    monkeypatch.setattr(run_fingerprint, "PROJECT_ROOT", tmp_path)
    run_fingerprint.hash_source_folders.cache_clear()
    try:
        before = [
            compute_fingerprint(load_experiment(name), [])["code"]
            for name in ("bounce-shot", "ball-drop")
        ]
        (tmp_path / "bench" / "diagnosis" / "explain.py").write_text("changed")
        run_fingerprint.hash_source_folders.cache_clear()
        after = [
            compute_fingerprint(load_experiment(name), [])["code"]
            for name in ("bounce-shot", "ball-drop")
        ]
    finally:
        monkeypatch.undo()
        run_fingerprint.hash_source_folders.cache_clear()
    assert before[0] != after[0]
    assert before[1] == after[1]


def test_a_new_file_in_a_room_counts_and_what_python_compiles_does_not(tmp_path, monkeypatch):
    from bench.benchmark.runner import run_fingerprint

    monkeypatch.setattr(run_fingerprint, "PROJECT_ROOT", tmp_path)
    monkeypatch.setattr(run_fingerprint, "COMPARISON_SOURCE_FOLDERS", ("room",))
    (tmp_path / "room" / "__pycache__").mkdir(parents=True)
    (tmp_path / "room" / "a.py").write_text("a")
    rooms = run_fingerprint.hash_source_folders.__wrapped__
    before = rooms()
    (tmp_path / "room" / "__pycache__" / "a.pyc").write_text("c")
    assert rooms() == before
    (tmp_path / "room" / "table.csv").write_text("1")
    assert rooms() != before


def test_class_of_a_script_or_a_notebook_takes_the_digest_of_its_text(monkeypatch):
    def cell(number, step):
        return define_in_cell(monkeypatch, PLUGIN.format(step=step), f"<cell {number}>")

    one = cell(1, 1)
    cell(2, 2)
    with pytest.raises(InputError, match="whose source cannot be determined"):
        hash_class_source(one)  # another class has this name now
    digests = [hash_class_source(cell(number, step)) for number, step in ((3, 1), (4, 2), (5, 1))]
    assert digests[0] == digests[2] != digests[1]
    assert digests[1] == hash_class_source(cell(6, 2))


def test_class_of_a_notebook_that_has_no_file_takes_the_text_of_its_cell(monkeypatch):
    """In Jupyter, `__main__` has no file, so that inspect finds functions but no classes."""
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)

    def digest(step):
        text = PLUGIN.format(step=step)
        return hash_class_source(define_in_cell(monkeypatch, text, file=None))

    assert digest(1) == digest(1) != digest(2)


def define_tuner(number):
    class Local(Tuner):
        step = number

    return Local


@pytest.mark.parametrize(
    "kind",
    [define_tuner(1), type("Nobody", (Tuner,), {}), type("Random", (tuners.get("random"),), {})],
)
def test_class_whose_source_cannot_be_found_is_refused_with_one_line(kind, monkeypatch):
    monkeypatch.setattr(kind, "name", "nobody", raising=False)
    tuners.register(kind)
    for ask in (
        lambda: hash_class_source(kind),
        lambda: compute_training_key(spring_experiment(), TunerEntry("nobody", "nobody"), 0),
        lambda: prepare_experiment(spring_experiment(tuners={"nobody": {}})),
    ):
        with pytest.raises(InputError, match="whose source cannot be determined") as error:
            ask()
        assert "\n" not in str(error.value)


def test_class_made_at_run_time_carries_its_digest_and_a_subclass_does_not_inherit_it():
    one, two, again = (
        type("Made", (Tuner,), {"source_digest": text}) for text in ("one", "two", "one")
    )
    assert hash_class_source(one) == hash_class_source(again) != hash_class_source(two)
    with pytest.raises(InputError, match="cannot be determined"):
        hash_class_source(type("Sub", (one,), {}))


CHANGES = {
    "name": "another",
    "simulator": "pendulum",
    "free": ("damping@*",),
    "actuators": {"m": {"joint": "elbow", "kind": "motor"}},
    "observe": ("x", "v"),
    "error_channel": "v",
    "timeout": 61.0,
    "memory": 99,
    "isolation": "tuner",
    "trusted": True,
    "noise": {"x": 0.1},
    "settings": {"engine": "batch"},
    "world": {"engine": "batch"},
    "constants": {"mass": 2.0},
    "parameters": {"rate": {"training": (2.0, 3.0)}},
    "initial": {"x": (0.8, 1.3)},
    "inputs": {"u": "sine:2:0.5"},
    "sampling": type(Experiment("x").sampling)(20.0, 61),
    "training_budget": 99,
}
"""A change to each key of an experiment that determines a run or a training."""
NO_MATTER = {
    "run_fingerprint": {"training_budget"},
    "tuner_training": {"error_channel", "world", "timeout", "memory", "isolation"},
}
"""For each module, the keys of CHANGES that do not affect its digest."""


@pytest.mark.parametrize(
    ("module", "but"),
    [("run_fingerprint", "RUN_IRRELEVANT_KEYS"), ("tuner_training", "TRAINING_IRRELEVANT_KEYS")],
)
def test_every_key_of_an_experiment_matters_or_has_its_reason(module, but):
    """A new key must be listed either with a reason as irrelevant, or in CHANGES, where it changes
    the digest.
    """
    from bench.benchmark.runner.run_fingerprint import select_relevant_keys

    reasons = getattr(import_module(f"bench.benchmark.runner.{module}"), but)
    names = {field.name for field in fields(Experiment)}
    assert set(reasons) <= names
    assert all(reason.strip() for reason in reasons.values())
    mattering = names - set(reasons)
    assert mattering <= set(CHANGES), "add it to CHANGES, or to the irrelevant keys"
    assert set(CHANGES) - mattering == NO_MATTER[module], "an irrelevant key changes the digest"
    plain = spring_experiment()
    before = select_relevant_keys(plain, reasons)
    for name in mattering:
        changed = select_relevant_keys(replace(plain, **{name: CHANGES[name]}), reasons)
        assert changed != before, name
        assert {key for key in changed if changed[key] != before.get(key)} == {name}


def test_keys_that_do_not_matter_to_a_training_do_not_change_its_key():
    plain = spring_experiment()
    before = compute_training_key(plain, REGRESSOR, 0)
    for change in ({"title": "words"}, {"targets": 9}, {"timeout": 9.0}, {"error_channel": "x"}):
        assert compute_training_key(replace(plain, **change), REGRESSOR, 0) == before, change
    for change in ({"noise": {"x": 0.1}}, {"training_budget": 7}, {"name": "another"}):
        assert compute_training_key(replace(plain, **change), REGRESSOR, 0) != before, change
    assert compute_training_key(plain, REGRESSOR, 1) != before
