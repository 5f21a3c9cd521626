import pytest

from bench.registry import Registry, SkippedError, load_plugins, tuners
from methods.base import Tuner
from sims.base import InputError


def plugin(tmp_path, text, name="mine.py"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_plugin_registers_by_the_name_derived_from_its_class(tmp_path):
    load_plugins(
        [plugin(tmp_path, "from methods.base import Tuner\nclass MyGreatTuner(Tuner):\n    pass\n")]
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
        ("from methods.base import Tuner\n", "defines neither"),
        (
            "from methods.base import Tuner\nclass Random(Tuner): pass\n",
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
    text = "from methods.base import Tuner\nclass NeedsMuch(Tuner):\n    requires = ('no_such_package',)\n"
    load_plugins([plugin(tmp_path, text)])
    with pytest.raises(SkippedError, match="needs no_such_package, not installed"):
        tuners.get("needs_much")
    assert tuners.describe("needs_much").startswith("skipped: needs no_such_package")


def test_entry_that_cannot_be_imported_is_skipped_with_the_reason(monkeypatch):
    from importlib.metadata import EntryPoint

    broken = Registry("tuner", "simgap.tuners", Tuner)
    entry = EntryPoint("broken", "no_such_module:Thing", "simgap.tuners")
    monkeypatch.setattr(broken, "_entries", lambda: {"broken": entry})
    assert "No module named 'no_such_module'" in broken.describe("broken")
    with pytest.raises(InputError, match="unknown tuner 'x'; there are: broken"):
        broken.get("x")


def test_every_registered_name_is_the_name_its_class_says():
    for name in tuners.names():
        try:
            assert tuners.get(name).name == name
        except SkippedError:
            continue
