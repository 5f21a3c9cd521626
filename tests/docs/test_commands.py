"""Every command line on a page is one that the program takes."""

import re
import shlex

import pytest

from bench.cli import parser
from tests.docs.pages import ROOT, blocks, pages

SYNOPSIS = re.compile(r" \[-")
"""What stands in no command: an option in brackets."""


def commands(text):
    """The commands in a page's shell blocks, as words; continued lines are joined."""
    for _, block in blocks(text, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"\|\||&&|;", line):
                words = shlex.split(part, comments=True)
                if words[:1] == ["simgap"] and not SYNOPSIS.search(part):
                    yield words[1:]


def refused(words):
    """Whether the program's parser refuses a command line."""
    try:
        parser().parse_args(words)
    except SystemExit as end:  # --help
        return bool(end.code)
    except Exception:  # whatever the parser says of it
        return True
    return False


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_taken(page, capsys):
    lines = [*commands(page.read_text(encoding="utf-8"))]
    assert [line for line in lines if refused(line)] == []


def test_there_are_commands():
    assert sum(len([*commands(page.read_text(encoding="utf-8"))]) for page in pages()) > 60


@pytest.mark.parametrize(
    "line", ["simgap explain", "simgap compare ball-drop --budgets 3", "simgap compair x"]
)
def test_a_command_that_is_none_is_found(line, capsys):
    (words,) = commands(f"```sh\n{line}   # words\n```\n")
    assert refused(words)
