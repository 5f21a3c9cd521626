"""Wishes for simulated recordings as the command line's texts, and their writing."""

from bench.commands.wishes import wish
from bench.recordings import simulate


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
    """A `bench.recordings.simulate.Wish`; texts are ``NAME=VALUE`` as on the command line."""
    values = wish(theta, effects, constants, noise, inputs, initial)
    names = ("runs", "seconds", "rate", "engine", "seed", "held_out")
    options |= dict(zip(names, rest, strict=False))
    return simulate.Wish(system, **values, observe=observe, **options)


def write(wished, out):
    """Simulate and write, as the command does."""
    simulate.ready(out)
    made = simulate.make(wished)
    made.write(out)
    return made
