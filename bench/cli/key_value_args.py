"""Parse ``NAME=VALUE`` arguments of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bench.logs.synthetic_recording import ALL_CHANNELS
from sims.core.simulator import InputError


def parse_key_values(option: str, texts: Sequence[str]) -> dict[str, str]:
    """Parse NAME=VALUE texts.

    Args:
        option: Name of the option, for error messages.
        texts: Arguments of the option.

    Returns:
        Values by name.

    Raises:
        InputError: A text does not have this form, or a name is given twice.
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


def parse_number(option: str, name: str, text: str) -> float:
    """Parse a finite number.

    Args:
        option: Name of the option, for error messages.
        name: Name of the value, for error messages.
        text: Text of the number.

    Raises:
        InputError: The text is not a finite number.
    """
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise InputError(f"{option} {name}={text}: expected a number")
    return value


def parse_key_numbers(option: str, texts: Sequence[str]) -> dict[str, float]:
    """Parse NAME=NUMBER texts.

    Args:
        option: Name of the option, for error messages.
        texts: Arguments of the option.
    """
    return {
        name: parse_number(option, name, text)
        for name, text in parse_key_values(option, texts).items()
    }


def parse_parameters(texts: Sequence[str]) -> dict[str, float] | list[float]:
    """Parse parameters by name, or all of them in order from one text separated by commas."""
    if len(texts) == 1 and "=" not in texts[0]:
        return [
            parse_number("--theta", f"value {i}", t) for i, t in enumerate(texts[0].split(","), 1)
        ]
    return parse_key_numbers("--theta", texts)


def parse_coefficients(texts: Sequence[str]) -> dict[str, list[float]]:
    """Parse NAME=VALUE[,VALUE] texts of effects."""
    return {
        name: [parse_number("--effect", name, cell) for cell in text.split(",")]
        for name, text in parse_key_values("--effect", texts).items()
    }


def parse_noise(texts: Sequence[str]) -> dict[str, float]:
    """Parse NAME=S texts, and at most one plain S for all channels that are not named.

    Args:
        texts: Words after `--noise`, such as ["0.01", "x=0.02"].

    Returns:
        Standard deviation by channel; the key `ALL_CHANNELS` has that of unnamed channels.
    """
    unnamed_texts = [text for text in texts if "=" not in text]
    if len(unnamed_texts) > 1:
        raise InputError(
            f"--noise {' '.join(unnamed_texts)}: expected one number for all channels, or "
            "NAME=VALUE"
        )
    named_values = parse_key_numbers("--noise", [text for text in texts if "=" in text])
    return (
        {ALL_CHANNELS: parse_number("--noise", "every channel", unnamed_texts[0]), **named_values}
        if unnamed_texts
        else named_values
    )


def parse_initial_states(texts: Sequence[str]) -> dict[str, float | tuple[float, float]]:
    """Parse NAME=VALUE and NAME=LOW:HIGH texts of initial states.

    Args:
        texts: Words after `--initial`, such as ["angle=0.5", "rate=-1:1"].

    Returns:
        A value, or the limits between which it is drawn, by name of the state.
    """
    values: dict[str, float | tuple[float, float]] = {}
    for name, text in parse_key_values("--initial", texts).items():
        low, colon, high = text.partition(":")
        first = parse_number("--initial", name, low)
        last = parse_number("--initial", name, high) if colon else first
        if first > last:
            raise InputError(f"--initial {name}={text}: expected LOW:HIGH")
        values[name] = (first, last) if colon else first
    return values


def build_simulation_spec_args(
    theta: Sequence[str] = (),
    effect: Sequence[str] = (),
    constant: Sequence[str] = (),
    noises: Sequence[str] = (),
    inputs: Sequence[str] = (),
    starts: Sequence[str] = (),
) -> dict[str, Any]:
    """Build keyword arguments of `synthetic_recording.SimulationSpec` from the command line.

    Args:
        theta: Texts of ``--theta``.
        effect: Texts of ``--effect``.
        constant: Texts of ``--constant``.
        noises: Texts of ``--noise``.
        inputs: Texts of ``--input``.
        starts: Texts of ``--initial``.

    Raises:
        InputError: A text cannot be read; the message names its option.
    """
    return {
        "parameters": parse_parameters(theta),
        "effects": parse_coefficients(effect),
        "constants": parse_key_numbers("--constant", constant),
        "noise": parse_noise(noises),
        "inputs": parse_key_values("--input", inputs),
        "initial": parse_initial_states(starts),
    }
