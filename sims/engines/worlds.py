"""What the engines ask of the world modules that stand beside a system's own module.

A system that Bullet carries has a module ``bullet_world`` beside it, one that MuJoCo carries a
module ``mujoco_world``. What such a module must have depends on what the system is: a body on one
hinge or guide is loaded with an inertia, a ball that bounces is not. The protocols below state it;
a module that does not fulfil its protocol is refused by name before anything is simulated.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any, Generic, Protocol

from sims.system import System

Constants = Mapping[str, float]
"""A system's known numbers by name, SI units."""


class JointModule(Protocol):
    """What either engine asks of a system of one coordinate: a body on one hinge or guide."""

    OPEN_LOOP: bool
    """Whether the drive depends on the inputs alone, so that the engine may run on its own while
    they are constant."""

    def gravity(self, constants: Constants, /) -> Callable[[float], float]:
        """The generalised force (N or N*m) that the engine's own gravity exerts at a position (m or
        rad).
        """
        ...


class BulletModule(Protocol):
    """A ``bullet_world``."""

    def build(self, client: int, constants: Constants, /) -> int:
        """Build the world in the empty client; returns the moving body's id."""
        ...


class BulletJointModule(BulletModule, JointModule, Protocol):
    """A ``bullet_world`` of one coordinate."""

    def load(self, client: int, body: int, inertia: float, constants: Constants, /) -> bool:
        """Give the body this generalised inertia (kg or kg*m^2); False if Bullet cannot represent
        it.
        """
        ...


class BulletBallModule(BulletModule, Protocol):
    """A ``bullet_world`` of a ball that bounces, which `native_contact` needs."""

    def build_native(self, client: int, constants: Constants, /, settings: Constants) -> int:
        """Build Bullet's own world, with the engine's settings; returns the ball's id."""
        ...


class MujocoModule(Protocol):
    """A ``mujoco_world``."""

    def model(self, constants: Constants, /) -> str:
        """The world as MJCF."""
        ...


class MujocoJointModule(MujocoModule, JointModule, Protocol):
    """A ``mujoco_world`` of one coordinate."""

    def load(self, model: Any, inertia: float, constants: Constants, /) -> bool:
        """Give the compiled model (an ``MjModel``) this generalised inertia (kg or kg*m^2); False
        if MuJoCo cannot represent it.
        """
        ...


def world_module(system: type[System], name: str, asked: type) -> tuple[ModuleType | None, str]:
    """The world module of a system, if the engine can use it.

    Args:
        system: whose world it is.
        name: of the module beside the one that declares the system.
        asked: the protocol that the module must fulfil.

    Returns:
        The module and an empty text, or None and why there is none.
    """
    package = system.__module__.rpartition(".")[0]
    if not package or find_spec(f"{package}.{name}") is None:
        return None, f"no module {name} beside {system.__module__} builds it"
    module = import_module(f"{package}.{name}")
    if reason := lacking(module, asked):
        return None, f"module {package}.{name} {reason}"
    return module, ""


def lacking(module: ModuleType, asked: type) -> str:
    """What a module lacks to fulfil the protocol `asked`, as the end of a sentence; empty if
    nothing.

    A type checker sees the modules of this project; this sees everybody's, when they are loaded.
    """
    # From the most general protocol to the module's own: what all worlds need is named first.
    for part in reversed(asked.__mro__):
        if part in (object, Generic, Protocol):
            continue
        for name in inspect.get_annotations(part):
            if not isinstance(getattr(module, name, None), bool):
                return f"has no {name} = True or False"
        for name, function in vars(part).items():
            if not name.startswith("_") and not _answers(getattr(module, name, None), function):
                return f"has no function {name}({_arguments(function)})"
    return ""


def _answers(found: Any, asked: Callable[..., Any]) -> bool:
    """Whether `found` can be called as the engine calls the protocol's function."""
    if not callable(found):
        return False
    parameters = list(inspect.signature(asked).parameters.values())[1:]  # the first is self
    by_place = [p for p in parameters if p.kind is p.POSITIONAL_ONLY]
    by_name = {p.name: p for p in parameters if p.kind is not p.POSITIONAL_ONLY}
    try:
        inspect.signature(found).bind(*by_place, **by_name)
    except TypeError:
        return False
    return True


def _arguments(function: Callable[..., Any]) -> str:
    return ", ".join(list(inspect.signature(function).parameters)[1:])
