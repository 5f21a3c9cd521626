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
