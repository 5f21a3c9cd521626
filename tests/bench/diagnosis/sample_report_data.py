"""Constructed report data of a damped swing and a frictionless pendulum, for every verdict."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.diagnosis.report.report_data import (
    ChannelInfo,
    DataSplit,
    DiagnosisReportData,
    GapLocation,
    ParameterChange,
    ResidualProfile,
)
from bench.diagnosis.report.summary_text import format_gain_and_caveats, format_summary
from bench.diagnosis.verdict import Verdict

EVIL = "<script>alert(1)</script>"
SIGMA = (0.01, 0.05)
CHANNELS = (
    ChannelInfo("q", "rad", 0.01, True, 0.0),
    ChannelInfo("qd", "rad/s", 0.05, False, 0.002),
)

HELD_OUT = {
    "rmse_base": 0.37,
    "rmse_extended": 0.045,
    "noise_floor": 0.01,
    "gap_closed": 0.9,
    "low": 0.85,
    "high": 0.94,
}
DRAG = {
    "effect": "drag.linear",
    "alternatives": [],
    "says": "motion is resisted in proportion to speed",
    "coefficients": {
        "coefficient": {"value": 2.2e-4, "unit": "N*m*s/rad", "low": 2.0e-4, "high": 2.4e-4}
    },
    "p_value": 1e-9,
}
TILT = {
    "effect": "gravity.tilt",
    "alternatives": [],
    "says": "the ground is not level: gravity has a horizontal component",
    "coefficients": {"x": {"value": 0.031, "unit": "1", "low": 0.028, "high": 0.034}},
    "p_value": 3e-5,
}
EITHER = {**DRAG, "alternatives": ["friction.coulomb"]}
NEXT = {
    "says": "release it from 1.5 rad instead of 0.5 rad, where the two differ by 4 times the noise"
}


def swing(runs, seed, gap):
    rng = np.random.default_rng(seed)
    t = np.arange(400) / 100.0
    amplitude = 0.5 + 0.2 * np.arange(runs)[:, None]
    rate = 8.0 - 0.5 * amplitude**2

    def motion(drag):
        envelope = amplitude * np.exp(-drag * t)
        return np.stack([envelope * np.cos(rate * t), -envelope * rate * np.sin(rate * t)], axis=2)

    truth = motion(0.12 if gap else 0.0)
    observed = truth + rng.normal(size=truth.shape) * SIGMA
    observed[0, 50:60, 0] = np.nan
    after = motion(0.118 if gap else 0.0)
    return tuple(f"{i + 1}" for i in range(runs)), (t,) * runs, observed, motion(0.0), after


def sides(gap):
    fitting = DataSplit(*swing(4, 1, gap))
    names, *rest = swing(2, 2, gap)
    return fitting, DataSplit(tuple(f"held {n}" for n in names), *rest)


def places(gap):
    big = 6.0 if gap else 0.5
    rows = [("run", str(i), 800, big * (1 + 0.3 * i), 1.1) for i in range(1, 5)]
    rows += [("run", "held 1", 800, big * 1.5, 1.1), ("run", "held 2", 800, big * 2.1, 1.2)]
    rows += [("channel", "q", 2400, big * 1.4, 1.05), ("channel", "qd", 2400, big * 1.9, 1.15)]
    rows += [
        ("phase", "first third", 1600, big * 0.5, 1.0),
        ("phase", "last third", 1600, big * 2.6, 1.2),
    ]
    return tuple(GapLocation(*row) for row in rows)


def profiles(gap):
    x = np.linspace(-1.0, 1.0, 12)
    made = []
    for channel, sigma in zip(("q", "qd"), SIGMA, strict=True):
        for i, (variable, unit) in enumerate(
            (("time", "s"), ("position", "rad"), ("speed", "rad/s"))
        ):
            error = np.full(12, sigma / 12)
            before = (3 + 4 * i) * sigma * np.sin((1 + i) * x) * gap
            before[3] = np.nan
            made.append(ResidualProfile(channel, variable, unit, x, before, 0.05 * before, error))
    return tuple(made)


def candidates():
    names = [
        "drag.linear",
        "friction.coulomb",
        "drag.quadratic",
        "sensor.drift",
        "gravity.scale",
        "my.plugin",
    ]
    scores = [812.4, 807.1, 512.0, 9.7, 3.1, -0.2]
    gains = [0.9, 0.89, 0.66, 0.02, None, -0.01]
    p = [1e-9, 1e-7, 1e-6, 0.2, 0.6, 1.0]
    keys = ("effect", "score", "p_value", "heldout_gain")
    return [dict(zip(keys, row, strict=True)) for row in zip(names, scores, p, gains, strict=True)]


CAUSES = {"named": [DRAG], "ambiguous": [EITHER], "partial": [DRAG]}


def answer(verdict="named", **changes):
    """Return a verdict.json document with this verdict; `changes` replace its entries."""
    causes = CAUSES.get(verdict, [])
    found = {
        "verdict": verdict,
        "system": "pendulum",
        "engine": "batch",
        "causes": causes,
        "parameters": {
            "inertia": {"value": 0.00341, "unit": "kg*m^2", "low": 0.0034, "high": 0.00342}
        },
        "heldout": HELD_OUT
        if causes
        else {**HELD_OUT, "rmse_extended": 0.37, "gap_closed": 0.0, "low": 0.0, "high": 0.0},
        "candidates": candidates(),
        "next_experiment": NEXT if verdict == "ambiguous" else None,
        "simulations": 1412,
        "seconds": 2.1,
        "cut": None,
    }
    if verdict == "adequate":
        found["heldout"] = {
            **HELD_OUT,
            "rmse_base": 0.0101,
            "rmse_extended": 0.0101,
            "gap_closed": None,
            "low": None,
            "high": None,
        }
        found["candidates"] = [
            {**c, "score": c["score"] / 500, "p_value": 0.4} for c in candidates()
        ]
    return {**found, **changes}


def make_report(verdict="named", **changes):
    """Return report data with this verdict; `changes` replace entries of the verdict or data."""
    gap = verdict not in ("adequate", "unidentifiable")
    fitting, held_out = sides(gap)
    causes = CAUSES.get(verdict, [])
    if not causes:
        fitting, held_out = (
            replace(fitting, after=fitting.before),
            replace(held_out, after=held_out.before),
        )
    bounded = (np.nan, np.nan) if verdict == "unidentifiable" else (0.00325, 0.00341)
    tuned = (
        ParameterChange(
            "inertia",
            "kg*m^2",
            (0.00333, *bounded),
            (0.00351, 0.00345, 0.00357) if causes else (0.00333, *bounded),
            True,
        ),
        ParameterChange("restitution", "1", (0.7, np.nan, np.nan), (0.7, np.nan, np.nan), False),
    )
    entries = answer(verdict)
    fields = {k: changes.pop(k) for k in list(changes) if k not in entries}
    made = DiagnosisReportData(
        title="Free swing of a damped pendulum",
        path=Path("swing.csv"),
        verdict=Verdict.from_document({**entries, **changes}),
        channels=CHANNELS,
        fitting=fitting,
        held_out=held_out,
        gap_locations=places(gap),
        profiles=profiles(gap),
        parameters=tuned,
        lack_of_fit=("The noise of qd is estimated from the data, not stated",) if causes else (),
        why=(
            "drag.linear gains 812 in twice the log likelihood, noise alone almost nothing",
            "no other effect explains it as well",
        ),
    )
    return replace(made, **fields)


def summary_text(report):
    """Return the summary for a terminal on one line."""
    return " ".join(" ".join(format_summary(report)).split())


def gain_text(report):
    """Return the sentences after the headline, of which the first one is the gain."""
    return " ".join(format_gain_and_caveats(report))


def evil():
    """Return report data in which every text from a file or plugin is an injection attack."""
    cause = {
        **DRAG,
        "effect": EVIL,
        "says": EVIL,
        "alternatives": [EVIL],
        "coefficients": {EVIL: {**DRAG["coefficients"]["coefficient"], "unit": EVIL}},
    }
    base = make_report("ambiguous")
    document = base.verdict.to_document()
    bad = {
        "system": EVIL,
        "engine": EVIL,
        "causes": [cause],
        "parameters": {EVIL: document["parameters"]["inertia"]},
        "candidates": [{**c, "effect": EVIL} for c in candidates()],
        "next_experiment": {"says": EVIL},
    }
    return replace(
        base,
        title=EVIL + "\x1b[31m $\\frac{$",
        path=Path(EVIL),
        verdict=Verdict.from_document({**document, **bad}),
        channels=tuple(replace(c, name=EVIL, unit=EVIL) for c in base.channels),
        fitting=replace(base.fitting, names=("$x_{$", EVIL, "\x00", "日本")),
        held_out=replace(base.held_out, names=("$\\frac{1}$" + EVIL, "$")),
        gap_locations=tuple(replace(p, label=EVIL + "$\\alpha{$") for p in base.gap_locations),
        profiles=tuple(replace(p, channel=EVIL, variable=EVIL, unit=EVIL) for p in base.profiles),
        parameters=tuple(replace(p, name=EVIL, unit=EVIL) for p in base.parameters),
        lack_of_fit=(EVIL,),
        why=(EVIL,),
    )
