"""Form of a robot's dry friction: stiff or soft.

Stiff is Coulomb friction. Soft is the friction that MuJoCo computes from `frictionloss` with the
solver parameters of the model file.

A simulator adds all dry friction in one form. A form is therefore compared by fitting the same
effects with a run evaluator of the other form.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import Effect, is_dry_friction, members_of
from sims.core.simulator import Array
from sims.system_simulator import SystemSimulator

_STICTION_TEXT = ", and smaller forces do not start motion"
"""Part of the description of Coulomb friction that does not hold for the soft form, which creeps.
"""


def make_soft_kind(kind: type[SystemSimulator]) -> type[SystemSimulator]:
    """Return the simulator class of a robot with dry friction in MuJoCo's soft form."""
    robot: Any = kind
    soft_simulator: type[SystemSimulator] = robot.with_friction_form("soft")
    return soft_simulator


def has_dry_friction(evaluator: RunEvaluator, names: Iterable[str]) -> bool:
    """Return whether effects or freed numbers of a robot contain dry friction.

    Freed numbers are numbers of the model file that are fitted. Only with dry friction its form
    (stiff or MuJoCo's soft one) matters.

    Args:
        evaluator: Run evaluator; its simulator may be a robot.
        names: Names of effects.
    """
    kind: Any = evaluator.kind
    if not kind.has_model:
        return False
    # A law with an internal state counts if it contains dry friction.
    stateless_names = [get_stateless_friction(evaluator, name) for name in names]
    effects: list[type[Effect]] = [
        *(type(evaluator.available_effects[name]) for name in stateless_names),
        *kind.system.freed_effects,
    ]
    return any(is_dry_friction(effect) for effect in effects)


def has_soft_form(evaluator: RunEvaluator) -> bool:
    """Return whether the effects of a robot add dry friction in MuJoCo's soft form."""
    robot: Any = evaluator.kind
    return bool(robot.has_model and robot.robot.friction_form == "soft")


def get_friction_form(evaluator: RunEvaluator, name: str) -> str | None:
    """Return ``soft`` for dry friction in MuJoCo's soft form, and None for other effects.

    Args:
        evaluator: Run evaluator with the effect.
        name: Name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    is_soft = has_soft_form(evaluator) and is_dry_friction(evaluator.available_effects[name])
    return "soft" if is_soft else None


def add_solver_parameters(evaluator: RunEvaluator, name: str, description: str) -> str:
    """Add the soft form to the description of an effect, before the place in brackets at its end.

    For example ``..., in MuJoCo's soft form (solreffriction 0.02 1) (at joint elbow)``. The numbers
    are the parameters of MuJoCo's constraint solver for the friction of the joint, since the soft
    form depends on them.

    Args:
        evaluator: Run evaluator with the effect.
        name: Name of the effect, with its place on a robot: ``drag.linear@elbow``.
        description: Description of the effect.
    """
    kind: Any = evaluator.kind
    robot = kind.robot
    joints = [joint for joint in robot.joints if joint.has_one_coordinate]
    # An effect at several joints has a member for each, with the index of the joint's coordinate.
    members = members_of(type(evaluator.available_effects[name]))
    # Index of the degree of freedom of each joint in the compiled MuJoCo model.
    dofs = [joints[m.coordinate].velocity for m in members if m.coordinate is not None]
    # Pairs of time constant and damping ratio, which joints may share.
    parameters = sorted({tuple(robot.compiled.dof_solref[dof].tolist()) for dof in dofs})
    text = " or ".join(" ".join(f"{value:g}" for value in pair) for pair in parameters)
    # The place in brackets, if there is one, stays at the end.
    sentence, bracket, place = description.partition(" (at ")
    sentence = sentence.removesuffix(_STICTION_TEXT)
    return f"{sentence}, in MuJoCo's soft form (solreffriction {text}){bracket}{place}"


def get_stateless_friction(evaluator: RunEvaluator, name: str) -> str:
    """Return the dry friction that an effect with a state contains, or else the effect itself.

    Args:
        evaluator: Run evaluator with the effect.
        name: Name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    effect = evaluator.available_effects[name]
    # An effect with a state of its own, such as the bend of bristles, has the hook "hidden".
    if effect.hook != "hidden":
        return name
    # The simpler effects to which it reduces if some of its coefficients are zero.
    for contained_name in effect.contains:
        contained_effect = evaluator.available_effects.get(contained_name)
        if contained_effect is not None and is_dry_friction(contained_effect):
            return contained_name
    return name


def replace_by_stateless_friction(
    evaluator: RunEvaluator, names: Iterable[str], theta: Array
) -> tuple[tuple[str, ...], Array]:
    """Replace effects with a state by the dry friction that they contain, with the same limit.

    Some friction laws have an internal state, such as the bend of bristles. Only laws without one
    exist in both forms, stiff and soft. Where a model has both, their limits are added.

    Shapes: P parameters.

    Args:
        evaluator: Run evaluator of the runs.
        names: Names of the effects of a model.
        theta: (P,) parameters of the model.

    Returns:
        Names of the effects and parameters of the model without these states.
    """
    theta = theta.copy()
    stateless_names = []
    for name in names:
        stateless_name = get_stateless_friction(evaluator, name)
        stateless_names.append(stateless_name)
        if stateless_name != name:
            # The first coefficient of both effects is the limit of the friction force.
            coefficient_indices = evaluator.get_coefficient_indices(name)
            limit_index = coefficient_indices[0]
            stateless_limit_index = evaluator.get_coefficient_indices(stateless_name)[0]
            theta[stateless_limit_index] += theta[limit_index]
            theta[coefficient_indices] = 0.0
    return tuple(dict.fromkeys(stateless_names)), theta
