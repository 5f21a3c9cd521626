"""The exam's questions: recordings of independent simulators in which a cause is hidden, drawn from a seed.

`draw` chooses what is hidden and how strongly, `realise` writes the recording and, apart from it, the truth. Whatever is
drawn follows from the item's name; an item is a recipe, no data.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from sims import effects as library
from sims.recording import Recording, Run
from sims.recording_write import write_recording
from tests.exam import rivals, shapes, sizing
from tests.exam.settings import setting as drawn_setting
from tests.exam.worlds import FOREIGN, SIMULATORS, simulated, solved

SYSTEMS = ("ball", "pendulum", "slider")
KINDS = ("clean", "single", "double", "foreign")
SMALL = (0.1, 0.2, 0.3, 0.5)  # sizes asked for the power curve only

APART = 1.0  # noise: what must be left when only one of two effects, or no foreign cause, is in the model

EQUIVALENT: tuple[tuple[str, frozenset[str]], ...] = (
    ("slider", frozenset({"gravity.tilt", "force.bias", "input.bias"})),
    ("pendulum", frozenset({"force.bias", "input.bias"})),
    ("pendulum", frozenset({"input.gain", "gravity.scale"})),
    ("ball", frozenset({"force.bias", "gravity.scale", "clock.skew"})),  # as long as no accelerometer is recorded
)
"""Effects that give the same motion for some parameters and initial states: exact, whatever the data."""


@dataclass(frozen=True)
class Item:
    """One question.

    Attributes:
        name: says kind, system, what was asked for, and seed.
        system, kind: see `SYSTEMS`, `KINDS`.
        effects: coefficients of what is hidden, by name; of a foreign cause its own numbers.
        size: RMS of the gap that refitted base parameters and initial states leave, in units of the noise; of two
            effects that of the smaller one on top of the other.
        noise: white, ar1 or quantised.
        stated: whether the recording states the noise.
        rate, seconds, runs: sampling in Hz, a run's length, how many.
        source: scipy or mujoco.
        seed: what it was drawn from.
        parameters: the base parameters.
        beyond: what the best effect of the library leaves of the gap, in units of the noise; of a foreign cause only.
    """

    name: str
    system: str
    kind: str
    effects: dict[str, tuple[float, ...]]
    size: float
    noise: str
    stated: bool
    rate: int
    seconds: float
    runs: int
    source: str
    seed: int
    parameters: dict[str, float] = field(default_factory=dict)
    beyond: float | None = None

    def json(self):
        return asdict(self)

    @classmethod
    def of(cls, document):
        """An item from its JSON."""
        return cls(**{**document, "effects": {name: tuple(c) for name, c in document["effects"].items()}})


def same_class(system, effect):
    """The effect and all that are equivalent to it."""
    return frozenset({effect}).union(*(names for of, names in EQUIVALENT if of == system and effect in names))


def draw(kind, system, seed, effect=None, size=None):
    """An item, or None where the drawn sensors cannot show the effect at the drawn size (within `shapes.LARGEST`).

    Args:
        kind: clean, single, double or foreign.
        system: ball, pendulum or slider.
        seed: everything else follows from it.
        effect: what to hide (of two, the first); drawn where it is not given.
        size: the wanted size; drawn where it is not given.
    """
    asked = effect or "any"
    name = "-".join([kind, system, *([asked] if kind != "clean" else []), *([f"{size:g}"] if size else []), str(seed)])
    rng = _rng(name, "cause")
    hidden = _hidden(kind, system, effect, rng)
    setting = _setting(name, system, hidden)
    item = Item(
        name, system, kind, {}, 0.0, setting.noise.kind, setting.noise.stated, setting.rate, setting.seconds,
        len(setting.scenarios), str(rng.choice(["scipy", "mujoco"])), seed, setting.parameters,
    )  # fmt: skip
    wanted = size or float(np.exp(rng.uniform(np.log(3.0 if kind in ("double", "foreign") else 1.0), np.log(10.0))))
    return {"clean": _clean, "single": _single, "double": _double, "foreign": _foreign}[kind](
        item, setting, hidden, wanted, rng
    )


def _rng(name, purpose):
    return np.random.default_rng(list(f"{name} {purpose}".encode()))


def _setting(name, system, hidden):
    return drawn_setting(system, _rng(name, "setting"), hidden)


def _hidden(kind, system, effect, rng):
    if kind == "clean":
        return ()
    names = list(FOREIGN[system]) if kind == "foreign" else sorted(library.library(SIMULATORS[system].system))
    first = effect or str(rng.choice(names))
    if kind != "double":
        return (first,)
    return first, str(rng.choice([n for n in names if n not in same_class(system, first)]))


def _clean(item, setting, hidden, wanted, rng):
    return item


def _single(item, setting, hidden, wanted, rng):
    (name,) = hidden
    c = coefficients(name, setting, wanted, rng)
    return None if c is None else replace(item, effects={name: c}, size=wanted)


def coefficients(name, setting, wanted, rng):
    """Coefficients of one effect at which the gap has the wanted size; None if there are none."""
    of = shapes.shape(name, setting, rng)
    left = sizing.gap(setting, lambda strength: sizing.observed_by_batch(setting, {name: of(strength)}))
    strength = sizing.sized(left, wanted, shapes.largest(name))
    return None if strength is None else of(strength)


def _double(item, setting, hidden, wanted, rng):
    """Two effects, each of the wanted size alone; neither may look like a stronger form of the other."""
    found = {name: coefficients(name, setting, wanted, rng) for name in hidden}
    if None in found.values():
        return None
    effects = _in_order(found)
    observed = sizing.observed_by_batch(setting, effects)
    if not np.isfinite(observed).all():
        return None
    beyond = min(rivals.left_with(setting, observed, name, effects[name]) for name in effects)
    return replace(item, effects=effects, size=wanted, beyond=beyond) if beyond >= APART else None


def _in_order(effects):
    """A lag of the input comes last: what is not linear acts on what is commanded."""
    return dict(sorted(effects.items(), key=lambda pair: pair[0] == "input.lag"))


def _foreign(item, setting, hidden, wanted, rng):
    """A cause that the library does not have, and of which it explains only a part."""
    (name,) = hidden
    of = shapes.foreign(name, setting, rng)

    def observed(strength):
        world = setting.world(foreign={name: of(strength)})
        return np.array([solved(world, s, setting.channels, i) for i, s in enumerate(setting.scenarios)])

    strength = sizing.sized(sizing.gap(setting, observed), wanted, shapes.LARGEST)
    if strength is None:
        return None
    _, beyond = rivals.best(setting, observed(strength))
    hides = replace(item, effects={name: of(strength)}, size=wanted, beyond=beyond, source="scipy")
    return hides if beyond >= APART else None


def realise(item, folder):
    """Write NAME.csv and NAME.toml, and the truth as NAME.truth.json; the path of the first."""
    setting = _setting(item.name, item.system, tuple(item.effects) if item.kind != "clean" else ())
    runs = _runs(item, setting)
    system = SIMULATORS[item.system].system
    noise = setting.noise.sigma if item.stated else {}
    constants = {} if item.system == "slider" else setting.constants
    path = Path(folder) / f"{item.name}.csv"
    truth = {path.with_suffix(".truth.json"): json.dumps(item.json(), indent=1) + "\n"}
    write_recording(path, Recording(path, item.system, "", constants, noise, runs), system(), digits=9, beside=truth)
    return path


def _runs(item, setting):
    rng, held_out = _rng(item.name, "noise"), max(1, item.runs // 3)
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
