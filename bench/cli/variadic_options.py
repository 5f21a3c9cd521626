"""Reorder positional arguments that follow an option with several values.

An example is ``simgap simulate --effect wind=1 pendulum``. argparse gives an option with
``nargs="+"`` every word up to the next option, so ``pendulum`` would be read as a second effect and
the positional argument would be missing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

_VARIADIC = ("+", "*")
"""Values of `nargs` for an argument that takes several words."""


def positionals_first(parser: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """Move positional arguments to the front that an option with several values would take.

    As many words are moved as there are missing positional arguments. Each is the last word of an
    option, is not its only word, and cannot be a value: values are NAME=VALUE or numbers.

    Args:
        parser: Parser of one command; its positional arguments and options are declared.
        words: The command line after the command's name.

    Returns:
        The words in an order in which argparse reads them as the user meant them.
    """
    groups = list(_groups(parser, words))
    given = sum(len(group) for action, group in groups if action is None)
    positionals = [action for action in parser._actions if not action.option_strings]
    lacking = len(positionals) - given
    moved: list[str] = []
    for action, group in reversed(groups):
        if action is None or action.nargs not in _VARIADIC:
            continue
        # The option's own word and one value stay.
        while len(moved) < lacking and len(group) > 2 and not _is_value(group[-1]):
            moved.insert(0, group.pop())
    return [*moved, *(word for _, group in groups for word in group)]


def _groups(
    parser: argparse.ArgumentParser, words: Sequence[str]
) -> Iterator[tuple[argparse.Action | None, list[str]]]:
    """Yield each option with the words it takes, and other words with None."""
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word == "--":  # Everything after this word is positional.
            yield None, [word, *rest]
            return
        action, attached = _option(parser, word)
        if action is None:
            yield None, [word]
            continue
        group = [word]
        most = 0 if attached or action.nargs == 0 else 1
        if action.nargs in _VARIADIC and not attached:
            most = len(rest)
        while rest and len(group) <= most and not _starts_option(rest[0]):
            group.append(rest.pop(0))
        yield action, group


def _option(parser: argparse.ArgumentParser, word: str) -> tuple[argparse.Action | None, bool]:
    """Return the option that a word names, and whether its value is attached.

    The word is the full name or a unique prefix; an example of an attached value is
    ``--effect=wind=1``.
    """
    name, equals, _ = word.partition("=")
    known = parser._option_string_actions
    if name in known:
        return known[name], bool(equals)
    if name.startswith("--"):
        fitting = [action for text, action in known.items() if text.startswith(name)]
        if len(fitting) == 1:
            return fitting[0], bool(equals)
    return None, False


def _starts_option(word: str) -> bool:
    """Return whether argparse reads a word as an option; a negative number is a value."""
    return word.startswith("-") and word != "-" and not _is_numbers(word)


def _is_value(word: str) -> bool:
    """Return whether a word can be a value of an option with several: NAME=VALUE or numbers."""
    return "=" in word or _is_numbers(word)


def _is_numbers(word: str) -> bool:
    """Return whether a word is a number, or several separated by commas."""
    try:
        [float(cell) for cell in word.split(",")]
    except ValueError:
        return False
    return True
