"""Regression tests with inputs that once violated a rule, named after the failure."""

import pytest

from tests.malformed_input import valid_input
from tests.malformed_input.input_strategies import files_of_arguments
from tests.malformed_input.malformed_case import Case, tried
from tests.malformed_input.shortened_work import environment, shortened


def compare(document, *more):
    files = {"spoilt.toml": valid_input.toml(document)}
    return Case(("compare", "spoilt.toml", "--out", "out", *more), files, owns=("out",))


def listed(plugin):
    return Case(("list", "tuners", "--plugin", "plugin.py"), {"plugin.py": plugin.encode()})


def make_case(*words):
    return Case(words, files_of_arguments(), "done")


WIDE = "\\x04" * 3000
SPEECHLESS = "raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})()"
CASES = {
    "a plugin that raises what is no Exception": (listed("raise BaseException('x')"), "x"),
    "an error that cannot say anything": (listed(SPEECHLESS), "E: without a message"),
    "a message that its escapes make long": (listed(f"raise ValueError('{WIDE}')"), "\\x04"),
    "a name that no file can have": (make_case("status", "x" * 900), "DIR: expected a path"),
    "a plugin's name that no file can have": (
        make_case("list", "tuners", "--plugin", "x" * 900),
        "--plugin: expected a path",
    ),
    "arguments that turn the line around": (
        make_case("list", "systems", "\u202eabc"),
        "\\u202eabc",
    ),
    "an endless argument": (make_case("compare", "swing.toml", "9" * 5000), "unexpected argument"),
    "a world with parameters of its own": (
        compare({**valid_input.SWING, "world": {"effects": ["drag.linear"]}}),
        "fixed = { NAME",
    ),
}


def refusal(case, there, folder):
    """Return the error message of a case that is refused."""
    with environment(folder), shortened():
        heard = tried(case, folder, there)
    assert heard.code == 2
    return heard.err


def test_a_film_with_a_box_of_an_unknown_version(ready, tmp_path):
    _, there = ready
    film = (there["film"] / "drop.mp4").read_bytes()
    name, version = b"mdhd\x00", b"mdhd\xff"
    assert name in film
    files = {"run/drop.mp4": film.replace(name, version)}
    case = Case(("track", "run/drop.mp4", "--out", "track.csv"), files, "film")
    assert refusal(case, there, tmp_path).startswith("simgap: run/drop.mp4: ")


@pytest.mark.parametrize(
    ("name", "flipped", "words"),
    [
        (b"swing-done", b"swing\xfadone", "experiment: expected text, found Invalid"),
        (b"simulator_seconds", b"simulator\xb6seconds", "expected a Parquet file, found 'utf-8'"),
    ],
    ids=["cell", "column"],
)
def test_flipped_bytes_of_a_text_in_parquet(ready, tmp_path, name, flipped, words):
    _, there = ready
    rows = (there["done"] / "runs.parquet").read_bytes()
    # A cell is damaged once, a column name everywhere in the file.
    files = {"run/runs.parquet": rows.replace(name, flipped, 1 if b"-" in name else -1)}
    assert files["run/runs.parquet"] != rows
    case = Case(("status", "run"), files, "done")
    assert words in refusal(case, there, tmp_path)


@pytest.mark.parametrize("name", CASES)
def test_kept(ready, tmp_path, name):
    _, there = ready
    case, words = CASES[name]
    assert words in refusal(case, there, tmp_path)
