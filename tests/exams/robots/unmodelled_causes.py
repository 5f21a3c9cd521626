"""Causes that the effect library does not contain.

They are friction that the work of another joint heats, cogging with hysteresis, friction in a part
of the range, and a slipping encoder.
"""

from __future__ import annotations

import numpy as np


def drawn(cause, joint, setting, rng):
    """Return a function from strength to keyword arguments, the hidden cause of a question.

    Args:
        cause: one of `planted_effects.FOREIGN`.
        joint: index of the joint.
        setting: setting of the recording.
        rng: random generator for the shape of the cause.
    """
    return DRAWN[cause](joint, setting, rng)


def _heated(joint, setting, rng):
    """Draw friction that the work of another joint heats, with a time constant of 0.5 to 2 s.

    At the typical power the equilibrium heat is 1.
    """
    others = [k for k in setting.machine.driven if k != joint]
    other = int(rng.choice(others)) if others else joint
    power = float(setting.typical["force"][other] * setting.typical["speed"][other])
    force, time = float(setting.typical["force"][joint]), float(rng.uniform(0.5, 2.0))
    return lambda strength: {"heated": (joint, other, 2 * force * strength, power * time, time)}


def _cogging(joint, setting, rng):
    """Draw three to eight teeth over the travel."""
    tooth = float(setting.typical["travel"][joint] / rng.uniform(3.0, 8.0))
    force = float(setting.typical["force"][joint])
    return lambda strength: {"cogging": (joint, 2 * force * strength, tooth)}


def _binding(joint, setting, rng):
    """Draw friction around a position that the joint often passes, over a part of its travel."""
    path = np.concatenate([motion[:, joint] for motion in setting.bare])
    centre = float(np.quantile(path, rng.uniform(0.3, 0.7)))
    half = float(setting.typical["travel"][joint] * rng.uniform(0.08, 0.2))
    force = float(setting.typical["force"][joint])
    return lambda strength: {"binding": (joint, 2 * force * strength, centre, half)}


def _slip(joint, setting, rng):
    """Draw one or two jumps per run: (joint, run, time, jump, run, time, jump, ...)."""
    seconds = setting.runs[0].times[-1]
    jumps = []
    for number in range(len(setting.runs)):
        for _ in range(int(rng.integers(1, 3))):
            instant = float(rng.uniform(0.15, 0.9) * seconds)
            jumps += [number, instant, float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.5))]

    def cause(strength):
        sized = np.array(jumps).reshape(-1, 3) * [1.0, 1.0, 0.1 * strength]
        return {"slip": (joint, *sized.ravel().tolist())}

    return cause


DRAWN = {"heated": _heated, "cogging": _cogging, "binding": _binding, "slip": _slip}


def slips_of(effects, number):
    """Return the encoder jumps of a run as tuples (joint, time, jump)."""
    if "slip" not in effects:
        return ()
    joint, *rest = effects["slip"]
    return tuple(
        (int(joint), instant, jump)
        for run, instant, jump in np.reshape(rest, (-1, 3)).tolist()
        if run == number
    )
