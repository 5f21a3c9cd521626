"""Interface of the world modules that build a bouncing system in PyBullet or MuJoCo.

A bouncing system that PyBullet can simulate has a module ``<system>_bullet_world`` in its package,
one that MuJoCo can simulate a module ``<system>_mujoco_world``. The protocols below specify the
required members. A module that does not fulfil its protocol is rejected with the name of the
missing member before any simulation. Systems with one coordinate need no module: the engines move a
body with their inertia on a hinge or guide.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any, Generic, Protocol

from sims.core.engine import make_unsupported_error
from sims.core.system import System

Constants = Mapping[str, float]
"""Known constants of a system by name, in SI units."""


class BulletWorldModule(Protocol):
    """Module ``<system>_bullet_world`` of a system."""

    def build(self, client: int, constants: Constants, /) -> int:
        """Build the world in an empty client; return the id of the moving body.

        Args:
            client: id of the world.
            constants: constants of the system by name.
        """
        ...


class BulletBallWorldModule(BulletWorldModule, Protocol):
    """Module ``<system>_bullet_world`` with what `native_contact` requires in addition."""

    def build_native(self, client: int, constants: Constants, /, settings: Constants) -> int:
        """Build the world with Bullet's native contact.

        Args:
            client: Bullet client of the world.
            constants: constants of the system by name.
            settings: settings of the engine by name.

        Returns:
            The id of the ball.
        """
        ...


class MujocoWorldModule(Protocol):
    """Module ``<system>_mujoco_world`` of a system."""

    def model(self, constants: Constants, /) -> str:
        """Return the MuJoCo model (MJCF) of the system."""
        ...


def check_one_coordinate(engine: str, system: type[System]) -> None:
    """Check that a system can be a body on one hinge or guide.

    Args:
        engine: name of the engine, for the message.
        system: the system.

    Raises:
        InputError: it has several coordinates.
    """
    count = len(system.coordinates)
    if count != 1:
        reason = f"it has {count} coordinates, expected one (a hinge or guide)"
        raise make_unsupported_error(engine, system, reason)


def find_world_module(engine: str, system: type[System], name: str, protocol: type) -> ModuleType:
    """Find the world module of a bouncing system and check its interface.

    A world module builds the system as bodies of an external physics engine, such as MuJoCo or
    Bullet. It is in the package of the system.

    Args:
        engine: name of the engine, for the message.
        system: system whose world is needed.
        name: name of the module in the package of the system's own module.
        protocol: protocol that the module must fulfil.

    Raises:
        InputError: there is no usable module.
    """
    package = system.__module__.rpartition(".")[0]
    # Several systems of one package have a world module each.
    for path in (f"{system.__module__}_{name}", f"{package}.{name}"):
        if package and find_spec(path) is not None:
            break
    else:
        reason = f"no module {name} next to {system.__module__} builds it"
        raise make_unsupported_error(engine, system, reason)
    module = import_module(path)
    if missing := describe_missing_members(module, protocol):
        raise make_unsupported_error(engine, system, f"module {path} {missing}")
    return module


def describe_missing_members(module: ModuleType, protocol: type) -> str:
    """Describe which member of a protocol a module does not have.

    A type checker covers the modules of this project; this function covers external modules as
    well, when they are loaded.

    Args:
        module: world module to check.
        protocol: protocol that the module must fulfil.

    Returns:
        The end of a sentence; empty if the module is complete.
    """
    # The check begins with the most general protocol, so that members required of all world modules
    # are reported first.
    for part in reversed(protocol.__mro__):
        if part in (object, Generic, Protocol):
            continue
        for name, function in vars(part).items():
            if not name.startswith("_") and not _accepts_arguments(
                getattr(module, name, None), function
            ):
                return f"has no function {name}({_list_arguments(function)})"
    return ""


def _accepts_arguments(member: Any, protocol: Callable[..., Any]) -> bool:
    """Return whether a member can be called with the arguments of the protocol's function.

    Args:
        member: member of a world module, of any type; None if it is missing.
        protocol: method of the protocol.
    """
    if not callable(member):
        return False
    parameters = list(inspect.signature(protocol).parameters.values())[1:]  # the first is self
    # Only the number and the names of arguments count, so the parameters themselves are passed.
    by_place = [p for p in parameters if p.kind is p.POSITIONAL_ONLY]
    by_name = {p.name: p for p in parameters if p.kind is not p.POSITIONAL_ONLY}
    try:
        inspect.signature(member).bind(*by_place, **by_name)
    except TypeError:
        return False
    return True


def _list_arguments(function: Callable[..., Any]) -> str:
    return ", ".join(list(inspect.signature(function).parameters)[1:])
