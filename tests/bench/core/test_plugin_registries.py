import pickle
from importlib.metadata import EntryPoint

import pytest

from bench.core.plugin_registries import (
    PartUnavailableError,
    Registry,
    effects,
    load_plugins,
    simulators,
    tuners,
)
from methods.tuner import Tuner
from sims.core.simulator import InputError, Simulator
from sims.effects import list_effects_for


def plugin(tmp_path, text, name="mine.py"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_plugin_registers_by_the_name_derived_from_its_class(tmp_path):
    load_plugins(
        [
            plugin(
                tmp_path, "from methods.tuner import Tuner\nclass MyGreatTuner(Tuner):\n    pass\n"
            )
        ]
    )
    assert "my_great_tuner" in tuners.names()
    assert issubclass(tuners.get("my_great_tuner"), Tuner)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def f(:\n", r"mine.py, line 1: "),
        (
            "import nothing_of_that_name\n",
            "ModuleNotFoundError: No module named 'nothing_of_that_name'",
        ),
        ("x = 1\n", "defines neither a Tuner nor a Simulator nor an Effect"),
        ("from methods.tuner import Tuner\n", "defines neither"),
        (
            "from methods.tuner import Tuner\nclass Random(Tuner): pass\n",
            "tuner 'random' exists already",
        ),
    ],
)
def test_faulty_plugin_is_one_line(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        load_plugins([plugin(tmp_path, text)])
    assert "\n" not in str(caught.value)


def test_missing_plugin_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_plugins([tmp_path / "none.py"])


def test_what_lacks_a_package_is_skipped_with_the_reason(tmp_path):
    text = (
        "from methods.tuner import Tuner\n"
        "class NeedsMuch(Tuner):\n    requires = ('no_such_package',)\n"
    )
    load_plugins([plugin(tmp_path, text)])
    with pytest.raises(PartUnavailableError, match="needs no_such_package, not installed"):
        tuners.get("needs_much")
    assert tuners.describe("needs_much").startswith("skipped: needs no_such_package")


def test_entry_that_cannot_be_imported_is_skipped_with_the_reason(monkeypatch):
    broken = Registry("tuner", "simgap.tuners", Tuner)
    entry = EntryPoint("broken", "no_such_module:Thing", "simgap.tuners")
    monkeypatch.setattr(broken, "_entry_points", {"broken": entry})
    assert "No module named 'no_such_module'" in broken.describe("broken")
    with pytest.raises(InputError, match="unknown tuner 'x'; there are: broken"):
        broken.get("x")


@pytest.mark.parametrize("value", ["sims.effects.gone:Drag", "sims.effects.drag:Gone"])
def test_a_part_that_an_older_installation_expects_elsewhere_is_an_error(monkeypatch, value):
    entry = EntryPoint("drag.linear", value, "simgap.effects")
    monkeypatch.setattr(effects, "_entry_points", {"drag.linear": entry})
    monkeypatch.setattr(effects, "_imported", {})
    with pytest.raises(InputError, match=r"effect drag\.linear: .*pip install -e \.") as error:
        effects.get("drag.linear")
    assert not isinstance(error.value, PartUnavailableError)


def test_every_registered_name_is_the_name_its_class_says():
    for name in tuners.names():
        try:
            assert tuners.get(name).name == name
        except PartUnavailableError:
            continue


def cell(description):
    """Define a class as a notebook cell does: each call gives a new class of the same name."""

    class FromACell(Tuner):
        pass

    FromACell.description = description
    return FromACell


def test_a_class_from_python_is_registered_and_defined_again(fresh_registries):
    first, second = cell("first"), cell("second")
    assert tuners.register(first) is first
    tuners.register(first)
    assert tuners.get("from_acell") is first
    tuners.register(second)
    assert tuners.get("from_acell") is second


def test_a_taken_name_is_refused_to_a_class_from_python(fresh_registries, tmp_path):
    taken = type("Random", (Tuner,), {})
    with pytest.raises(InputError, match=r"^tuner 'random' exists already; give it another name"):
        tuners.register(taken)
    assert tuners.register(tuners.get("random")) is not taken, "the installed class is known by it"
    load_plugins([plugin(tmp_path, "from methods.tuner import Tuner\nclass InFile(Tuner): pass\n")])
    in_file = tuners.get("in_file")
    again = type("InFile", (Tuner,), {"__module__": in_file.__module__})
    with pytest.raises(InputError, match="tuner 'in_file' exists already"):
        tuners.register(again)
    tuners.register(in_file)
    load_plugins([tmp_path / "mine.py"])
    assert tuners.get("in_file") is in_file


def test_what_is_no_part_of_the_kind_is_refused():
    for other in (Spring, Tuner(), "random", 3):
        with pytest.raises(InputError, match="tuner: expected a complete subclass of Tuner, found"):
            tuners.register(other)
    with pytest.raises(InputError, match=r"class Odd: expected name = 'plain_name', found 'a b'"):
        tuners.register(type("Odd", (Tuner,), {"name": "a b"}))


class Spring(Simulator):
    pass


def test_of_a_plugin_that_is_refused_nothing_is_registered(fresh_registries, tmp_path):
    text = "from methods.tuner import Tuner\nclass Sound(Tuner): pass\nclass Random(Tuner): pass\n"
    for _ in range(2):
        with pytest.raises(InputError, match="tuner 'random' exists already"):
            load_plugins([plugin(tmp_path, text)])
        assert "sound" not in tuners.names()


def test_an_effect_that_cannot_be_imported_is_left_out_and_says_why(monkeypatch):
    entry = EntryPoint("wind.broken", "no_such_module:Thing", "simgap.effects")
    monkeypatch.setattr(effects, "_entry_points", {**effects._entry_points, "wind.broken": entry})
    with pytest.raises(
        PartUnavailableError, match=r"effect wind\.broken cannot be used here: ModuleNotF"
    ):
        effects.get("wind.broken")
    assert "wind.broken" in effects.names()
    assert "wind.broken" not in list_effects_for(simulators.get("ball").system)


def test_a_skipped_part_is_reported_by_the_worker_completely():
    error = pickle.loads(pickle.dumps(PartUnavailableError("tuner", "npe", "needs sbi")))
    assert (str(error), error.reason) == ("tuner npe cannot be used here: needs sbi", "needs sbi")
