"""Ranges as a `domain_randomize` function of MuJoCo Playground.

Such a function takes the model of MJX and one random key for each environment. It returns the model
with a leading axis in the fields that it sets, and `in_axes` for `jax.vmap`
(mujoco_playground/_src/locomotion/go1/randomize.py of google-deepmind/mujoco_playground). All
numbers are absolute, so that the function can be used with the original model file and with
extended.xml.
"""

from __future__ import annotations

from typing import Any

from bench.diagnosis.randomization.code_text import list_heading, render_code
from bench.diagnosis.randomization.ranges import RandomizationRange, RandomizationRanges, texts
from sims.extended_simulator import ExtendedSimulator

OBJECTS = {"joint": "mjOBJ_JOINT", "body": "mjOBJ_BODY", "actuator": "mjOBJ_ACTUATOR"}
"""MuJoCo's object types by kind of place."""


def render_mujoco_playground_code(
    ranges: RandomizationRanges, extended: ExtendedSimulator, robot: Any
) -> str:
    """Return a Python file with a function `domain_randomize`.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        robot: Robot with its compiled model.
    """
    sentences = dict(texts(ranges))
    # Setting the mass also scales the inertia, and setting the size of gravity its components, so
    # inertia and components are set afterwards.
    with_fields = sorted((r for r in ranges.ranges if r.fields), key=_is_last)
    fields = dict.fromkeys(name for entry in with_fields for name in _list_fields(entry))
    places = dict.fromkeys((r.kind, r.name) for r in with_fields if r.kind in OBJECTS)
    return render_code(
        "ranges_mujoco_playground.py",
        heading=list_heading(extended, "MuJoCo Playground", ranges.left_out),
        ranges=with_fields,
        texts=sentences,
        fields=list(fields),
        variables={place: f"{place[0]}_{k}" for k, place in enumerate(places)},
        gravity=robot.compiled.opt.gravity.tolist(),
        robot=robot,
        without_field=[f"- {sentences[r]}" for r in ranges.ranges if not r.fields],
        index=_format_index,
        OBJECTS=OBJECTS,
    )


def _is_last(entry: RandomizationRange) -> bool:
    return entry.effect in ("inertia.scale", "gravity.tilt")


def _list_fields(entry: RandomizationRange) -> list[str]:
    """List the names of the fields that a range sets."""
    names = [field.name for field in entry.fields]
    return [*names, "body_inertia"] if entry.effect == "mass.scale" else names


def _format_index(entry: RandomizationRange, place: str, address: tuple[int, ...]) -> str:
    """Format the index of an element, based on the variable of its joint, body or actuator."""
    if not place:
        return ", ".join(str(k) for k in address)
    first = f"model.jnt_dofadr[{place}]" if entry.field.startswith("dof_") else place
    return ", ".join([first, *(str(k) for k in address[1:])])
