"""``NAME=VALUE`` texts of the command line as values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bench.recordings.simulate import EVERY
from sims.base import InputError


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """NAME=VALUE texts as a dictionary.

    Raises:
        InputError: a text is none, or a name is given twice.
    """
    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise InputError(f"{option} {text}: expected NAME=VALUE")
        if name in values:
            raise InputError(f"{option}: {name} is given twice")
        values[name] = value
    return values


def number(option: str, name: str, text: str) -> float:
    """The finite number in a text.

    Raises:
        InputError: it is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise InputError(f"{option} {name}={text}: expected a number")
    return value


def numbers(option: str, texts: Sequence[str]) -> dict[str, float]:
    """NAME=NUMBER texts."""
    return {name: number(option, name, text) for name, text in pairs(option, texts).items()}


def parameters(texts: Sequence[str]) -> dict[str, float] | list[float]:
    """Parameters by name, or all of them in order from one text with commas between."""
    if len(texts) == 1 and "=" not in texts[0]:
        return [number("--theta", f"value {i}", t) for i, t in enumerate(texts[0].split(","), 1)]
    return numbers("--theta", texts)


def coefficients(texts: Sequence[str]) -> dict[str, list[float]]:
    """NAME=VALUE[,VALUE] texts of effects."""
    return {
        name: [number("--effect", name, cell) for cell in text.split(",")]
        for name, text in pairs("--effect", texts).items()
    }


def noise(texts: Sequence[str]) -> dict[str, float]:
    """NAME=S texts, and at most one plain S for all that are not named."""
    plain = [text for text in texts if "=" not in text]
    if len(plain) > 1:
        raise InputError(
            f"--noise {' '.join(plain)}: expected one number for all channels, or NAME=VALUE"
        )
    named = numbers("--noise", [text for text in texts if "=" in text])
    return {EVERY: number("--noise", "every channel", plain[0]), **named} if plain else named


def initial(texts: Sequence[str]) -> dict[str, float | tuple[float, float]]:
    """NAME=VALUE and NAME=LOW:HIGH texts."""
    values: dict[str, float | tuple[float, float]] = {}
    for name, text in pairs("--initial", texts).items():
        low, colon, high = text.partition(":")
        first = number("--initial", name, low)
        last = number("--initial", name, high) if colon else first
        if first > last:
            raise InputError(f"--initial {name}={text}: expected LOW:HIGH")
        values[name] = (first, last) if colon else first
    return values


def wish(
    theta: Sequence[str] = (),
    effect: Sequence[str] = (),
    constant: Sequence[str] = (),
    noises: Sequence[str] = (),
    inputs: Sequence[str] = (),
    starts: Sequence[str] = (),
) -> dict[str, Any]:
    """Keyword arguments of `bench.recordings.simulate.Wish` from the command line's texts.

    Raises:
        InputError: a text that cannot be read, named with its option.
    """
    return {
        "parameters": parameters(theta),
        "effects": coefficients(effect),
        "constants": numbers("--constant", constant),
        "noise": noise(noises),
        "inputs": pairs("--input", inputs),
        "initial": initial(starts),
    }
