"""Form of a robot's dry friction: stiff or soft.

Stiff is Coulomb friction. Soft is the friction that MuJoCo computes from `frictionloss` with the
solver parameters of the model file.

A simulator adds all dry friction in one form. A form is therefore compared by fitting the same
effects with a run evaluator of the other form.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
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

    Only then the form of dry friction matters.

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
    dofs = [joints[m.coordinate].velocity for m in members if m.coordinate is not None]
    # Pairs of time constant and damping ratio, which joints may share.
    parameters = sorted({tuple(robot.compiled.dof_solref[dof].tolist()) for dof in dofs})
    text = " or ".join(" ".join(f"{value:g}" for value in pair) for pair in parameters)
    sentence, bracket, place = description.partition(" (at ")
    sentence = sentence.removesuffix(_STICTION_TEXT)
    return f"{sentence}, in MuJoCo's soft form (solreffriction {text}){bracket}{place}"


def refit_if_likelier_soft(
    models: ModelSet, model: FittedModel, margin: float
) -> FittedModel | None:
    """Refit a robot model in MuJoCo's soft form of dry friction, and return it if it is likelier.

    The dry friction may be an effect or a free number. A model without dry friction, or with soft
    friction already, is not refitted.

    Args:
        models: Models with stiff friction, with their noise and frozen parameters.
        model: One of these models, fitted.
        margin: Minimum gain in twice the log-likelihood.

    Returns:
        The model with soft friction; None if stiff friction is kept.
    """
    if not has_dry_friction(models.evaluator, model.effects) or has_soft_form(models.evaluator):
        return None
    soft_evaluator = models.evaluator.with_kind(make_soft_kind(models.evaluator.kind))
    try:
        return choose_friction_form(models, model, soft_evaluator, margin)
    finally:
        soft_evaluator.close()


def choose_friction_form(
    models: ModelSet, model: FittedModel, other_evaluator: RunEvaluator, margin: float
) -> FittedModel | None:
    """Refit a model with the other form of dry friction, and return it if it is likelier.

    The forms are stiff and soft: how hard the constraint of MuJoCo's `frictionloss` is solved.
    Effects with a state that contain dry friction, such as hysteresis, do not act through
    `frictionloss`. They are replaced by the dry friction that they contain, because they may only
    imitate the other form.

    Args:
        models: Models of the present form, with their noise and frozen parameters.
        model: One of these models, for which `has_dry_friction` is true.
        other_evaluator: Run evaluator of the same runs and parameters, with a simulator of the
            other form.
        margin: Minimum gain in twice the log-likelihood. The sum of squares must be lower, too.

    Returns:
        The model in the other form; None if the present form is kept.
    """
    refitted_model = _refit_with_other_form(other_evaluator, models, model)
    gain = refitted_model.likelihood.value - model.likelihood.value
    # Of two models that leave much more than noise, the likelihood with autocorrelated noise may
    # prefer the one with the larger residual, because it is smoother.
    is_residual_smaller = refitted_model.fit.cost < model.fit.cost
    return refitted_model if gain >= margin and is_residual_smaller else None


def _refit_with_other_form(
    evaluator: RunEvaluator, models: ModelSet, model: FittedModel
) -> FittedModel:
    """Fit the effects of a model with the other form of dry friction, stiff or soft.

    Both forms can then be compared by their likelihoods. If the discretisation error of the
    integrator was corrected for the model, it is corrected for the refit, too.

    Args:
        evaluator: the same runs, with a simulator of the other form.
        models: models of the present form.
        model: fitted model of these.
    """
    names, theta = replace_by_stateless_friction(models.evaluator, model.effects, model.fit.theta)
    # The random numbers of these models do not affect the result.
    other_models = ModelSet(
        evaluator,
        models.noise,
        models.fixed_parameters,
        make_rng("friction form"),
        models.is_noise_stated,
    )
    refitted_model = other_models.fit_one(FitStart(names, theta, model.fit.initial_states))
    if models.evaluator.discretisation_correction is None:
        return refitted_model
    # Both forms are compared without the discretisation error of the integrator.
    from bench.diagnosis.evaluation.discretisation_error import correct_discretisation

    correct_discretisation(
        evaluator, models.noise, refitted_model.fit.theta, refitted_model.fit.initial_states
    )
    # Otherwise the fit without the correction, which is known, might be returned again.
    other_models.models.clear()
    return other_models.fit_one(refitted_model.fit.make_start())


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
