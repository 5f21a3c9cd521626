"""Constructed report data of a six-joint arm with causes at its places."""

from dataclasses import replace

import numpy as np

from bench.diagnosis.report.report_data import ChannelInfo, DataSplit, GapLocation, ModelFileChange
from tests.bench.diagnosis.sample_report_data import HELD_OUT, make_report
from tests.bench.figures.figure_robots import ARM6, POSE6, arm2, arm6

NOISE = {"q": 0.001, "tau": 0.05}
FORCE = ("drag.linear", "friction.coulomb", "friction.stribeck", "force.bias", "force.ripple")
INPUT = ("input.bias", "input.gain", "input.delay", "input.lag")
SENSOR = ("sensor.bias", "sensor.gain", "sensor.delay")
BODY = ("mass.scale", "mass.offset")
CHANGE = ModelFileChange(
    "joint elbow",
    '<joint name="elbow" axis="0 1 0"/>',
    '<joint name="elbow" axis="0 1 0" frictionloss="0.31"/>',
    "friction.coulomb@elbow: 0.31 (0.29 to 0.33) N·m, from log.csv",
)


def number(value, unit="N*m"):
    return {"value": value, "unit": unit, "low": value - 0.02, "high": value + 0.02}


def cause(effect, coefficients=None, alternatives=(), description=None):
    place = effect.partition("@")[2]
    return {
        "effect": effect,
        "alternatives": list(alternatives),
        "says": description or f"a constant friction opposes motion (at joint {place})",
        "coefficients": coefficients or {"coefficient": number(0.31)},
        "p_value": 1e-9,
    }


COULOMB = cause("friction.coulomb@elbow")
WRISTS = cause(
    "friction.coulomb@wrist_1",
    alternatives=["friction.coulomb@wrist_2", "friction.coulomb@wrist_3"],
)
HEAVY = cause(
    "mass.scale@elbow_link",
    {"coefficient": number(0.12, "1")},
    description="the body is heavier or lighter than the model file states (at body elbow_link)",
)
EVERYWHERE = cause("friction.coulomb@*", {f"coefficient@{joint}": number(0.3) for joint in ARM6})


def candidates(joints=ARM6, best="friction.coulomb@elbow"):
    """Return candidates for the effect library at the places of an arm, including families."""
    names = [f"{effect}@{joint}" for effect in FORCE for joint in joints]
    names += [f"{effect}@m_{joint}" for effect in INPUT for joint in joints]
    names += [f"{effect}@q.{joint}" for effect in SENSOR for joint in joints]
    names += [f"{effect}@{joint}_link" for effect in BODY for joint in joints]
    names += ["friction.coulomb@*", "drag.linear@*", "gravity.tilt", "clock.skew"]
    rng = np.random.default_rng(3)
    scores = np.sort(rng.exponential(60.0, len(names)))[::-1]
    place = best.partition("@")[2]
    # Candidates at the place of the cause have the next highest scores.
    names.sort(key=lambda name: (name != best, place not in name, name))
    return [
        {
            "effect": name,
            "score": 900.0 if name == best else float(score),
            "p_value": 1e-9 if name == best else 0.3,
            "heldout_gain": 0.9 if name == best else (0.1 if i < 6 else None),
        }
        for i, (name, score) in enumerate(zip(names, scores, strict=True))
    ]


def motion(joints, runs, seed, at):
    """Return runs (R, T, C) of positions and torques: measured, before and after."""
    rng = np.random.default_rng(seed)
    t = np.arange(400) / 100.0
    quantities = [(kind, joint) for kind in NOISE for joint in joints]
    sigma = np.array([NOISE[kind] for kind, _ in quantities])
    after = np.zeros((runs, t.size, len(quantities)))
    gap = np.zeros_like(after)
    for r in range(runs):
        for c, (kind, joint) in enumerate(quantities):
            rate = 2.0 + 0.7 * joints.index(joint) + 0.2 * r
            size = 0.4 if kind == "q" else 4.0
            after[r, :, c] = POSE6.get(joint, 0.2) + size * np.sin(rate * t)
            near = abs(joints.index(joint) - joints.index(at))
            share = (30.0 if kind == "q" else 5.0) * 0.25**near
            gap[r, :, c] = share * sigma[c] * np.tanh(8 * np.cos(rate * t)) * t / 4
    observed = after + sigma * rng.standard_normal(after.shape)
    return tuple(str(i + 1) for i in range(runs)), (t,) * runs, observed, after - gap, after


def make_robot_report(verdict="named", causes=(COULOMB,), joints=ARM6, at="elbow", **changes):
    """Return report data of an arm; `changes` replace entries of the verdict or of the data."""
    robot = arm6() if len(joints) == 6 else arm2()
    fitting = DataSplit(*motion(joints, 3, 1, at))
    names, *rest = motion(joints, 1, 2, at)
    held_out = DataSplit(tuple(f"held {n}" for n in names), *rest)
    if not causes:
        fitting = replace(fitting, after=fitting.before)
        held_out = replace(held_out, after=held_out.before)
    channels = tuple(
        ChannelInfo(f"{kind}.{joint}", {"q": "rad", "tau": "N*m"}[kind], sigma, True, 0.0)
        for kind, sigma in NOISE.items()
        for joint in joints
    )
    places = [GapLocation("run", str(i), 4800, 4.0 + i, 1.0) for i in (1, 2, 3)]
    places += [
        GapLocation("channel", c.name, 1200, 1.0 + 14.0 * c.name.endswith(at), 1.0)
        for c in channels
    ]
    entries = {
        "system": "arm6",
        "engine": "mujoco",
        "causes": list(causes),
        "parameters": {},
        "heldout": HELD_OUT,
        "candidates": candidates(joints),
    }
    fields = {
        "title": "Six joints in slow motion",
        "channels": channels,
        "fitting": fitting,
        "held_out": held_out,
        "gap_locations": tuple(places),
        "robot": robot,
        "why": (),
    }
    told = make_report(verdict, **{**entries, **fields, **changes})
    return replace(told, parameters=())
