"""Sampling of cases for ball, pendulum and slider.

`draw` chooses what is hidden and how strongly. `realise` writes the recording and, in a separate
file, the truth. Everything that is drawn follows from the name of the case; a case is a recipe
without data.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis.worlds import rivals, shapes, sizing
from bench.diagnosis.worlds.item import KINDS as KINDS
from bench.diagnosis.worlds.item import Item as Item
from bench.diagnosis.worlds.settings import ANY, Circumstances, Setting
from bench.diagnosis.worlds.settings import setting as drawn_setting
from bench.diagnosis.worlds.world import FOREIGN, SIMULATORS, simulated, solved
from sims import effects as library
from sims.base import Array
from sims.recording.recording import Recording, Run
from sims.recording.write import write_recording

SYSTEMS = ("ball", "pendulum", "slider")
SMALL = (0.1, 0.2, 0.3, 0.5)  # sizes for the power curve only

# Minimum RMS residual, in units of the noise, if only one of two effects or no unmodelled cause is
# in the model.
APART = 1.0
# Minimum RMS residual, in units of the noise, with the simpler form of an effect; below it, the
# simpler form is a correct answer.
TELLING = 0.4
SIMPLER = {
    "friction.direction": ("drag.linear",),
    "friction.load_direction": ("friction.load",),
    "friction.load_quadratic": ("friction.load",),
    "friction.position": ("friction.coulomb",),
    "friction.stribeck": ("friction.coulomb",),
    "input.power": ("input.gain",),
    "friction.warming": ("friction.coulomb", "drag.linear"),
    "wind": (
        "drag.linear",
        "drag.quadratic",
        "force.bias",
        "gravity.tilt",
    ),  # fast air is a steady push
}

EQUIVALENT: tuple[tuple[str, bool, frozenset[str]], ...] = (
    ("slider", True, frozenset({"gravity.tilt", "force.bias", "input.bias"})),
    ("pendulum", True, frozenset({"force.bias", "input.bias"})),
    ("pendulum", True, frozenset({"input.gain", "gravity.scale"})),  # the inertia absorbs the rest
    ("pendulum", False, frozenset({"force.bias", "input.bias"})),
    ("pendulum", False, frozenset({"gravity.tilt", "sensor.bias"})),  # gravity rotated and scaled
    (
        "ball",
        False,
        frozenset({"force.bias", "gravity.scale", "clock.skew"}),
    ),  # no accelerometer is recorded
)
"""Effects that are exactly equivalent: they give the same motion for some parameters.

Each entry is a system, whether it has an input, and the effects. The initial states may differ too.
"""


def same_class(system: str, driven: bool, effect: str) -> frozenset[str]:
    """Return an effect and all effects that are equivalent to it.

    Args:
        system: name of the system.
        driven: whether there is an input.
        effect: name of the effect.
    """
    classes = (
        names for *where, names in EQUIVALENT if where == [system, driven] and effect in names
    )
    return frozenset({effect}).union(*classes)


def draw(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    wanted_so: Circumstances = ANY,
) -> Item | None:
    """Draw a case.

    Args:
        kind: clean, single, double or foreign.
        system: ball, pendulum or slider.
        seed: seed from which everything else follows.
        effect: hidden effect (the first one of a double case); None to draw it.
        size: size in units of the noise; None to draw it.
        wanted_so: recording conditions that are not drawn.

    Returns:
        The case, or None if the sensors cannot show the effect at this size with a strength up to
        `shapes.LARGEST`, or if another answer explains it too well.
    """
    asked = effect or "any"
    name = "-".join(
        [
            kind,
            system,
            *([asked] if kind != "clean" else []),
            *([f"{size:g}"] if size else []),
            *(str(part) for part in wanted_so if part is not None),
            str(seed),
        ]
    )
    rng = _rng(name, "cause")
    hidden = _hidden(kind, system, effect, rng)
    setting = _setting(name, system, hidden, wanted_so)
    item = Item(
        name, system, kind, {}, 0.0, setting.noise.kind, setting.noise.stated, setting.rate,
        setting.seconds,
        len(setting.scenarios), str(rng.choice(["scipy", "mujoco"])), setting.driven,
        setting.channels, seed,
        setting.parameters, asked=wanted_so,
    )  # fmt: skip
    wanted = size or float(
        np.exp(rng.uniform(np.log(3.0 if kind in ("double", "foreign") else 1.0), np.log(10.0)))
    )
    # The effect must be observable in the runs for fitting, because the held-out runs are not
    # fitted.
    shown = replace(setting, scenarios=setting.scenarios[: item.runs - held_out_of(item)])
    return {"clean": _clean, "single": _single, "double": _double, "foreign": _foreign}[kind](
        item, shown, hidden, wanted, rng
    )


def held_out_of(item: Item) -> int:
    """Return the number of held-out runs; they are the last runs of the recording."""
    return max(1, item.runs // 3)


def _rng(name: str, purpose: str) -> np.random.Generator:
    return np.random.default_rng(list(f"{name} {purpose}".encode()))


@lru_cache(maxsize=16)
def _setting(
    name: str, system: str, hidden: tuple[str, ...], asked: Circumstances = ANY
) -> Setting:
    return drawn_setting(system, _rng(name, "setting"), hidden, asked=asked)


def setting_of(item: Item) -> Setting:
    """Restore the recording conditions of a case."""
    return _setting(item.name, item.system, tuple(item.effects), item.asked)


def _hidden(
    kind: str, system: str, effect: str | None, rng: np.random.Generator
) -> tuple[str, ...]:
    if kind == "clean":
        return ()
    names = (
        list(FOREIGN[system])
        if kind == "foreign"
        else sorted(library.library(SIMULATORS[system].system))
    )
    first = effect or str(rng.choice(names))
    if kind != "double":
        return (first,)
    alike = same_class(system, True, first) | same_class(system, False, first)
    return first, str(rng.choice([n for n in names if n not in alike]))


def _clean(
    item: Item, setting: Setting, hidden: tuple[str, ...], wanted: float, rng: np.random.Generator
) -> Item | None:
    return item


def _single(
    item: Item, setting: Setting, hidden: tuple[str, ...], wanted: float, rng: np.random.Generator
) -> Item | None:
    (name,) = hidden
    c = coefficients(name, setting, wanted, rng)
    if c is None:
        return None
    beyond = None
    if name in SIMPLER and wanted >= 1.0:
        observed = sizing.observed_by_batch(setting, {name: c})
        beyond = min(rivals.left_with(setting, observed, simpler) for simpler in SIMPLER[name])
        if beyond < TELLING:
            return None
    return replace(item, effects={name: c}, size=wanted, beyond=beyond)


def coefficients(
    name: str, setting: Setting, wanted: float, rng: np.random.Generator
) -> tuple[float, ...] | None:
    """Find coefficients of an effect at which the residual has the requested size.

    Args:
        name: name of the effect.
        setting: recording conditions.
        wanted: size in units of the noise.
        rng: random generator for the shape of the effect.

    Returns:
        Coefficients, or None if there are none.
    """
    of = shapes.shape(name, setting, rng)
    left = sizing.gap(
        setting, lambda strength: sizing.observed_by_batch(setting, {name: of(strength)})
    )
    strength = sizing.sized(left, wanted, shapes.largest(name))
    return None if strength is None else of(strength)


def _double(
    item: Item, setting: Setting, hidden: tuple[str, ...], wanted: float, rng: np.random.Generator
) -> Item | None:
    """Hide two effects, each of the requested size alone.

    The case is rejected if one of them explains both.
    """
    found = {name: coefficients(name, setting, wanted, rng) for name in hidden}
    effects = _in_order({name: c for name, c in found.items() if c is not None})
    if len(effects) < len(found):
        return None
    observed = sizing.observed_by_batch(setting, effects)
    if not np.isfinite(observed).all():
        return None
    beyond = min(rivals.left_with(setting, observed, name, effects[name]) for name in effects)
    return replace(item, effects=effects, size=wanted, beyond=beyond) if beyond >= APART else None


def _in_order(effects: dict[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    """Put a lag of the input last: nonlinear input effects act on the command."""
    return dict(sorted(effects.items(), key=lambda pair: pair[0] == "input.lag"))


def _foreign(
    item: Item, setting: Setting, hidden: tuple[str, ...], wanted: float, rng: np.random.Generator
) -> Item | None:
    """Hide an unmodelled cause, which the library explains only in part."""
    (name,) = hidden
    of = shapes.foreign(name, setting, rng)

    def observed(strength: float) -> Array:
        world = setting.world(foreign={name: of(strength)})
        return np.array(
            [solved(world, s, setting.channels, i) for i, s in enumerate(setting.scenarios)]
        )

    strength = sizing.sized(sizing.gap(setting, observed), wanted, shapes.LARGEST)
    if strength is None:
        return None
    _, beyond = rivals.best(setting, observed(strength))
    hides = replace(item, effects={name: of(strength)}, size=wanted, beyond=beyond, source="scipy")
    return hides if beyond >= APART else None


def realise(item: Item, folder: str | Path, truth: bool = True) -> Path:
    """Write the recording of a case as NAME.csv and NAME.toml.

    Args:
        item: the case.
        folder: folder for the files.
        truth: whether to write NAME.truth.json too.

    Returns:
        Path of the CSV file.
    """
    setting = setting_of(item)
    runs = _runs(item, setting)
    system = SIMULATORS[item.system].system
    noise = setting.noise.sigma if item.stated else {}
    constants = {} if item.system == "slider" else setting.constants
    path = Path(folder) / f"{item.name}.csv"
    beside = (
        {path.with_suffix(".truth.json"): json.dumps(item.json(), indent=1) + "\n"} if truth else {}
    )
    write_recording(
        path,
        Recording(path, item.system, "", constants, noise, runs),
        system,
        digits=9,
        beside=beside,
    )
    return path


def _runs(item: Item, setting: Setting) -> tuple[Run, ...]:
    rng, held_out = _rng(item.name, "noise"), held_out_of(item)
    hidden = {"foreign": item.effects} if item.kind == "foreign" else {"effects": item.effects}
    world, runs = setting.world(**hidden), []
    for number, scenario in enumerate(setting.scenarios):
        if item.source == "mujoco":
            observed = simulated(world, scenario, setting.channels)
        else:
            observed = solved(world, scenario, setting.channels, number)
        recorded = setting.noise.added(observed, rng)
        channels = dict(zip(setting.channels, recorded.T, strict=True))
        last = number >= item.runs - held_out
        runs.append(Run(str(number), scenario.times, channels, scenario.inputs, {}, {}, last))
    return tuple(runs)
