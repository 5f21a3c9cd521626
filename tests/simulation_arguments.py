"""Build specifications of simulated recordings from command-line texts, and write them."""

from bench.cli.commands.simulate import build_simulation_spec_args
from bench.logs import synthetic_recording


def simulation_spec(
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
    """Build a `synthetic_recording.SimulationSpec` from ``NAME=VALUE`` texts of the
    command line.
    """
    values = build_simulation_spec_args(theta, effects, constants, noise, inputs, initial)
    names = ("runs", "seconds", "rate", "engine", "seed", "held_out")
    options |= dict(zip(names, rest, strict=False))
    return synthetic_recording.SimulationSpec(system, **values, observe=observe, **options)


def write(spec, out):
    """Simulate a recording and write it like the command."""
    synthetic_recording.check_output_path(out)
    made = synthetic_recording.simulate_recording(spec)
    made.write(out)
    return made
