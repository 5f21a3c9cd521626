from pathlib import Path

import pytest

from tests.conftest import (
    SLOW_OR_DATA,
    is_in_part,
    pytest_collection_modifyitems,
    pytest_ignore_collect,
)
from tests.data_dependence import find_data_dependent_names

MODULE = """
import os
FOLDER = os.environ.get("SIMGAP_DATA")
CASES = [FOLDER, "a"]
SIZE = 3

@pytest.fixture
def log(tmp_path):
    return read(CASES)

@pytest.fixture
def other(tmp_path):
    return SIZE

def test_a_parameter(log): ...
def test_another_parameter(other): ...
@pytest.mark.usefixtures("log")
def test_a_marker(): ...
@pytest.mark.parametrize("case", CASES)
def test_a_decorator(case): ...
def test_a_text():
    run("simgap list experiments")
def test_neither(): ...
"""


def test_names_that_depend_on_recordings_are_found_through_others():
    found = find_data_dependent_names(MODULE)
    assert {name for name in found if name.startswith("test_")} == {
        "test_a_parameter", "test_a_marker", "test_a_decorator", "test_a_text"
    }  # fmt: skip
    assert found >= {"FOLDER", "CASES", "log"}


def test_a_fixture_that_all_tests_use_makes_all_of_them_dependent():
    always = MODULE.replace("@pytest.fixture\ndef log", "@pytest.fixture(autouse=True)\ndef log")
    assert {"test_neither", "test_another_parameter"} <= find_data_dependent_names(always)
    assert find_data_dependent_names(MODULE.replace("SIMGAP_DATA", "HOME")
                                     .replace("simgap list", "simgap")) == set()  # fmt: skip


class Config:
    """Stand-in for pytest's configuration with a marker expression."""

    def __init__(self, expression):
        self.expression = expression

    def getoption(self, name):
        return {"markexpr": self.expression, "part": None}[name]


@pytest.mark.parametrize(
    ("source", "is_ignored"),
    [
        ("def test_a(): ...\n", True),
        ("def slow_test_marked(): ...\n", True),
        ("@pytest.mark.slow(seconds=3)\ndef test_a(): ...\n", False),
        ("def test_a(recordings): ...\n", False),
        (MODULE, False),
    ],
)
def test_only_files_without_slow_or_data_tests_are_ignored(tmp_path, source, is_ignored):
    path = tmp_path / "test_it.py"
    path.write_text(source)
    assert bool(pytest_ignore_collect(path, Config(SLOW_OR_DATA))) is is_ignored
    assert not pytest_ignore_collect(path, Config("not slow"))
    assert not pytest_ignore_collect(path.rename(tmp_path / "conftest.py"), Config(SLOW_OR_DATA))


def test_a_mark_that_the_source_does_not_show_stops_the_collection(request, monkeypatch):
    monkeypatch.setattr("tests.conftest.can_be_slow_or_data", lambda source: False)
    pytest_collection_modifyitems([request.node])
    request.node.add_marker(pytest.mark.slow)
    with pytest.raises(pytest.UsageError, match="would ignore its file"):
        pytest_collection_modifyitems([request.node])


def test_the_makefile_uses_the_expression_for_which_files_are_ignored():
    makefile = Path(__file__).parents[1] / "Makefile"
    assert f'test-rest: $(STAMP)\n\t$(PYTEST) -m "{SLOW_OR_DATA}" ' in makefile.read_text()


def test_each_test_file_is_in_one_part():
    paths = sorted(Path(__file__).parent.rglob("test_*.py"))
    parts = [[path for path in paths if is_in_part(path, f"{number}/3")] for number in (1, 2, 3)]
    assert sorted(path for part in parts for path in part) == paths
    assert all(len(part) > 0.25 * len(paths) for part in parts)
    assert all(is_in_part(path, None) for path in paths)
