"""Command `simgap simulate`: write the recording of a simulated experiment."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from bench.cli.output import CommandResult, PrintLine
from bench.cli.shared_options import (
    add_options,
    add_out_option,
    add_plugin_option,
    collect_options,
    parse_key_numbers,
    parse_key_values,
    parse_number,
    parse_positive_int,
)
from bench.logs.synthetic_recording import ALL_CHANNELS
from sims.core.simulator import InputError


def parse_parameters(texts: Sequence[str]) -> dict[str, float] | list[float]:
    """Parse parameters by name, or all of them in order from one text separated by commas."""
    if len(texts) == 1 and "=" not in texts[0]:
        return [
            parse_number("--theta", f"value {position}", text)
            for position, text in enumerate(texts[0].split(","), 1)
        ]
    return parse_key_numbers("--theta", texts)


def parse_coefficients(texts: Sequence[str]) -> dict[str, list[float]]:
    """Parse NAME=VALUE[,VALUE] texts of effects into lists of coefficients by name."""
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
    if unnamed_texts:
        return {
            ALL_CHANNELS: parse_number("--noise", "every channel", unnamed_texts[0]),
            **named_values,
        }
    return named_values


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


class _SystemAction(argparse.Action):
    """Store the system, which may also be the last word of an option with several values."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        _option: str | None = None,
    ) -> None:
        """Store the system that argparse found; a second one is an error.

        `values` is None or empty if the argument is missing at this place of the command line.
        """
        if values and namespace.system:
            parser.error(f"unexpected argument '{values}'")
        namespace.system = values or namespace.system


class _ValuesAction(argparse._ExtendAction):
    """Store the values of an option, and leave a last word that cannot be a value for SYSTEM.

    argparse gives such an option every word up to the next option, as in ``--effect wind=1 ball``.
    Values are NAME=VALUE or numbers.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option: str | None = None,
    ) -> None:
        """Store the values; a last word that cannot be a value becomes the system.

        In `simgap simulate --theta mass=1 pendulum`, argparse takes the system's name as one more
        value of `--theta`; here it is moved to `system`.
        """
        words = list(values)
        if len(words) > 1 and not namespace.system and not _is_value(words[-1]):
            namespace.system = words.pop()
        super().__call__(parser, namespace, words, option)


def _is_value(word: str) -> bool:
    """Return whether a word is NAME=VALUE, or numbers separated by commas."""
    try:
        return "=" in word or bool([float(number) for number in word.split(",")])
    except ValueError:
        return False


def add_simulate_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap simulate`."""
    from bench.logs.synthetic_recording import SimulationSpec

    parser.add_argument(
        "system",
        metavar="SYSTEM",
        nargs="?",
        default="",
        action=_SystemAction,
        help="see `simgap list systems`",
    )
    for name, metavar, text in (
        (
            "theta",
            "NAME=VALUE",
            "parameters, or all values in order separated by commas (default: nominal)",
        ),
        ("effect", "NAME=VALUE[,VALUE]", "active effects with their coefficients"),
        ("constant", "NAME=VALUE", "constants that differ from the system's defaults"),
        ("noise", "S", "sensor noise, 1 sigma: of every channel, or NAME=S (default: none)"),
        (
            "input",
            "NAME=SIGNAL",
            "a number, sine:AMPLITUDE:HERTZ, square:A:HZ, steps:A:SECONDS, chirp:A:HZ:HZ, "
            "multisine:A:HZ:HZ; several are added with ' + ' between",
        ),
        ("initial", "NAME=VALUE", "initial states, or NAME=LOW:HIGH to draw one for each run"),
    ):
        parser.add_argument(
            f"--{name}", action=_ValuesAction, nargs="+", default=[], metavar=metavar, help=text
        )
    add_options(parser, SimulationSpec, runs={"type": parse_positive_int})
    add_out_option(parser, "new file for the recording", "FILE.csv", required=True)
    add_plugin_option(parser, "systems")
    parser.set_defaults(command=_run_simulate)


def _run_simulate(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap simulate`: simulate a recording, and write it with its true parameters.

    The true parameters are in a separate file, so that the recording can be explained without them.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.api.recordings import simulate
    from bench.core.plugin_registries import load_plugins
    from bench.logs.synthetic_recording import SimulationSpec, check_output_path

    load_plugins(options.plugin)
    check_output_path(options.out)
    spec_args = build_simulation_spec_args(
        options.theta,
        options.effect,
        options.constant,
        options.noise,
        options.input,
        options.initial,
    )
    simulated = simulate(**{**collect_options(options, SimulationSpec), **spec_args})
    simulated.write(options.out)
    first_run = simulated.recording.runs[0]
    truth = options.out.with_suffix(".truth.toml")
    runs = f"{options.runs} run{'s' if options.runs > 1 else ''}"
    print_line(
        f"{options.out}: {runs} of {options.seconds:g} s at {options.rate:g} Hz, channels "
        f"{', '.join(first_run.channels)}"
    )
    print_line(f"{truth}: its true parameters")
    return CommandResult(
        {
            "recording": options.out,
            "description": options.out.with_suffix(".toml"),
            "truth": truth,
            "system": simulated.recording.system,
            "runs": options.runs,
            "seconds": options.seconds,
            "rate": options.rate,
            "channels": list(first_run.channels),
            "inputs": list(first_run.inputs),
        }
    )
