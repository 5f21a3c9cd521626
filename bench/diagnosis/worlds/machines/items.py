"""Questions about machines: what is hidden in which, how strongly, and the recording of it.

Sizes are of first order: what is left of the change that a cause makes to the noiseless motion
after parameters and initial states have taken up what they can, by least squares over their
derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis.worlds.item import Item
from bench.diagnosis.worlds.machines import causes
from bench.diagnosis.worlds.machines.files import NAME, model_file
from bench.diagnosis.worlds.machines.motion import Runs, moved, read
from bench.diagnosis.worlds.machines.plants import PLANTS, Effects
from bench.diagnosis.worlds.machines.settings import Setting
from bench.diagnosis.worlds.machines.settings import setting as drawn_setting
from bench.diagnosis.worlds.settings import ANY, Circumstances
from bench.diagnosis.worlds.sizing import sized
from sims.base import Array

SYSTEMS = tuple(PLANTS)
"""Machines."""
APART = 1.0
"""Noises that must be left when only one of two effects, or no foreign cause, is in the model."""
TELLING = 0.4
"""Noises that the simpler form of an effect must leave, or else it is the right answer."""
SIMPLER = {"friction.stribeck": "friction.coulomb"}
_NUDGE = 1e-4
"""Of a number for its derivative: a share of a parameter, rad or rad/s of an initial state."""
_PROBE = 0.1
"""Strength at which other causes' directions are taken."""
_COARSE = 2.0
"""Steps of these are so many times longer."""


def draw(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    wanted_so: Circumstances = ANY,
) -> Item | None:
    """An item, or None where encoders cannot show it; see `bench.diagnosis.worlds.items.draw`."""
    words = [kind, system, effect or "any", *([f"{size:g}"] if size else [])]
    words += [str(part) for part in wanted_so if part is not None]
    name = "-".join([*words, str(seed)])
    made, rng = setting_of(name, system, wanted_so), _rng(name, "cause")
    item = Item(
        name,
        system,
        kind,
        {},
        0.0,
        made.noise.kind,
        made.noise.stated,
        made.rate,
        made.seconds,
        len(made.runs.q),
        "own equations",
        True,
        PLANTS[system].channels,
        seed,
        made.parameters,
        asked=wanted_so,
    )
    if kind == "clean":
        return item
    low = 3.0 if kind in ("double", "foreign") else 1.0
    wanted = size or float(np.exp(rng.uniform(np.log(low), np.log(10.0))))
    hidden = {"single": _single, "double": _double, "foreign": _foreign}[kind]
    return hidden(item, made, effect, wanted, rng)


def _rng(name: str, purpose: str) -> np.random.Generator:
    return np.random.default_rng(list(f"{name} {purpose}".encode()))


@lru_cache(maxsize=4)
def setting_of(name: str, system: str, asked: Circumstances = ANY) -> Setting:
    """The circumstances in which the item of this name was drawn."""
    return drawn_setting(system, _rng(name, "setting"), asked)


def _placed(item: Item, effect: str | None, rng: np.random.Generator, but: str = "") -> str:
    """Effect and place that are drawn, as far as they are not given."""
    chosen = effect or str(rng.choice(causes.EFFECTS[item.system]))
    there = [name for name in causes.places(item.system, chosen) if name != but]
    return str(rng.choice(there)) if there else ""


def _single(
    item: Item, made: Setting, effect: str | None, wanted: float, rng: np.random.Generator
) -> Item | None:
    name = _placed(item, effect, rng)
    c = _sized(name, made, wanted, rng)
    if c is None:
        return None
    effect, _, place = name.partition("@")
    beyond = None
    if effect in SIMPLER and wanted >= 1.0:
        other = f"{SIMPLER[effect]}@{place}" if place else SIMPLER[effect]
        rivals = [other, f"drag.linear@{place}" if place else "drag.quadratic"]
        beyond = _beyond(made, {name: c}, {}, rivals, rng)
        if beyond < TELLING:
            return None
    return replace(item, effects={name: c}, size=wanted, beyond=beyond)


def _sized(
    name: str, made: Setting, wanted: float, rng: np.random.Generator
) -> tuple[float, ...] | None:
    """Coefficients at which a cause leaves the wanted size; None if there are none."""
    of = causes.shape(name, made, rng)
    gauge = _Gauge(made)
    strength = sized(lambda s: gauge.left(made.seen({name: of(s)})), wanted, 1.0)
    return None if strength is None else of(strength)


def _double(
    item: Item, made: Setting, effect: str | None, wanted: float, rng: np.random.Generator
) -> Item | None:
    """Two effects, each of the wanted size alone; neither may look like more of the other."""
    first = _placed(item, effect, rng)
    second = _placed(item, None, rng, but=first)
    if not second or second in same_class(item.system, first):
        return None
    found = {name: _sized(name, made, wanted, rng) for name in (first, second)}
    effects = {name: c for name, c in found.items() if c is not None}
    if len(effects) < 2:
        return None
    beyond = min(_beyond(made, effects, {}, [name], rng) for name in effects)
    return replace(item, effects=effects, size=wanted, beyond=beyond) if beyond >= APART else None


def _foreign(
    item: Item, made: Setting, cause: str | None, wanted: float, rng: np.random.Generator
) -> Item | None:
    """A cause that the library does not have, and of which it explains only a part."""
    chosen = cause or str(rng.choice(causes.FOREIGN))
    joint = str(rng.choice(PLANTS[item.system].joints))
    name = f"{chosen}@{joint}" if joint else chosen
    of, gauge = causes.foreign(name, made, rng), _Gauge(made)
    strength = sized(lambda s: gauge.left(made.seen(foreign={name: of(s)})), wanted, 1.0)
    if strength is None:
        return None
    hidden = {name: of(strength)}
    known = [n for e in causes.EFFECTS[item.system] for n in causes.places(item.system, e)]
    beyond = _beyond(made, {}, hidden, known, rng)
    return replace(item, effects=hidden, size=wanted, beyond=beyond) if beyond >= APART else None


def _beyond(
    made: Setting,
    effects: Effects,
    foreign: Effects,
    others: Sequence[str],
    rng: np.random.Generator,
) -> float:
    """What the best of other causes leaves of a change, in noises, to first order."""
    gauge = _Gauge(made)
    change = made.seen(effects, foreign) - gauge.bare
    bare = made.seen(coarse=_COARSE)
    left = []
    for name in others:
        of = causes.shape(name, made, rng)
        probe = {name: effects[name]} if name in effects else {name: of(_PROBE)}
        direction = made.seen(probe, coarse=_COARSE) - bare
        left.append(gauge.projected(change, direction))
    return min(left)


class _Gauge:
    """What parameters and initial states leave of a change, in noises.

    Args:
        made: its runs for fitting are those that count.

    Attributes:
        bare: (R, T, N) what is seen with nothing hidden.
    """

    def __init__(self, made: Setting) -> None:
        self.made = made
        runs, joints = made.fitted.q.shape
        numbers = list(made.parameters)
        lanes = 1 + len(numbers) + 2 * joints
        # Every run once as it is, and once for every number that is fitted.
        fitted = Runs(
            made.fitted.times,
            np.repeat(made.fitted.commands, lanes, axis=0),
            np.repeat(made.fitted.q, lanes, axis=0),
            np.repeat(made.fitted.v, lanes, axis=0),
        )
        values = {name: np.full((runs, lanes), value) for name, value in made.numbers.items()}
        for k, name in enumerate(numbers):
            values[name][:, 1 + k] *= 1 + _NUDGE
        q, v = (part.reshape(runs, lanes, joints).copy() for part in (fitted.q, fitted.v))
        for j in range(joints):
            q[:, 1 + len(numbers) + j, j] += _NUDGE
            v[:, 1 + len(numbers) + joints + j, j] += _NUDGE
        plant = PLANTS[made.system]({n: a.ravel() for n, a in values.items()}, {}, {})
        begun = fitted._replace(q=q.reshape(-1, joints), v=v.reshape(-1, joints))
        seen = read(moved(plant, begun), plant, made.runs.times)
        seen = seen.reshape(runs, lanes, -1)
        slopes = (seen[:, 1:] - seen[:, :1]) / _NUDGE
        shared = np.concatenate(slopes[:, : len(numbers)], axis=1).T
        own = np.zeros((runs, slopes.shape[2], runs, 2 * joints))
        for r in range(runs):
            own[r, :, r] = slopes[r, len(numbers) :].T
        columns = np.column_stack([shared, own.reshape(runs * slopes.shape[2], -1)])
        self.bare = seen[:, 0].reshape(runs, len(made.runs.times), joints)
        self._basis = _orthonormal(columns)

    def left(self, seen: Array) -> float:
        """Of what is seen with something hidden."""
        return self._size((seen - self.bare).ravel())

    def projected(self, change: Array, direction: Array) -> float:
        """What a direction besides leaves of a change."""
        rest, way = (self._rest(part.ravel()) for part in (change, direction))
        if way @ way > 0:
            rest = rest - way * (way @ rest) / (way @ way)
        return float(np.sqrt(np.mean(rest**2)) / self.made.sigma)

    def _size(self, change: Array) -> float:
        if not np.isfinite(change).all():
            return float("inf")
        return float(np.sqrt(np.mean(self._rest(change) ** 2)) / self.made.sigma)

    def _rest(self, change: Array) -> Array:
        rest: Array = change - self._basis @ (self._basis.T @ change)
        return rest


def _orthonormal(columns: Array) -> Array:
    """A basis of what columns span; what hardly stands apart from the others is left out."""
    scale = np.sqrt(np.square(columns).sum(axis=0))
    left, sizes, _ = np.linalg.svd(columns / np.where(scale > 0, scale, 1.0), full_matrices=False)
    basis: Array = left[:, sizes > 1e-6 * sizes[0]]
    return basis


SAME: dict[str, tuple[frozenset[str], ...]] = {
    # A motor that never reaches its limit turns a shift of the goal into a torque.
    "servo": (frozenset({"force.bias", "input.bias"}),),
    "arm2": tuple(
        frozenset(names)
        for joint, body in (("shoulder", "upper_arm"), ("elbow", "forearm"))
        for names in (
            {f"force.bias@{joint}", f"input.bias@m_{joint}"},
            *([{f"inertia.armature@{joint}", f"inertia.scale@{body}"}] * (joint == "shoulder")),
        )
    ),
}
"""Causes that give the same motion exactly, whatever the data."""


def same_class(system: str, name: str) -> frozenset[str]:
    """The cause and all that are equivalent to it."""
    return frozenset({name}).union(*(names for names in SAME[system] if name in names))


def recorded(item: Item) -> tuple[Setting, Array]:
    """The setting of an item, and (R, T, N) what its encoders recorded."""
    made = setting_of(item.name, item.system, item.asked)
    hidden = item.effects
    foreign = item.kind == "foreign"
    plant = made.plant({} if foreign else hidden, hidden if foreign else {})
    seen = read(moved(plant, made.runs), plant, made.runs.times)
    rng = _rng(item.name, "noise")
    return made, np.array([made.noise.added(run, rng) for run in seen])


def described(item: Item, made: Setting) -> dict[str, object]:
    """The recording's description, as the document of a TOML file."""
    robot = item.system == "arm2"
    plant = PLANTS[item.system]
    stated = {"noise": made.sigma} if item.stated else {}
    channels = {name: {"unit": "rad", **stated} for name in plant.channels}
    inputs = (
        {f"u.{name}": {"unit": "N*m"} for name in plant.motors}
        if robot
        else {"goal": {"unit": "rad"}, "torque_enable": {"unit": "1"}}
    )
    first = item.runs - made.held_out
    runs = {str(number): {"held_out": True} for number in range(first, item.runs)}
    of = {"model": NAME} if robot else {"system": item.system}
    constants = {} if robot else {"constants": _stated_constants(made)}
    return {**of, "channels": channels, "inputs": inputs, **constants, "runs": runs}


def _stated_constants(made: Setting) -> dict[str, float]:
    return {name: v for name, v in made.numbers.items() if name not in made.parameters}


def table(item: Item, made: Setting, seen: Array) -> str:
    """The recording's table as CSV."""
    plant, robot = PLANTS[item.system], item.system == "arm2"
    inputs = [f"u.{name}" for name in plant.motors] if robot else ["goal", "torque_enable"]
    lines = [",".join(["run", "t", *inputs, *plant.channels])]
    for number, run in enumerate(seen):
        for k, t in enumerate(made.runs.times.tolist()):
            told = made.runs.commands[number, k].tolist() + ([] if robot else [1.0])
            cells = [t, *told, *run[k].tolist()]
            lines.append(",".join([str(number), *(f"{value:.9g}" for value in cells)]))
    return "\n".join(lines) + "\n"


def written(item: Item, folder: Path) -> Path:
    """Write the recording, its description and what lies beside it; the table's path."""
    import tomli_w

    made, seen = recorded(item)
    if item.system == "arm2":
        (folder / NAME).write_text(model_file(made.numbers), encoding="utf-8")
    path = folder / "recording.csv"
    path.write_text(table(item, made, seen), encoding="utf-8")
    description = tomli_w.dumps(described(item, made))
    path.with_suffix(".toml").write_text(description, encoding="utf-8")
    return path
