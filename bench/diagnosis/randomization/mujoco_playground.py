"""Ranges as a `domain_randomize` function of MuJoCo Playground.

Such a function takes the model of MJX and one random key for each environment. It returns the model
with a leading axis in the fields that it sets, and `in_axes` for `jax.vmap`
(mujoco_playground/_src/locomotion/go1/randomize.py of google-deepmind/mujoco_playground). All
numbers are absolute, so that the function can be used with the original model file and with
extended.xml.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bench.diagnosis.randomization.code_text import comment, heading, literal, number
from bench.diagnosis.randomization.ranges import RandomizationRange, RandomizationRanges, texts
from sims.extended_simulator import ExtendedSimulator

OBJECTS = {"joint": "mjOBJ_JOINT", "body": "mjOBJ_BODY", "actuator": "mjOBJ_ACTUATOR"}
"""MuJoCo's object types by kind of place."""
IMPORTS = """
import jax
import jax.numpy as jp
import mujoco
from mujoco import mjx


def _find(model: mjx.Model, kind: mujoco.mjtObj, name: str) -> int:
  number = mjx.name2id(model, kind, name)
  if number < 0:
    raise ValueError(f"the model has no {kind.name} {name!r}")
  return number


def domain_randomize(model: mjx.Model, rng: jax.Array):
""".splitlines()


def mujoco_playground_code(
    ranges: RandomizationRanges, extended: ExtendedSimulator, robot: Any
) -> str:
    """Return a Python file with a function `domain_randomize`.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        robot: Robot with its compiled model.
    """
    said = dict(texts(ranges))
    # Setting the mass also scales the inertia, and setting the size of gravity its components, so
    # inertia and components are set afterwards.
    set_ranges = sorted((one for one in ranges.ranges if one.fields), key=_is_last)
    names = list(dict.fromkeys(name for one in set_ranges for name in _fields(one)))
    lines = [*heading(extended, "MuJoCo Playground", ranges.left_out)]
    lines += comment(
        "Load extended.xml as the model: dry friction and limits that the original file does not "
        "state need settings that are not randomised (solreffriction, forcelimited)."
    )
    lines += comment(
        "registry.get_domain_randomizer returns such a function; training takes it as "
        "randomization_fn."
    )
    lines += IMPORTS
    places = dict.fromkeys((one.kind, one.name) for one in set_ranges if one.kind in OBJECTS)
    variables = {place: f"{place[0]}_{k}" for k, place in enumerate(places)}
    for (kind, name), variable in variables.items():
        lines.append(f"  {variable} = _find(model, mujoco.mjtObj.{OBJECTS[kind]}, {literal(name)})")
    lines += ["", "  @jax.vmap", "  def rand_dynamics(rng):"]
    lines += [f"    {_variable(name)} = model.{name}" for name in names]
    for one in set_ranges:
        lines += ["", *comment(said[one], "    ")]
        lines += _draw(one, variables.get((one.kind, one.name), ""), robot)
    own = [_variable(name) for name in names]
    lines += ["", f"    return ({', '.join(own)},)", "", "  values = rand_dynamics(rng)"]
    keys = ", ".join(f'"{name}"' for name in names)
    lines += [f"  names = ({keys},)", "  in_axes = jax.tree_util.tree_map(lambda x: None, model)"]
    lines += ["  in_axes = in_axes.tree_replace(dict.fromkeys(names, 0))"]
    lines += ["  model = model.tree_replace(dict(zip(names, values)))", "  return model, in_axes"]
    if rest := [one for one in ranges.ranges if not one.fields]:
        lines += ["", ""]
        lines += comment("No field of the model holds these numbers; set them in your environment:")
        for one in rest:
            lines += comment(f"- {said[one]}")
    return "\n".join(lines) + "\n"


def _is_last(one: RandomizationRange) -> bool:
    return one.effect in ("inertia.scale", "gravity.tilt")


def _fields(one: RandomizationRange) -> Iterator[str]:
    """Yield the names of the fields that a range sets."""
    yield from dict.fromkeys(field.name for field in one.fields)
    if one.effect == "mass.scale":
        yield "body_inertia"


def _variable(field: str) -> str:
    return field.replace(".", "_")


def _draw(one: RandomizationRange, place: str, robot: Any) -> Iterator[str]:
    """Yield code that draws a number and sets it in the fields."""
    ends = f"minval={number(one.low)}, maxval={number(one.high)}"
    yield "    rng, key = jax.random.split(rng)"
    yield f"    value = jax.random.uniform(key, {ends})"
    if one.effect == "mass.scale":
        yield f"    body_mass = body_mass.at[{place}].set(value)"
        yield f"    inertia = model.body_inertia[{place}] * value / model.body_mass[{place}]"
        yield f"    body_inertia = body_inertia.at[{place}].set(inertia)"
    elif one.effect == "inertia.scale":
        inertia = f"model.body_inertia[{place}]"
        yield f"    inertia = {inertia} * value / jp.max({inertia})"
        yield f"    body_inertia = body_inertia.at[{place}].set(inertia)"
    elif one.effect == "gravity.scale":
        stated = [number(v / (one.nominal or 1.0)) for v in robot.compiled.opt.gravity.tolist()]
        yield f"    opt_gravity = value * jp.array([{', '.join(stated)}])"
    elif one.effect == "actuator.limit":
        actuator = robot.actuator(one.name)
        yield "    limits = jp.array([-value, value])"
        if actuator.force is not None:
            yield f"    limits = jp.clip(limits, {', '.join(map(number, actuator.force))})"
        yield f"    actuator_forcerange = actuator_forcerange.at[{place}].set(limits)"
    else:
        for field in one.fields:
            index = _index(one, place, field.address)
            name, sign = _variable(field.name), "-" if field.sign < 0 else ""
            yield f"    {name} = {name}.at[{index}].set({sign}value)"


def _index(one: RandomizationRange, place: str, address: tuple[int, ...]) -> str:
    """Format the index of an element, based on the variable of its joint, body or actuator."""
    if not place:
        return ", ".join(str(k) for k in address)
    first = f"model.jnt_dofadr[{place}]" if one.field.startswith("dof_") else place
    return ", ".join([first, *(str(k) for k in address[1:])])
