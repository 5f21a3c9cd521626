"""Causes that the library does not have: an elastic joint, a binding range, a slipping encoder."""

from __future__ import annotations

import numpy as np

from tests.robots.plant import Binding, Elastic

STIFFEST = 10.0  # Hz, of a link on its elastic joint at strength 1/10


def drawn(cause, joint, setting, rng):
    """What is hidden, by strength: keyword arguments for `hidden` of a question.

    Args:
        cause: elastic, binding or slip.
        joint: its index.
        setting: of the recording.
        rng: draws its shape.
    """
    return DRAWN[cause](joint, setting, rng)


def _elastic(joint, setting, rng):
    """A spring that grows softer, and a rotor of some share of what the joint moves."""
    moved = float(setting.typical["inertia"][joint])
    rotor, damped = float(rng.uniform(0.1, 0.3)) * moved, float(rng.uniform(0.02, 0.06))

    def cause(strength):
        stiffness = moved * (2 * np.pi * STIFFEST) ** 2 * 0.1 / strength
        damping = 2 * damped * float(np.sqrt(stiffness * moved))
        return {"elastic": (joint, rotor * min(strength, 1.0), stiffness, damping)}

    return cause


def _binding(joint, setting, rng):
    """About a place that the joint passes often, over a part of its travel."""
    path = np.concatenate([motion[:, joint] for motion in setting.bare])
    centre = float(np.quantile(path, rng.uniform(0.3, 0.7)))
    half = float(setting.typical["travel"][joint] * rng.uniform(0.08, 0.2))
    force = float(setting.typical["force"][joint])
    return lambda strength: {"binding": (joint, 2 * force * strength, centre, half)}


def _slip(joint, setting, rng):
    """A jump or two in every run: (joint, jump, instants of the first run, of the second, ...)."""
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


DRAWN = {"elastic": _elastic, "binding": _binding, "slip": _slip}


def plant_of(effects):
    """What is foreign in the plant; None where nothing is."""
    if "elastic" in effects:
        joint, *rest = effects["elastic"]
        return Elastic(int(joint), *rest)
    if "binding" in effects:
        joint, *rest = effects["binding"]
        return Binding(int(joint), *rest)
    return None


def slips_of(effects, number):
    """(joint, instant, jump) of the encoder in a run."""
    if "slip" not in effects:
        return ()
    joint, *rest = effects["slip"]
    return tuple(
        (int(joint), instant, jump)
        for run, instant, jump in np.reshape(rest, (-1, 3)).tolist()
        if run == number
    )
