"""Tests that the parser accepts every command line on a page."""

import re
import shlex

import pytest

from bench.cli.main import build_parser
from tests.docs.documentation_pages import ROOT, blocks, pages

SYNOPSIS = re.compile(r" \[-")
"""Pattern of a synopsis, which has options in brackets and is not a command."""


def commands(text):
    """Yield the commands of a page's shell blocks as lists of words, with continued
    lines joined.
    """
    for _, block in blocks(text, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"\|\||&&|;", line):
                words = shlex.split(part, comments=True)
                if words[:1] == ["simgap"] and not SYNOPSIS.search(part):
                    yield words[1:]


def refused(words):
    """Return whether the parser refuses a command line."""
    try:
        build_parser().parse_args(words)
    except SystemExit as end:  # --help
        return bool(end.code)
    except Exception:  # any error of the parser is a refusal
        return True
    return False


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_accepted(page, capsys):
    lines = [*commands(page.read_text(encoding="utf-8"))]
    assert [line for line in lines if refused(line)] == []


def test_commands_in_the_table_of_the_readme_are_accepted(capsys):
    from tests.docs.test_examples import table_commands

    assert len(table_commands()) >= 17
    assert [line for line in table_commands() if refused(line)] == []


def named_wrongly(words):
    """Return the error for a name in a command that does not exist.

    The result is empty if all names exist or come from a user's file.
    """
    from bench.api.train import select_training
    from bench.benchmark.problem.experiment_config import load_experiment
    from bench.core.plugin_registries import tuners
    from bench.datasets import public_datasets
    from sims.core.simulator import InputError

    options = build_parser().parse_args(words)
    own = getattr(options, "plugin", None)
    try:
        if words[0] == "train" and not own:
            select_training(options.tuner, options.simulator, options.experiment)
        elif words[0] == "download":
            [public_datasets.get(name) for name in options.names if name != "all"]
        elif words[0] == "compare" and (name := options.experiment) and not name.endswith(".toml"):
            labels = {entry.label for entry in load_experiment(name).tuners}
            for label in [] if own or not options.tuners else options.tuners.split(","):
                if label not in labels and not load_experiment(name).diagnosis:
                    tuners.get(label)
    except InputError as error:
        return str(error)
    return ""


def test_files_named_in_commands_exist(capsys):
    """Checks tuners with a simulator that can train them, experiments and data sets."""
    lines = [line for page in pages() for line in commands(page.read_text(encoding="utf-8"))]
    checked = [line for line in lines if line[:1] in (["train"], ["compare"], ["download"])]
    assert len(checked) > 15
    assert {" ".join(line): said for line in checked if (said := named_wrongly(line))} == {}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("simgap train tunenet bal", "unknown simulator"),
        ("simgap train cma_es ball", "does not learn"),
        ("simgap compare ball-dropp", "unknown experiment"),
        ("simgap compare ball-drop --tuners random,tunnet", "unknown tuner"),
        ("simgap download so10", "unknown data set"),
    ],
)
def test_a_command_with_a_missing_file_is_found(line, message, capsys):
    assert message in named_wrongly(line.split()[1:])


def test_pages_contain_commands():
    assert sum(len([*commands(page.read_text(encoding="utf-8"))]) for page in pages()) > 60


@pytest.mark.parametrize(
    "line", ["simgap explain", "simgap compare ball-drop --budgets 3", "simgap compair x"]
)
def test_an_unknown_command_is_found(line, capsys):
    (words,) = commands(f"```sh\n{line}   # words\n```\n")
    assert refused(words)
