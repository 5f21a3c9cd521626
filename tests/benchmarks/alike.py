"""What a log of a servo-driven arm can tell apart: for docs/robots.md.

Run: `OMP_NUM_THREADS=1 python -m tests.benchmarks.alike`. The arm of examples/robot with position
servos of 20 rad/s instead of its motors, two runs of 4 s at 100 Hz, encoders with noise of 1 mrad,
then torques with noise of 0.05 N m beside. Every effect of one coefficient at every place is made
so large that its gap is ten noises, or as large as is plausible; what the best other one leaves of
the gap, once it and the initial states are fitted, says whether data can tell them apart.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from bench.registry import robot
from sims import effects as library
from sims.base import Scenario
from tests.benchmarks.numerics import ARM, commands, served_spec

FREQUENCY, RUNS, GAP = 20, 2, 10.0
NOISE = {"q": 0.001, "tau": 0.05}
JOINTS = ("shoulder", "elbow")
LEFT_OUT = ("input.saturation", "actuator.limit")
"""Their coefficients are limits, of which the smallest change most."""


def candidates(kind, observe):
    """Names of effects of one coefficient at one place, and their largest plausible size."""
    found = {}
    for effect in map(library.get, library.names()):
        if effect.name in LEFT_OUT:
            continue
        for one in kind.system.placed(effect):
            unseen = effect.at == "channel" and one.place not in observe
            if len(one.coefficients) == 1 and not getattr(one, "members", ()) and not unseen:
                found[one.name] = one.coefficients[0].plausible[0][1]
    return found


def scenarios():
    time = np.arange(400) / 100
    for run in range(RUNS):
        u = commands(2, run, 0.5)
        yield Scenario(
            time,
            {f"q.{joint}": u[0, j] for j, joint in enumerate(JOINTS)},
            {f"u.s_{joint}": u[:, j] for j, joint in enumerate(JOINTS)},
        )


def traces(simulator, theta):
    """Readings in units of the noise, (lanes, everything)."""
    noise = np.array([NOISE[channel.name.split(".")[0]] for channel in simulator.channels])
    runs = [simulator.simulate(theta, scenario) / noise for scenario in scenarios()]
    return np.concatenate(runs, axis=1).reshape(len(theta), -1)


def started(simulator, count):
    """What a wrong initial state does, a row for each state of each run."""
    columns = []
    plain = list(scenarios())
    for at, scenario in enumerate(plain):
        for state in [f"{kind}.{joint}" for kind in ("q", "qd") for joint in JOINTS]:
            initial = dict(scenario.initial)
            initial[state] = initial.get(state, 0.0) + 1e-3
            moved = Scenario(scenario.times, initial, scenario.inputs)
            rows = [np.zeros((1, 400, len(simulator.channels)))] * RUNS
            theta = np.zeros((1, count))
            rows[at] = simulator.simulate(theta, moved) - simulator.simulate(theta, scenario)
            noise = [NOISE[channel.name.split(".")[0]] for channel in simulator.channels]
            columns.append((np.concatenate(rows, axis=1) / noise).reshape(-1))
    return np.array(columns)


def gaps(simulator, largest):
    """By effect: its gap of ten noises or its largest, without what initial states absorb, and the
    coefficient that makes it.
    """
    count = len(largest)
    base = traces(simulator, np.zeros((1, count)))
    sizes = 0.1 * np.array(list(largest.values()))
    absorbed = np.linalg.qr(started(simulator, count).T)[0]
    for _ in range(4):
        change = traces(simulator, np.diag(sizes)) - base
        change -= change @ absorbed @ absorbed.T
        seen = np.sqrt(np.mean(change**2, axis=1))
        wanted = np.where(seen > 0, sizes * GAP / np.maximum(seen, 1e-12), sizes)
        sizes = np.minimum(wanted, list(largest.values()))
    return change, seen, sizes


def told(kind, observe):
    largest = candidates(kind, observe)
    simulator = kind(observe=observe, effects=list(largest))
    change, seen, sizes = gaps(simulator, largest)
    names = list(largest)
    unit = change / np.linalg.norm(change, axis=1, keepdims=True)
    left = np.sqrt(np.maximum(1 - (unit @ unit.T) ** 2, 0))
    print(f"\n{', '.join(observe)}\n| effect | size | gap, noises | what others leave of it |")
    print("|---|---|---|---|")
    for i, name in enumerate(names):
        order = [j for j in np.argsort(left[i]) if j != i][:4]
        near = [f"{names[j]} {left[i, j] * seen[i]:.1f}" for j in order]
        print(f"| {name} | {sizes[i]:.3g} | {seen[i]:.1f} | {', '.join(near)} |", flush=True)


def main():
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "served.xml"
        spec = served_spec(ARM, np.zeros(2), FREQUENCY)
        path.write_text(spec.to_xml())
        kind = robot(path)
        positions = [f"q.{joint}" for joint in JOINTS]
        told(kind, positions)
        told(kind, [*positions, *(f"tau.{joint}" for joint in JOINTS)])


if __name__ == "__main__":
    sys.exit(main())
