"""Tests of the effect library as a whole: complete, small, declared for systems it fits, without
effect at zero, and with a current README page.
"""

import ast
import inspect
import textwrap
from pathlib import Path

import numpy as np
import pint
import pytest

from sims import effects
from sims.core.effect import (
    Contact,
    Force,
    Friction,
    HiddenStateEffect,
    Input,
    Level,
    Sensor,
    make_effect_parameters,
)
from sims.core.simulator import InputError
from sims.core.system import SYSTEM_KINDS
from sims.effects.readme_table import render_effects_table
from tests.sims.effects.effect_systems import (
    NAMES,
    PAIRS,
    SIMULATORS,
    SYSTEMS,
    batch_coefficients,
    moment,
)

HOOKS = {
    "force": (Force, Friction),
    "contact": (Contact,),
    "input": (Input,),
    "sensor": (Sensor,),
    "hidden": (HiddenStateEffect,),
    "level": (Level,),
}
UNITS = pint.UnitRegistry()


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_is_at_most_fifteen_lines_of_body_with_a_sentence_and_a_source(name):
    effect = effects.get_effect(name)
    assert _body_lines(effect) <= 15
    assert effect.says
    assert effect.says[0].islower()
    assert not effect.says.endswith(".")
    assert effect.source
    assert issubclass(effect, HOOKS[effect.hook])


def _body_lines(effect):
    """Return the number of lines of a class without its first line, docstrings and blank lines."""
    source = textwrap.dedent(inspect.getsource(effect))
    documented = {
        row
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for row in range(node.lineno, node.end_lineno + 1)
    }
    lines = enumerate(source.splitlines(), 1)
    return sum(bool(line.strip()) and row not in documented for row, line in lines) - 1


@pytest.mark.parametrize("name", NAMES)
def test_units_parse_and_ranges_hold_zero_or_begin_above_it(name):
    effect = effects.get_effect(name)
    for c in effect.coefficients:
        for kind in SYSTEM_KINDS:
            low, high = c.range(kind)
            if c.unit(kind) is None:
                assert (low, high) == (0, 0)
                continue
            UNITS.parse_units("dimensionless" if c.unit(kind) == "1" else c.unit(kind))
            assert low < high
            assert high > 0
    assert any(effect.coefficients[0].unit(kind) is not None for kind in SYSTEM_KINDS)
    assert len({c.name for c in effect.coefficients}) == len(effect.coefficients)
    first = effect.coefficients[0]
    assert all(first.range(kind)[0] <= 0 for kind in SYSTEM_KINDS), (
        "the first coefficient must be able to switch it off"
    )


def test_units_of_input_and_reading_are_those_of_the_system():
    def unit(name, system, observed=()):
        return make_effect_parameters(effects.get_effect(name), SYSTEMS[system], observed)[0].unit

    assert (
        unit("input.bias", "servo"),
        unit("input.bias", "pendulum"),
        unit("backlash", "slider"),
    ) == (
        "rad",
        "N*m",
        "N",
    )
    assert (unit("sensor.bias", "ball"), unit("sensor.bias", "ball", ["accel_z"])) == ("m", "m/s^2")
    assert unit("sensor.drift", "pendulum", ["qd"]) == "rad/s/s"
    assert unit("drag.quadratic", "ball") == "1/m"


def test_what_fits_what():
    there = {system: {name for name in NAMES if (name, system) in PAIRS} for system in SYSTEMS}
    impact, flight = {"restitution.speed", "contact.friction"}, {"lift.magnus"}
    guided = {
        "friction.coulomb",
        "friction.direction",
        "friction.position",
        "friction.stribeck",
        "friction.warming",
        "sensor.eccentricity",
        "sensor.slip",
        "state.limit",
        "spring.linear",
        "spring.cubic",
        "force.ripple",
        "friction.hysteresis",
        "joint.backlash",
        "joint.flexibility",
    }
    begins = ("input.", "friction.load", "supply.")
    inputs = {name for name in NAMES if name.startswith(begins)} | {"backlash"}
    servo = {"servo.deadband", "servo.derivative", "servo.profile"}
    mechanical = set(NAMES) - {"state.overflow"}
    joint = mechanical - impact - flight
    assert there["ball"] == mechanical - guided - inputs - servo
    level = {"gravity.scale", "friction.load_direction", "friction.load_quadratic"}
    assert there["slider"] == joint - {"sensor.eccentricity"} - level - servo
    assert there["pendulum"] == joint - {"wind"} - servo
    assert there["servo"] == joint - {"wind", "input.power"}


@pytest.mark.parametrize(
    ("name", "system", "reason"),
    [
        ("lift.magnus", "slider", "three dimensions"),
        ("input.delay", "ball", "no input"),
        ("contact.friction", "pendulum", "no contact with a ground"),
        ("gravity.scale", "slider", "no gravity"),
        ("friction.load_direction", "slider", "it has no load that opposes its drive"),
        ("friction.coulomb", "ball", "flies freely"),
        ("servo.deadband", "slider", "no servo"),
        ("state.overflow", "slider", "no level"),
        ("input.power", "servo", "a set point, not a force"),
        ("joint.flexibility", "ball", "not a single joint"),
        ("sensor.eccentricity", "slider", "not defined for a linear system"),
        ("wind", "pendulum", "not defined for a rotary system"),
    ],
)
def test_what_does_not_fit_says_why(name, system, reason):
    with pytest.raises(InputError, match=f"{system} cannot have effect {name}: .*{reason}"):
        SIMULATORS[system](engine="batch", effects=[name])


@pytest.mark.parametrize(("name", "system"), PAIRS)
def test_friction_and_forces_are_safe_at_rest(name, system):
    effect, size = effects.get_effect(name)(), len(SYSTEMS[system].coordinates)
    rest = moment(system, np.zeros((1, size)), np.zeros((1, size)))
    for value in (0.0, 0.1):
        c = batch_coefficients(*[value] * len(effect.coefficients))
        if isinstance(effect, (Force, Friction)):
            given = effect.force(c, rest) if isinstance(effect, Force) else effect.limit(c, rest)
            assert np.isfinite(given).all()


def test_the_table_in_the_readme_is_current():
    page = (Path(effects.__file__).parent / "README.md").read_text()
    assert render_effects_table() in page, (
        "paste the output of: python -m sims.effects.readme_table"
    )


def test_the_example_in_the_readme_works_and_is_short():
    page = (Path(effects.__file__).parent / "README.md").read_text()
    code = page.split("```python\n")[1].split("```")[0]
    scope = {}
    exec(code, scope)
    magnet = scope["Magnet"]
    body = code[code.index("class Magnet") :].strip().splitlines()
    assert len(body) <= 15
    assert magnet.fits(SYSTEMS["slider"])
    assert not magnet.fits(SYSTEMS["ball"])
    now = moment("slider", [[0.1]], [[0.0]])
    assert magnet().force(batch_coefficients(20.0, 0.1), now) == pytest.approx(-2 * np.exp(-1))
    assert not magnet().force(batch_coefficients(0.0, 0.0), now).any()


def test_a_third_party_effect_registers_once_and_is_usable_by_name(fresh_registries):
    class Mine(effects.get_effect("drag.linear")):
        name = "drag.mine"

    class Other(Mine):
        pass

    effects.register_effect(Mine)
    assert effects.get_effect("drag.mine") is Mine
    assert "drag.mine" in effects.list_effects_for(SYSTEMS["ball"])
    ball = SIMULATORS["ball"](engine="batch", effects=["drag.mine"])
    assert [p.name for p in ball.parameters][-1] == "drag.mine"
    effects.register_effect(Mine)
    with pytest.raises(InputError, match=r"effect 'drag\.mine' exists already"):
        effects.register_effect(Other)
