"""Tests of command lines: a positional argument may come before or after a variadic option."""

import argparse

import pytest

from bench.cli.main import build_parser
from tests.command_output import run_command


def commands():
    (choices,) = [a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)]
    return choices.choices


def variadic():
    """Return (command, option) for each option that takes several values."""
    return [
        (name, action.option_strings[0])
        for name, command in commands().items()
        for action in command._actions
        if action.option_strings and action.nargs in ("+", "*")
    ]


def words_of(name, option):
    """Return a complete command line in two parts: positional arguments and required options."""
    actions = commands()[name]._actions
    positionals = [f"word{i}" for i, a in enumerate(actions) if not a.option_strings]
    required = [a.option_strings[0] for a in actions if a.option_strings and a.required]
    return positionals, [word for each in required for word in (each, "file.csv")]


def test_there_are_options_of_several_values():
    assert {option for _, option in variadic()} >= {"--effect", "--noise", "--initial", "--input"}


@pytest.mark.parametrize(("name", "option"), variadic())
@pytest.mark.parametrize("values", [["a=1"], ["a=1", "b=2:3"], ["0.002"], ["0.1,-0.2"]])
def test_every_such_option_may_stand_before_the_positional(name, option, values):
    positionals, required = words_of(name, option)
    read = build_parser().parse_args
    expected = read([name, *positionals, *required, option, *values])
    assert getattr(expected, option.lstrip("-").replace("-", "_")) == values
    for words in (
        [option, *values, *positionals, *required],
        [*required, option, *values, *positionals],
        [option[:-1], *values, *positionals, *required],  # argparse accepts a unique abbreviation
        [option, *values, *required, *positionals],
    ):
        assert read([name, *words]) == expected, words


def test_several_such_options_may_stand_before_it():
    words = ["--effect", "wind=1", "--noise", "q=0.1", "0.2", "ball", "--out", "a.csv"]
    options = build_parser().parse_args(["simulate", *words])
    assert (options.system, options.effect, options.noise) == ("ball", ["wind=1"], ["q=0.1", "0.2"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        # The positional argument is given, so no word is taken from the option.
        (["pendulum", "--effect", "wind=1", "drag"], "--effect drag: expected NAME=VALUE"),
        # An option keeps its only word: the error is about this word, not about the system name.
        (["--effect", "drag.linear"], "--effect drag.linear: expected NAME=VALUE"),
        # Only the last word of the option can be the positional argument.
        (["--effect", "drag.linear", "pendulum"], "--effect drag.linear: expected NAME=VALUE"),
        (["--effect", "drag.linear=1", "pendulun"], "unknown simulator 'pendulun'"),
    ],
)
def test_faults_name_the_word_that_is_wrong(words, message, tmp_path):
    assert message in run_command("simulate", *words, "--out", tmp_path / "a.csv", code=2).err


def test_simulate_runs_with_the_option_first(tmp_path):
    out = tmp_path / "swing.csv"
    words = ["--effect", "drag.linear=2e-4", "pendulum", "--runs", "1", "--seconds", "0.1"]
    run_command("simulate", *words, "--out", out)
    assert 'system = "pendulum"' in out.with_suffix(".toml").read_text()
    assert "drag.linear" in out.with_suffix(".truth.toml").read_text()
