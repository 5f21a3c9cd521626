"""Tests that modules which build worlds of systems have the functions the engines need; others are
refused.
"""

import inspect
import sys
import typing
from types import ModuleType

import pytest

from sims.core.simulator import InputError
from sims.engines.external import world_interface
from sims.system_simulator import SystemSimulator
from sims.systems.ball import BallSystem
from tests.sims.simulation_cases import SIMULATORS

ENGINES = {"pybullet": "bullet_world", "mujoco": "mujoco_world"}
PROTOCOLS = {
    "bullet_world": (world_interface.BulletWorldModule, world_interface.BulletBallWorldModule),
    "mujoco_world": (world_interface.MujocoWorldModule,),
}
CASES = [
    (system, name, protocol)
    for system in SIMULATORS
    if SIMULATORS[system].system.bounces
    for name in ENGINES.values()
    for protocol in PROTOCOLS[name]
]


def types_of(function):
    """Return the types of the arguments, in order, and of the result."""
    hints = typing.get_type_hints(function)
    return [
        hints[name] for name in (*inspect.signature(function).parameters, "return") if name in hints
    ]


def functions_of(protocol):
    parts = [part for part in protocol.__mro__ if part.__module__ == world_interface.__name__]
    return {
        name: function
        for part in parts
        for name, function in vars(part).items()
        if callable(function) and not name.startswith("_")
    }


@pytest.mark.parametrize(("system", "name", "protocol"), CASES)
def test_every_world_module_fulfils_its_protocol(system, name, protocol):
    module = world_interface.find_world_module("", SIMULATORS[system].system, name, protocol)
    assert module.__name__ == f"sims.systems.{system}_{name}"
    assert functions_of(protocol)
    for name, function in functions_of(protocol).items():
        assert types_of(getattr(module, name)) == types_of(function)


def module_with(**content):
    module = ModuleType("broken_world")
    vars(module).update(content)
    return module


WHOLE = {
    "build": lambda client, constants: 0,
    "build_native": lambda client, constants, settings: 0,
}
BROKEN = [
    ({"build": None}, "has no function build(client, constants)"),
    ({"build": 9.81}, "has no function build(client, constants)"),
    (
        {"build_native": lambda client, constants, given: 0},
        "has no function build_native(client, constants, settings)",
    ),
]


def test_a_whole_module_lacks_nothing_whatever_its_arguments_are_called():
    assert not world_interface.describe_missing_members(
        module_with(**WHOLE), world_interface.BulletBallWorldModule
    )
    assert not world_interface.describe_missing_members(
        module_with(build=lambda a, b: 0), world_interface.BulletWorldModule
    )


@pytest.mark.parametrize(("change", "reason"), BROKEN)
def test_a_missing_member_of_a_module_is_named(change, reason):
    assert (
        world_interface.describe_missing_members(
            module_with(**{**WHOLE, **change}), world_interface.BulletBallWorldModule
        )
        == reason
    )


@pytest.mark.parametrize(("engine", "name"), ENGINES.items())
def test_an_engine_refuses_a_broken_module_by_name(engine, name, tmp_path, monkeypatch):
    """The check runs before any simulation; without it the first run ends in an AttributeError."""
    package = tmp_path / "broken_system"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / f"{name}.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)

    class Broken(BallSystem):
        __module__ = "broken_system.system"

    class Ours(SystemSimulator):
        system = Broken

    try:
        with pytest.raises(
            InputError, match=f"module broken_system.{name} has no function (build|model)"
        ):
            Ours(engine=engine)
    finally:
        for loaded in [key for key in sys.modules if key.startswith("broken_system")]:
            del sys.modules[loaded]
