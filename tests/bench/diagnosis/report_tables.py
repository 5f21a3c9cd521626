"""Recordings on disk, made from columns."""

import numpy as np

from tests.bench.diagnosis.simulated_logs import write_log

UNITS = {"q": "rad", "qd": "rad/s", "x": "m", "v": "m/s", "z": "m"}


def table(folder, runs, channels=("q", "qd"), system="pendulum", noise=None, inputs=(), more=""):
    """Write odd.csv and odd.toml; a run is its times, a column per channel and one per input."""
    lines = [f'system = "{system}"', more]
    for name in channels:
        lines += [f'[channels.{name}]\nunit = "{UNITS[name]}"']
        lines += [f"noise = {noise[name]}"] if noise else []
    for name in inputs:
        lines += [f'[inputs.{name}]\nunit = "{"N*m" if system == "pendulum" else "N"}"']
    return write_log(folder, "\n".join(lines) + "\n", ",".join([*channels, *inputs]), runs, "odd")


def swing(times, angle=0.8, pulse=8.17, decay=0.0, rng=None, sigma=(0.003, 0.02)):
    """Return times, angle and rate of a small free swing in closed form, with noise of `rng`."""
    envelope = angle * np.exp(-decay * times)
    q, qd = envelope * np.cos(pulse * times), -pulse * envelope * np.sin(pulse * times)
    if rng is not None:
        q, qd = (
            q + sigma[0] * rng.standard_normal(times.size),
            qd + sigma[1] * rng.standard_normal(times.size),
        )
    return times, q, qd
