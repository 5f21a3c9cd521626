"""Files of `simgap explain --ranges`: TOML, CSV, and code for Isaac Lab and MuJoCo Playground.

The function for MuJoCo Playground takes the model of MJX and one random key for each environment.
It returns the model with a leading axis in the fields that it sets, and `in_axes` for `jax.vmap`
(mujoco_playground/_src/locomotion/go1/randomize.py of google-deepmind/mujoco_playground). All
numbers are absolute, so that the function can be used with the original model file and with
extended.xml. The code for Isaac Lab is that of `randomization_isaac_lab`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.diagnosis.randomization_isaac_lab import render_isaac_lab_code
from bench.diagnosis.randomization_ranges import (
    RandomizationRange,
    RandomizationRanges,
    describe_ranges,
    list_heading,
)
from bench.pages.python_code import render_code
from bench.pages.text_format import format_csv
from sims.extended_simulator import ExtendedSimulator

OBJECTS = {"joint": "mjOBJ_JOINT", "body": "mjOBJ_BODY", "actuator": "mjOBJ_ACTUATOR"}
"""MuJoCo's object types by kind of place."""


def render_mujoco_playground_code(
    ranges: RandomizationRanges, extended: ExtendedSimulator, robot: Any
) -> str:
    """Return a Python file with a function `domain_randomize` for MuJoCo Playground.

    The function sets each number of the compiled model to a random value of its range.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        robot: Robot with its compiled model.
    """
    sentences = dict(describe_ranges(ranges))
    # Setting the mass also scales the inertia, and setting the size of gravity its components, so
    # inertia and components are set afterwards. A number without a field of the model has no code.
    with_fields = sorted((r for r in ranges.ranges if r.fields), key=_is_last)
    fields = dict.fromkeys(
        name for number_range in with_fields for name in _list_fields(number_range)
    )
    # Each joint, body or actuator has a variable of the code with its id.
    places = dict.fromkeys((r.kind, r.name) for r in with_fields if r.kind in OBJECTS)
    return render_code(
        Path(__file__).with_name("ranges_mujoco_playground.py.jinja"),
        heading=list_heading(extended, "MuJoCo Playground", ranges.left_out),
        ranges=with_fields,
        texts=sentences,
        fields=list(fields),
        variables={(kind, name): f"{kind}_{k}" for k, (kind, name) in enumerate(places)},
        gravity=robot.compiled.opt.gravity.tolist(),
        robot=robot,
        without_field=[f"- {sentences[r]}" for r in ranges.ranges if not r.fields],
        index=_format_index,
        OBJECTS=OBJECTS,
    )


def _is_last(number_range: RandomizationRange) -> bool:
    return number_range.effect in ("inertia.scale", "gravity.tilt")


def _list_fields(number_range: RandomizationRange) -> list[str]:
    """List the names of the fields that a range sets."""
    names = [field.name for field in number_range.fields]
    return [*names, "body_inertia"] if number_range.effect == "mass.scale" else names


def _format_index(number_range: RandomizationRange, place: str, address: tuple[int, ...]) -> str:
    """Format the index of an element as code, based on the variable of its joint, body or actuator.

    For example ``model.jnt_dofadr[joint_0]`` for an element of a field with a row for each degree
    of freedom, or ``body_1, 2``.

    Args:
        number_range: the range, with the field of the compiled model.
        place: variable with the id of the joint, body or actuator; empty if there is none.
        address: index of the element in the field; its first number is the place.
    """
    indices = [str(index) for index in address]
    if place:
        is_by_dof = number_range.field.startswith("dof_")
        indices[0] = f"model.jnt_dofadr[{place}]" if is_by_dof else place
    return ", ".join(indices)


FORMAT_VERSION = 1
"""Format version of ranges.toml."""
COLUMNS = (
    "cause", "coefficient", "source", "kind", "name", "field", "address", "sign", "unit",
    "nominal", "value", "low", "high", "operation", "minimum", "maximum",
)  # fmt: skip
"""Columns of ranges.csv: the keys of a range in ranges.toml."""


def build_range_files(
    ranges: RandomizationRanges, extended: ExtendedSimulator, folder: Path | None = None
) -> Mapping[str, str]:
    """Build the files with the ranges for domain randomisation, and return their contents by name.

    They are a TOML file and a table of the ranges, and code for Isaac Lab and MuJoCo Playground.
    Without ranges there are no files. There is no code if no number has a field in the compiled
    model, because the code could not set it.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        folder: Folder of the files; the path of the model file is relative to it.
    """
    if not ranges.ranges:
        return {}
    import tomli_w

    range_documents = [number_range.document() for number_range in ranges.ranges]
    assert extended.robot is not None
    document: dict[str, Any] = {
        "format": FORMAT_VERSION,
        "model": extended.robot.to_document(folder)["model"],
        "recording": extended.title,
        "left_out": list(ranges.left_out),
        "ranges": range_documents,
    }
    table = [[_format_cell(row.get(column)) for column in COLUMNS] for row in range_documents]
    tables = {"ranges.toml": tomli_w.dumps(document), "ranges.csv": format_csv(COLUMNS, table)}
    if not any(number_range.fields for number_range in ranges.ranges):
        return tables
    robot = getattr(extended.kind, "robot", None)
    return {
        **tables,
        "ranges_isaac_lab.py": render_isaac_lab_code(ranges, extended, robot),
        "ranges_mujoco_playground.py": render_mujoco_playground_code(ranges, extended, robot),
    }


def _format_cell(value: Any) -> object:
    """Format a value as a cell: an address as numbers with spaces, a missing value as empty."""
    if isinstance(value, list):
        return " ".join(str(number) for number in value)
    return "" if value is None else value
