"""Wishes for simulated recordings as the command line's texts, and their writing."""

from bench.cli.key_value_args import build_simulation_spec_args
from bench.logs import synthetic_recording


def Wish(  # noqa: N802 - stands for the class of that name
    system,
    theta=(),
    effects=(),
    constants=(),
    noise=(),
    inputs=(),
    initial=(),
    observe=(),
    *rest,
    **options,
):
    """A `synthetic_recording.SimulationSpec`; texts are ``NAME=VALUE`` as on the command line."""
    values = build_simulation_spec_args(theta, effects, constants, noise, inputs, initial)
    names = ("runs", "seconds", "rate", "engine", "seed", "held_out")
    options |= dict(zip(names, rest, strict=False))
    return synthetic_recording.SimulationSpec(system, **values, observe=observe, **options)


def write(wished, out):
    """Simulate and write, as the command does."""
    synthetic_recording.check_output_path(out)
    made = synthetic_recording.simulate_recording(wished)
    made.write(out)
    return made
