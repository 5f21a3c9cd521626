"""Benchmark cases of floating-base robots: draw a case from its name and write its files."""

from __future__ import annotations

import csv
import hashlib
import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.robot_exam import cause_sizing, causes_outside_library, planted_effects
from tests.robot_exam.floating_base import floating_robots
from tests.robot_exam.floating_base.floating_settings import HELD_OUT, FloatGauge, setting, stated
from tests.robot_exam.floating_base.floating_world import FloatWorld
from tests.robot_exam.robot_items import TELLING, Item, _wanted, rng_of
from tests.robot_exam.sensor_models import observed

SHARED = (
    "friction.coulomb", "friction.stribeck", "drag.linear", "spring.linear", "force.bias",
    "inertia.armature", "mass.scale", "mass.offset", "inertia.scale", "input.gain", "input.bias",
    "input.delay", "input.lag", "sensor.gain", "sensor.delay",
)  # fmt: skip
OWN = {
    "satellite-motor": ("input.deadband",),
    "dropped-servo": ("actuator.stiffness", "actuator.damping"),
    "hung-motor": ("gravity.scale", "input.deadband"),
}
CLEAN = 40
"""Count of clean questions per robot."""
ATTEMPTS = 4
FOREIGN_APART = 1.0
"""Smallest residual of an unmodelled cause after fitting one effect at its joint, in sigmas."""


def questions():
    """Return (kind, robot, effect, index) of all questions.

    They are sorted by hash, so that the questions answered first are a fair sample.
    """
    sheet = []
    for robot in floating_robots.NAMES:
        sheet += [("clean", robot, "any", index) for index in range(CLEAN)]
        sheet += [("single", robot, effect, 0) for effect in SHARED + OWN[robot]]
        sheet += [("foreign", robot, cause, 0) for cause in planted_effects.FOREIGN]
    return sorted(sheet, key=lambda one: hashlib.sha256(repr(one).encode()).digest())


def drawn(kind, robot, effect, index):
    """Return the first drawing whose cause is visible, with its setting; None if there is none."""
    for attempt in range(ATTEMPTS):
        name = f"{kind}/{robot}/{effect}/{10 * index + attempt}"
        found = _draw(name, kind, robot, effect)
        if found is not None:
            return found
    return None


def bare(name, effects):
    """Return the case of a name with given effects, and its setting; no size is measured."""
    kind, robot, *_ = name.split("/")
    made = setting(robot, rng_of(name, "setting"))
    item = Item(
        name, kind, robot, effects, False, 0.0, made.noise.kind, made.channels, None, 0.0,
        made.machine.step, made.machine.integrator,
    )  # fmt: skip
    return item, made


def _draw(name, kind, robot, effect):
    (item, made), rng = bare(name, {}), rng_of(name, "cause")
    if kind == "clean":
        return item, made
    gauge, machine = FloatGauge(made), made.machine
    if kind == "foreign":
        of = causes_outside_library.drawn(effect, int(rng.choice(machine.driven)), made, rng)
    else:
        place = str(rng.choice(_places(machine, effect)))
        coefficients = planted_effects.shape(effect, place, made, rng)
        name = planted_effects.named(effect, place)

        def of(strength):
            return {name: coefficients(strength)}

    found = cause_sizing.sized(lambda strength: gauge.gap(of(strength)), _wanted(rng))
    if found is None:
        return None
    hidden, beyond = of(found[0]), None
    change = np.concatenate(gauge.change(hidden))
    rivals = _near(made, hidden, gauge, rng) if kind == "foreign" else _simpler(hidden, gauge)
    if rivals:
        beyond = min(cause_sizing.left(change, [rival]) for rival in rivals)
        if beyond < (FOREIGN_APART if kind == "foreign" else TELLING):
            return None
    return replace(item, effects=hidden, size=found[1], beyond=beyond), made


def _places(machine, effect):
    places = planted_effects.places(machine, effect)
    return list(dict.fromkeys(place for place in places if "~" not in place))


def _simpler(hidden, gauge):
    """Return the changes that the simpler form of an effect causes, if there is one."""
    ((name, c),) = hidden.items()
    effect, _, place = name.partition("@")
    if effect not in planted_effects.SIMPLER:
        return []
    other = f"{planted_effects.SIMPLER[effect]}@{place}"
    sizes = [share * (c[0] + abs(c[1])) for share in (0.3, 0.6)]
    return [np.concatenate(gauge.change({other: (size,)})) for size in sizes]


def _near(made, hidden, gauge, rng):
    """Return the changes that single effects at the joint of an unmodelled cause make."""
    ((_, c),) = hidden.items()
    joint = made.machine.joints[int(c[0])]
    changed = []
    for effect in ("friction.coulomb", "drag.linear", "spring.linear", "force.bias"):
        size = planted_effects.shape(effect, joint, made, rng)(0.05)
        changed.append(np.concatenate(gauge.change({f"{effect}@{joint}": size})))
    return changed


def written(item, made, folder):
    """Write log.csv, log.toml and robot.xml, and return the path of log.csv.

    No file reveals the hidden cause.
    """
    folder, machine = Path(folder), made.machine
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(machine.mjcf())
    (folder / "log.toml").write_text(_described(made))
    library = {} if item.kind == "foreign" else item.effects
    world = FloatWorld(machine, library, causes_outside_library.plant_of(item.effects))
    rng, text = rng_of(item.name, "noise"), io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["run", "t", *(f"u.{d.name}" for d in machine.drives), *made.channels])
    for number, run in enumerate(made.runs):
        slips = causes_outside_library.slips_of(item.effects, number)
        seen = made.noise.add_to(observed(world, run, made.channels, slips), rng)
        told = np.column_stack([run.commands[drive.name] for drive in machine.drives])
        for t, row in zip(run.times, np.hstack([told, seen]), strict=True):
            table.writerow([number, f"{t:.2f}", *(f"{x:.9g}" for x in row)])
    (folder / "log.csv").write_text(text.getvalue())
    return folder / "log.csv"


def _described(made):
    machine = made.machine
    lines = ['model = "robot.xml"', ""]
    for name in made.channels:
        unit = "rad" if name.startswith("q.") else "rad/s"
        lines += [
            f'[channels."{name}"]',
            f'unit = "{unit}"',
            f"noise = {made.noise.sigma[name]:.6g}",
        ]
    for drive in machine.drives:
        lines += [f'[inputs."u.{drive.name}"]', f'unit = "{"rad" if drive.kp else "N*m"}"']
    for number, run in enumerate(made.runs):
        if number >= len(made.runs) - HELD_OUT:
            lines += [f"[runs.{number}]", "held_out = true"]
        lines.append(f"[runs.{number}.initial]")
        lines += [f'"{name}" = {value!r}' for name, value in stated(machine, run).items()]
    return "\n".join(lines) + "\n"
