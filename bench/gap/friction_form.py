"""The form of a robot's dry friction: stiff, which is Coulomb friction, or soft, which is what
MuJoCo makes of `frictionloss` with the solver parameters of the model file.

A simulator adds all dry friction in one form, so a form is compared by fitting the same effects in
a world of the other form.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from bench.gap.model.models import Model, Models
from bench.gap.model.problem import Start
from bench.gap.model.world import World
from bench.problem.seeds import rng_for
from sims.base import Array
from sims.simulated import Simulated
from sims.system import Effect, Friction, members_of

_HOLDS = ", and holds still what pulls less"
"""What the sentence of Coulomb friction says that is not true of the soft form, which creeps."""


def soft_kind(kind: type[Simulated]) -> type[Simulated]:
    """The simulator's class of a robot, with dry friction in MuJoCo's soft form."""
    robot: Any = kind
    soft: type[Simulated] = robot.with_friction_form("soft")
    return soft


def has_dry_friction(world: World, names: Iterable[str]) -> bool:
    """Whether these effects of a robot, or freed numbers of its file, contain dry friction, so that
    its form matters.
    """
    robot: Any = world.kind
    if not robot.has_model:
        return False
    freed: list[type[Effect]] = list(robot.system.freed_effects)
    plain = [plain_friction(world, name) for name in names]
    effects = [*(type(world.effects[name]) for name in plain), *freed]
    return any(_is_dry_friction(effect) for effect in effects)


def has_soft_form(world: World) -> bool:
    """Whether the effects of a robot add dry friction in MuJoCo's soft form."""
    robot: Any = world.kind
    return bool(robot.has_model and robot.robot.friction_form == "soft")


def form_of(world: World, name: str) -> str | None:
    """``soft`` where an effect is dry friction in MuJoCo's soft form; None for all others."""
    is_soft = has_soft_form(world) and _is_dry_friction(type(world.effects[name]))
    return "soft" if is_soft else None


def with_solver_parameters(world: World, name: str, says: str) -> str:
    """Name the soft form in the sentence of an effect, before the place in brackets at its end:
    ``..., in MuJoCo's soft form (solreffriction 0.02 1) (at joint elbow)``.
    """
    robot: Any = world.kind
    effect = type(world.effects[name])
    members = members_of(effect)
    joints = [joint for joint in robot.robot.joints if joint.single]
    places = [member.coordinate for member in members if member.coordinate is not None]
    dofs = [joints[place].velocity for place in places]
    parameters = {tuple(robot.robot.compiled.dof_solref[dof].tolist()) for dof in dofs}
    text = " or ".join(" ".join(f"{value:g}" for value in pair) for pair in sorted(parameters))
    sentence, bracket, place = says.partition(" (at ")
    sentence = sentence.removesuffix(_HOLDS)
    return f"{sentence}, in MuJoCo's soft form (solreffriction {text}){bracket}{place}"


def is_likelier_soft(models: Models, model: Model, margin: float) -> bool:
    """Whether a fitted model of a robot in which dry friction acts, as an effect or as a free
    number, is likelier in MuJoCo's soft form.

    Args:
        models: with stiff friction; their noise and frozen parameters hold.
        model: one of them.
        margin: by which twice the log likelihood has to be larger.
    """
    if not has_dry_friction(models.world, model.names) or has_soft_form(models.world):
        return False
    other = models.world.with_kind(soft_kind(models.world.kind))
    try:
        return choose_friction_form(models, model, other, margin) is not None
    finally:
        other.close()


def choose_friction_form(models: Models, model: Model, other: World, margin: float) -> Model | None:
    """Fit a model again with the other form of dry friction, and return it where it is likelier.

    Effects with a state that contain dry friction, such as hysteresis, do not act through
    `frictionloss`. The dry friction that they contain takes their place, since the other form may
    be all that they imitate.

    Args:
        models: of the present form; their noise and frozen parameters hold.
        model: one of them, which `has_dry_friction`.
        other: a world of the same runs and parameters, with a simulator of the other form.
        margin: by which twice the log likelihood has to be larger.

    Returns:
        The model in the other form; None where the present form stands.
    """
    fitted = _refit_in(other, models, model)
    gain = fitted.likelihood.value - model.likelihood.value
    return fitted if gain >= margin else None


def _refit_in(world: World, models: Models, model: Model) -> Model:
    """Fit the effects of a model in a world of the other form."""
    names, theta = with_plain_friction(models.world, model.names, model.fit.theta)
    # The random numbers of these models decide nothing.
    others = Models(world, models.noise, models.frozen, rng_for("friction form"), models.stated)
    fitted = others.fit_one(Start(names, theta, model.fit.states))
    if models.world.correction is None:
        return fitted
    # Both forms are compared without the error of the integrator's step.
    from bench.gap.model.tangents import correct

    correct(world, models.noise, fitted.fit.theta, fitted.fit.states)
    others.models.clear()
    return others.fit_one(fitted.fit.start())


def _is_dry_friction(effect: type[Effect]) -> bool:
    """Whether an effect, or a member of a family, acts through `frictionloss`."""
    members = getattr(effect, "members", ())
    return issubclass(effect, Friction) or any(isinstance(one, Friction) for one in members)


def plain_friction(world: World, name: str) -> str:
    """The dry friction that an effect with a state contains; other effects themselves."""
    effect = world.effects[name]
    if effect.hook != "hidden":
        return name
    contained = [n for n in effect.contains if n in world.effects]
    friction = [n for n in contained if _is_dry_friction(type(world.effects[n]))]
    return friction[0] if friction else name


def with_plain_friction(
    world: World, names: Iterable[str], theta: Array
) -> tuple[tuple[str, ...], Array]:
    """Put dry friction in the place of effects with a state that contain it.

    Args:
        world: the runs.
        names: effects of a model.
        theta: (P,) its parameters.

    Returns:
        The names and the parameters of the model without these states.
    """
    theta, plain = theta.copy(), dict[str, None]()
    for name in names:
        friction = plain_friction(world, name)
        plain[friction] = None
        if friction != name:
            # The first coefficient of both is the limit of the friction.
            theta[world.places(friction)[0]] += theta[world.places(name)[0]]
            theta[world.places(name)] = 0.0
    return tuple(plain), theta
