"""Identify the servos of a robot by simulation, those of all joints at once.

The model of a real robot with position servos is incomplete at every joint, and its encoders are
usually sampled too slowly for a filter to see the servos' own dynamics. A servo holds its joint
near the command, so that the motion of a joint hardly depends on the parameters of other joints.
The Jacobian of the simulated positions is then nearly block-diagonal, and one simulation in which
one parameter of every joint is displaced gives a column of every block (A. R. Curtis, M. J. D.
Powell, J. K. Reid, J. Inst. Maths Applics 13, 117, 1974, doi:10.1093/imamat/13.1.117).

    1. Fit stiffness and damping of every servo, and then the dry friction of every joint.
    2. Simulate every other law at all joints with several coefficients, and estimate its gain at
       each joint by least squares.
    3. Fit the laws that gain most. At each joint, add the best one if it reduces the squared
       residual enough, also without the run that gains most.
    4. Try the laws of the joint that improved most at the other joints.
    5. Repeat from 2 until no law reduces a residual enough.

Only parameters of a joint's own servo, transmission and sensor are fitted to its position. What
couples the joints, such as masses and gravity, stays as the model file states it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import (
    Bounds,
    compute_coefficient_bounds,
    compute_range_around,
    is_unusual,
    use_bounds,
)
from bench.diagnosis.evaluation.run_evaluator import Indices, RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, solve_damped
from bench.diagnosis.kalman.likelihood_fit import Information, compute_wald_statistics
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import (
    SERVO_MODEL,
    get_joint_name,
    get_servo_input,
)
from sims.core.simulator import Array

DRY_FRICTION = "friction.coulomb"
"""Effect that is tried first, at every joint."""
MIN_EXCESS = 30.0
"""Minimum excess of the best model so far, in units of the noise, that real servos may leave."""
MIN_RESIDUAL = 3.0
"""Minimum residual of a joint, in units of the noise, to which a law is added."""
MIN_JOINTS = 4
"""Minimum number of joints; fewer are identified by filters, or by a search over all effects."""
MAX_COEFFICIENTS = 1
"""Maximum number of coefficients of a law that is added."""
TRIED_SHARES = (0.1, 0.4)
"""Coefficients at which a law is simulated, as shares of its usual range."""
SCALE_LIMITS = (0.1, 2.0)
"""Limits of the factor by which least squares may scale a simulated law."""
MAX_FITTED_LAWS = 3
"""Number of laws per joint that are fitted in each round."""
COMPETING_SHARE = 0.5
"""Minimum estimated gain of a further law that is fitted, as a share of that of the best one."""
MIN_ESTIMATED_GAIN = 0.03
"""Minimum estimated decrease of a joint's squared residual, as a share, of a law that is fitted."""
MIN_GAIN = 0.15
"""Minimum decrease of a joint's squared residual, as a share, by a law that is added."""
MIN_OTHER_GAIN = 0.05
"""Minimum decrease by such a law in the runs without the one that gains most."""
MAX_ROUNDS = 2
"""Maximum number of laws that are added to a joint."""
FIRST_ITERATIONS = 20
"""Maximum number of steps of the first fit."""
TRIAL_ITERATIONS = 8
"""Maximum number of steps of a fit with one more law."""
SHARED_ITERATIONS = 10
"""Maximum number of steps of a fit of several laws at once."""
SHARED_FACTORS = (0.3, 1.0, 3.0)
"""Factors of the coefficients of another joint from which a joint is fitted."""
FINAL_ITERATIONS = 6
"""Maximum number of steps of the fit to all runs."""
CONVERGED_SHARE = 3e-3
"""Decrease of a joint's squared residual by a step, as a share, at which its fit ends."""
STEP_SHARE = 1e-3
"""Difference step of a parameter, as a share of its total or of its usual range."""
INITIAL_DAMPING, MAX_DAMPING = 1e-3, 1e3
"""Levenberg-Marquardt damping at the first step, and that at which the fit of a joint ends."""
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 10.0
"""Factors of the damping after an accepted and after a rejected step."""
MAX_REJECTIONS = 3
"""Maximum number of steps in a row that no joint accepts."""
SEARCHED_RUNS = 9
"""Maximum number of runs, spread over the recording, by which laws are chosen."""
FAILED_RESIDUAL = 1e4
"""Residual, in units of the noise, of a sample that was not simulated."""


@dataclass(frozen=True)
class ServoModel:
    """Laws and parameters of the servos of n joints.

    Attributes:
        theta: (P,) parameters of the robot.
        laws: names of the effects at each joint.
        simulated: (R, T, n) positions.
        costs: (n,) sum of squared residuals of each position, in units of its noise.
    """

    theta: Array
    laws: tuple[tuple[str, ...], ...]
    simulated: Array
    costs: Array

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of all effects."""
        return tuple(name for laws in self.laws for name in laws)


@dataclass(frozen=True)
class _Trial:
    """A law at a joint that was simulated without a fit.

    Attributes:
        gain: estimated decrease of the joint's squared residual, as a share.
        name: the effect, a law at a place.
        coefficients: (k,) its coefficients.
        parameters: values of the joint's other parameters that fit best together with these
            coefficients, to first order.
    """

    gain: float
    name: str
    coefficients: Array
    parameters: Array


def has_unknown_servos(context: SearchContext) -> bool:
    """Return whether a robot has several joints, all with encoders and with servos of unknown gain.

    Only then the servos are identified joint by joint. The positions of all joints, and nothing
    else, must be recorded. Gains are unknown if stiffness and damping of every servo are free
    parameters of the base model.

    Args:
        context: search, filters and regressions of the recording.
    """
    evaluator = context.evaluator
    coordinates = evaluator.simulator.system.coordinates
    free = {evaluator.parameters[i].name for i in evaluator.base_indices.tolist()}
    # Servos are named by their inputs, such as ``u.elbow``; a joint without one has an empty name.
    servos = [get_servo_input(evaluator, joint) for joint in range(len(coordinates))]
    gains = {f"{law}@{servo.partition('.')[2]}" for law in SERVO_MODEL for servo in servos}
    return (
        len(coordinates) >= MIN_JOINTS
        and set(coordinates) == set(evaluator.channels)
        and gains <= free
    )


def identify_servos(context: SearchContext) -> tuple[FitStart, dict[str, float]]:
    """Identify the servos of a robot that `has_unknown_servos`, all joints at once.

    1. Fit stiffness and damping of every servo, and dry friction where it helps.
    2. In each round, add the best law (an effect without its place, such as ``drag.linear``) to
       each joint whose last law helped, and try the laws of the best joint at all others.
    3. Fit the parameters to all runs, and remove effects without a gain.

    Steps 1 and 2 use some of the runs only.

    Args:
        context: search, filters and regressions of the recording.

    Returns:
        The effects with all parameters, and the gain of each effect: the loss in twice the
        log-likelihood without it, if the residual is white. The ranges of the base parameters are
        widened to contain their values.
    """
    evaluator = context.evaluator
    evaluator.search_control.begin_stage("identifying the servos")
    all_runs = np.arange(len(evaluator.prepared_runs))
    searched_runs = np.linspace(0, all_runs.size - 1, min(SEARCHED_RUNS, all_runs.size))
    fitter = _ServoFitter(context, searched_runs.round().astype(np.intp))
    # The joint model, before further laws are added, is needed again by `share_laws`.
    joint_model = model = fitter.fit_joint_model()
    # Joints whose last law helped, so that another one may help.
    growing_joints = set(range(len(evaluator.channels)))
    for number in range(MAX_ROUNDS):
        if not growing_joints or evaluator.search_control.is_over():
            break
        evaluator.search_control.begin_stage(f"identifying the servos, round {number + 1}")
        larger = fitter.add_laws(model, growing_joints & fitter.list_far_from_noise(model))
        growing_joints = {
            joint for joint in growing_joints if larger.laws[joint] != model.laws[joint]
        }
        model = fitter.share_laws(larger, joint_model)
    final_fitter = _ServoFitter(context, all_runs)
    model = final_fitter.fit(final_fitter.simulate(model.theta, model.laws), FINAL_ITERATIONS)
    gains = final_fitter.compute_gains(model)
    # Remove effects without a gain, and widen the ranges that their values left.
    theta = model.theta.copy()
    for name in set(model.effects) - set(gains):
        theta[evaluator.coefficient_slices[name]] = 0.0
    use_bounds(
        evaluator,
        {
            evaluator.parameters[i].name: compute_range_around(evaluator, i, theta[i])
            for i in evaluator.base_indices.tolist()
            if is_unusual(float(theta[i]), *evaluator.parameters[i].bounds)
        },
    )
    states = context.search.base_model.fit.initial_states
    return FitStart(tuple(gains), theta, states), gains


@dataclass(frozen=True)
class _ServoFitter:
    """Fits the parameters of each joint to its own position.

    Attributes:
        context: search, filters and regressions of the recording.
        runs: (R,) indices of the runs.
    """

    context: SearchContext
    runs: Indices

    @property
    def _evaluator(self) -> RunEvaluator:
        return self.context.evaluator

    @cached_property
    def _mask(self) -> Array:
        """Mask (R, T, n) of the recorded positions, in the order of the joints."""
        return np.isfinite(self._observed)

    @cached_property
    def _channels(self) -> list[int]:
        """Index of each joint's position among the channels."""
        coordinates = self._evaluator.simulator.system.coordinates
        return [self._evaluator.channels.index(name) for name in coordinates]

    @cached_property
    def _observed(self) -> Array:
        observed: Array = self._evaluator.observed[self.runs][:, :, self._channels]
        return observed

    @cached_property
    def _sigma(self) -> Array:
        sigma: Array = np.asarray(self.context.search.noise.sigma)[self._channels]
        return sigma

    @cached_property
    def _joints(self) -> range:
        return range(len(self._channels))

    @cached_property
    def _places(self) -> list[tuple[str, str, str]]:
        """Names of joint, actuator and position channel of each joint, at which effects may act.

        For example ``elbow``, ``m_elbow`` and ``q.elbow``.
        """
        evaluator = self._evaluator
        return [
            (
                name := get_joint_name(evaluator, joint),
                get_servo_input(evaluator, joint).partition(".")[2],
                f"q.{name}",
            )
            for joint in self._joints
        ]

    @cached_property
    def _laws_at_joint(self) -> list[dict[str, str]]:
        """Map laws to effects for each joint, for example ``drag.linear`` to ``drag.linear@elbow``.

        These are the effects of the library at the joint, its actuator and its position sensor,
        with few coefficients and without internal states, for which this fit has no first values.
        """
        evaluator = self._evaluator
        result: list[dict[str, str]] = []
        # Effects with internal states have the hook "hidden".
        for places in self._places:
            names = [name for name in evaluator.library if name.partition("@")[2] in places]
            result.append(
                {
                    name.partition("@")[0]: name
                    for name in names
                    if len(evaluator.get_coefficient_indices(name)) <= MAX_COEFFICIENTS
                    and evaluator.available_effects[name].hook != "hidden"
                }
            )
        return result

    @cached_property
    def _base_parameters(self) -> list[list[int]]:
        """Indices of stiffness and damping of each joint's servo."""
        by_name = {self._evaluator.parameters[i].name: i for i in self._evaluator.base_indices}
        return [
            [by_name[f"{law}@{actuator}"] for law in SERVO_MODEL] for _, actuator, _ in self._places
        ]

    def _list_parameters(self, joint: int, laws: Sequence[str]) -> list[int]:
        """Return the indices in theta of the parameters that are fitted to the position of a joint.

        They are stiffness and damping of its servo, and the coefficients of its laws.

        Args:
            joint: index of the joint.
            laws: names of the effects at the joint.
        """
        indices = list(self._base_parameters[joint])
        for name in laws:
            indices += self._evaluator.get_coefficient_indices(name)
        return indices

    def _get_bounds(self, joint: int, laws: Sequence[str]) -> list[Bounds]:
        """Return the bounds of the parameters of a joint, in the order of `_list_parameters`."""
        evaluator = self._evaluator
        bounds: list[Bounds] = [
            compute_range_around(evaluator, i) for i in self._base_parameters[joint]
        ]
        for name in laws:
            bounds += compute_coefficient_bounds(evaluator, name)
        return bounds

    def fit_joint_model(self) -> ServoModel:
        """Fit the servos, and then dry friction at the joints whose residual it reduces.

        Friction is tried at all joints in one fit, since joints hardly influence each other. It is
        kept only where it helps.
        """
        # Stiffness and damping alone, without effects.
        no_laws: list[tuple[str, ...]] = [()] * len(self._joints)
        start = self.simulate(self.context.search.base_model.fit.theta, no_laws)
        model = self.fit(start, FIRST_ITERATIONS)
        theta, laws = model.theta.copy(), list(model.laws)
        for joint, available in enumerate(self._laws_at_joint):
            if DRY_FRICTION in available:
                laws[joint] = (*laws[joint], available[DRY_FRICTION])
                (index,) = self._evaluator.get_coefficient_indices(available[DRY_FRICTION])
                # The fit starts from a small share of the usual range.
                _, high = self._evaluator.parameters[index].bounds
                theta[index] = TRIED_SHARES[0] * high
        larger = self.fit(self.simulate(theta, laws), FIRST_ITERATIONS)
        improved_joints = {
            joint: larger for joint in self._joints if self._helps(model, larger, joint)
        }
        return self._join(model, improved_joints)

    def simulate(self, theta: Array, laws: Sequence[tuple[str, ...]]) -> ServoModel:
        """Simulate the runs from the initial states of the base model.

        Args:
            theta: (P,) parameters, which determine the simulation.
            laws: names of the effects at each joint, of which the result takes note.
        """
        states = self.context.search.base_model.fit.initial_states[self.runs]
        thetas = np.tile(theta, (self.runs.size, 1))
        simulated = self._evaluator.simulate(thetas, self.runs, states)[:, :, self._channels]
        residual = self._compute_residual(simulated)
        costs: Array = np.square(residual).sum(axis=(0, 1))
        return ServoModel(theta, tuple(laws), simulated, costs)

    def _compute_residual(self, simulated: Array) -> Array:
        """Return the residual (R, T, n) in units of the noise; zero where nothing was recorded.

        A sample that was recorded but not simulated has the residual `FAILED_RESIDUAL`.

        Args:
            simulated: (R, T, n) positions of n joints in R runs.
        """
        residual = np.nan_to_num((self._observed - simulated) / self._sigma, nan=FAILED_RESIDUAL)
        masked: Array = np.where(self._mask, residual, 0.0)
        return masked

    def _compute_change(self, other: ServoModel, model: ServoModel, joint: int) -> Array:
        """Return by how much the position (R T,) of a joint differs, in units of the noise.

        It is zero where nothing was recorded or where a simulation failed.

        Args:
            other: the model whose positions are compared.
            model: the model whose positions are subtracted.
            joint: index of the joint.
        """
        change = (other.simulated - model.simulated)[:, :, joint] / self._sigma[joint]
        masked: Array = np.where(self._mask[:, :, joint], np.nan_to_num(change), 0.0).ravel()
        return masked

    def _compute_jacobians(self, model: ServoModel, joints: Sequence[int]) -> dict[int, Array]:
        """Compute the block of the Jacobian of each joint by forward differences.

        A joint's position hardly depends on the parameters of other joints. So one simulation
        displaces one parameter of every joint at once, and there are only as many simulations as
        one joint has parameters.

        Args:
            model: the model about which parameters are displaced.
            joints: the joints whose blocks are computed.

        Returns:
            The block (R T, k) of each joint: derivatives of its positions by its k parameters, in
            units of the noise.
        """
        parameter_indices = {
            joint: self._list_parameters(joint, model.laws[joint]) for joint in joints
        }
        size = self._mask[:, :, 0].size
        blocks = {joint: np.empty((size, len(parameter_indices[joint]))) for joint in joints}
        # Displace the first parameter of every joint, then the second, and so on.
        for column in range(max(map(len, parameter_indices.values()))):
            theta, steps = model.theta.copy(), dict[int, float]()
            for joint, indices in parameter_indices.items():
                if column < len(indices):
                    steps[joint] = self._compute_difference(model.theta, joint, indices[column])
                    theta[indices[column]] += steps[joint]
            displaced = self.simulate(theta, model.laws)
            for joint, step in steps.items():
                change = self._compute_change(displaced, model, joint)
                blocks[joint][:, column] = change / step
        return blocks

    def _compute_difference(self, theta: Array, joint: int, index: int) -> float:
        """Return the step of a parameter for a difference quotient; downwards at its upper bound.

        It is a share of the size of the parameter. Base parameters of the joint are relative
        changes of the gains of its servo, so their size is 1 + parameter. That of a coefficient is
        at least its range.

        Args:
            theta: (P,) parameters.
            joint: index of the joint.
            index: index of the parameter in theta.
        """
        low, high = self._evaluator.parameters[index].bounds
        is_relative = index in self._base_parameters[joint]
        size = abs(1.0 + theta[index]) if is_relative else max(abs(theta[index]), high - low)
        step = STEP_SHARE * float(size)
        return step if theta[index] + step <= high else -step

    def fit(
        self, model: ServoModel, iterations: int, joints: Sequence[int] | None = None
    ) -> ServoModel:
        """Fit the parameters of joints by Levenberg-Marquardt steps, all joints at once.

        A joint accepts a step if it reduces the joint's own squared residual. It leaves the fit
        when its steps gain little or when its damping is large.

        Args:
            model: the start.
            iterations: maximum number of steps.
            joints: the joints to fit; None for all.
        """
        # Damping of each joint that is still fitted; `_step` changes it.
        damping = dict.fromkeys(self._joints if joints is None else joints, INITIAL_DAMPING)
        for _ in range(iterations):
            if not damping or self._evaluator.search_control.is_over():
                break
            stepped = self._step(model, damping)
            # No joint accepted a step.
            if stepped is None:
                break
            decrease = model.costs - stepped.costs
            accepted = [joint for joint in damping if decrease[joint] > 0.0]
            converged = [j for j in accepted if decrease[j] < CONVERGED_SHARE * model.costs[j]]
            model = stepped
            for joint in list(damping):
                if joint in converged or damping[joint] > MAX_DAMPING:
                    del damping[joint]
        return model

    def _step(self, model: ServoModel, damping: dict[int, float]) -> ServoModel | None:
        """Return the model after a step of the joints that accept it; None if none does.

        A joint accepts if its own squared residual decreases. Its damping then decreases; otherwise
        it increases. The step is tried again with the new dampings until at least one joint
        accepts.

        Args:
            model: the present model.
            damping: Levenberg-Marquardt damping of each joint that is fitted; it is changed.
        """
        blocks = self._compute_jacobians(model, list(damping))
        residual = self._compute_residual(model.simulated)
        for _ in range(MAX_REJECTIONS):
            theta = model.theta.copy()
            for joint, block in blocks.items():
                indices = self._list_parameters(joint, model.laws[joint])
                theta[indices] = self._step_parameters(
                    model, joint, block, residual[:, :, joint].ravel(), damping[joint]
                )
            trial = self.simulate(theta, model.laws)
            accepted = {joint for joint in blocks if trial.costs[joint] < model.costs[joint]}
            for joint in blocks:
                factor = DAMPING_DECREASE if joint in accepted else DAMPING_INCREASE
                damping[joint] *= factor
            # Joints that rejected the step keep their parameters.
            if accepted:
                return self._join(model, dict.fromkeys(accepted, trial))
        return None

    def _step_parameters(
        self, model: ServoModel, joint: int, block: Array, residual: Array, damping: float = 0.0
    ) -> Array:
        """Return the parameters (k,) of a joint after a damped least-squares step, within bounds.

        Args:
            model: the present model.
            joint: the joint.
            block: (R T, k) its block of the Jacobian, in units of the noise.
            residual: (R T,) its residual, in units of the noise.
            damping: Levenberg-Marquardt damping; none by default.
        """
        laws = model.laws[joint]
        present = model.theta[self._list_parameters(joint, laws)]
        stepped = present + solve_damped(block, residual, damping)
        clipped: Array = np.clip(stepped, *np.array(self._get_bounds(joint, laws)).T)
        return clipped

    def _join(self, model: ServoModel, model_of_joint: Mapping[int, ServoModel]) -> ServoModel:
        """Return the model in which some joints have the parameters and laws of other models.

        The result is simulated, unless one of the other models was, with exactly these parameters.

        Args:
            model: the model of all other joints.
            model_of_joint: the other model for each of some joints.
        """
        theta, laws = model.theta.copy(), list(model.laws)
        for joint, other in model_of_joint.items():
            # Remove the joint's present laws before it gets the others.
            for name in laws[joint]:
                theta[self._evaluator.coefficient_slices[name]] = 0.0
            laws[joint] = other.laws[joint]
            indices = self._list_parameters(joint, laws[joint])
            theta[indices] = other.theta[indices]
        for other in model_of_joint.values():
            if np.array_equal(other.theta, theta):
                return replace(other, laws=tuple(laws))
        return self.simulate(theta, laws)

    def add_laws(self, model: ServoModel, joints: Collection[int]) -> ServoModel:
        """Add to each joint the law that reduces its squared residual most, and fit all joints.

        1. Estimate the gain of every law at every joint.
        2. Fit the best laws of each joint: in a first fit the best of every joint, in the next fit
           the second best, and so on. Each fit starts from the parameters of the model, or from
           those that the estimate changed together with the law, whichever simulate the joint
           better.
        3. Give each joint the law with the lowest cost that helps, and fit all joints.

        Args:
            model: the fitted model.
            joints: the joints to which laws are added.

        Returns:
            The fitted larger model; the given one if no law reduces a residual enough.
        """
        trials = self._estimate_gains(model, joints) if joints else {}
        # For each joint, the fitted model with the best further law.
        best = dict[int, ServoModel]()
        for rank in range(MAX_FITTED_LAWS):
            chosen = {
                joint: at_joint[rank] for joint, at_joint in trials.items() if rank < len(at_joint)
            }
            if not chosen or self._evaluator.search_control.is_over():
                break
            # Start with the law alone, or with the parameters that were estimated together with it.
            theta, laws = model.theta.copy(), list(model.laws)
            for joint, trial in chosen.items():
                laws[joint] = (*laws[joint], trial.name)
                theta[self._evaluator.coefficient_slices[trial.name]] = trial.coefficients
            start = self.simulate(theta, laws)
            adapted_theta = theta.copy()
            for joint, trial in chosen.items():
                adapted_theta[self._list_parameters(joint, model.laws[joint])] = trial.parameters
            adapted = self.simulate(adapted_theta, laws)
            better_joints = [joint for joint in chosen if adapted.costs[joint] < start.costs[joint]]
            start = self._join(start, dict.fromkeys(better_joints, adapted))
            fitted = self.fit(start, TRIAL_ITERATIONS, list(chosen))
            for joint in chosen:
                present = best.get(joint, model)
                if fitted.costs[joint] < present.costs[joint] and self._helps(model, fitted, joint):
                    best[joint] = fitted
        if not best:
            return model
        return self.fit(self._join(model, best), TRIAL_ITERATIONS)

    def share_laws(self, model: ServoModel, joint_model: ServoModel) -> ServoModel:
        """Try the laws of the joint that improved most at all other joints.

        A law is an effect without its place, such as ``drag.linear`` of ``drag.linear@elbow``.
        Robots often have the same servo at several joints, and another law at one of them may be a
        local optimum. Starts have the coefficients of that joint times several factors, with and
        without its correction of stiffness and damping. Each joint is fitted from its best start,
        and keeps the laws only if they are better than its own.

        Args:
            model: the fitted model.
            joint_model: the model before laws were added, from which the other joints are fitted.

        Returns:
            The model in which those joints have these laws that are simulated better with them.
        """
        best_joint = int(np.argmin(model.costs / joint_model.costs))
        # The laws of the best joint at all joints, in place of their own further laws.
        theta, laws = self._copy_laws(model, best_joint, joint_model)
        joints = [
            joint
            for joint in self._joints
            if joint != best_joint and set(laws[joint]) != set(model.laws[joint])
        ]
        if not joints:
            return model
        # The same servo needs the same correction of its stiffness and damping.
        corrected = theta.copy()
        coefficient_indices = list[int]()
        for joint in joints:
            corrected[self._base_parameters[joint]] = model.theta[self._base_parameters[best_joint]]
            for name in laws[joint]:
                coefficient_indices += self._evaluator.get_coefficient_indices(name)
        starts = []
        for start in (theta, corrected):
            for factor in SHARED_FACTORS:
                scaled = start.copy()
                scaled[coefficient_indices] *= factor
                starts.append(self.simulate(scaled, laws))
        # All other joints stay as they are in the fitted model. Every joint gets its parameters
        # from `others` or from its best start, so any start may be the first argument of `_join`.
        others = dict.fromkeys(set(self._joints) - set(joints), model)
        nearest_starts = {joint: min(starts, key=lambda s: s.costs[joint]) for joint in joints}
        shared = self.fit(self._join(starts[0], nearest_starts | others), SHARED_ITERATIONS, joints)
        better = [joint for joint in joints if self._is_better(shared, model, joint)]
        if not better:
            return model
        return self.fit(self._join(model, dict.fromkeys(better, shared)), TRIAL_ITERATIONS)

    def _copy_laws(
        self, source: ServoModel, source_joint: int, target: ServoModel
    ) -> tuple[Array, list[tuple[str, ...]]]:
        """Return parameters (P,) and laws of a model with the laws of one joint at all joints.

        A law that a joint has keeps its coefficients; one that it cannot have is left out. Laws are
        names with a place, such as ``drag.linear@elbow``; the part before the @ is compared.

        Args:
            source: the model from which the laws and their coefficients are taken.
            source_joint: the joint from which they are taken.
            target: the model to which they are added.
        """
        slices = self._evaluator.coefficient_slices
        theta, laws = target.theta.copy(), list(target.laws)
        for joint, available in enumerate(self._laws_at_joint):
            for source_law in source.laws[source_joint]:
                law = available.get(source_law.partition("@")[0])
                if law is not None and law not in laws[joint]:
                    laws[joint] = (*laws[joint], law)
                    theta[slices[law]] = source.theta[slices[source_law]]
        return theta, laws

    def _is_better(self, model: ServoModel, other: ServoModel, joint: int) -> bool:
        """Return whether a model is better at a joint than another one.

        For each law that it has in addition, its squared residual must be lower by the share
        `MIN_GAIN`.

        Args:
            model: the model that may be better.
            other: the model with which it is compared.
            joint: index of the joint.
        """
        added = max(len(model.laws[joint]) - len(other.laws[joint]), 0)
        return bool(model.costs[joint] < (1.0 - MIN_GAIN) ** added * other.costs[joint])

    def list_far_from_noise(self, model: ServoModel) -> set[int]:
        """Return the joints whose residual is far above the noise, so that a law may be missing."""
        mean_squares = model.costs / self._mask.sum(axis=(0, 1))
        return set(np.flatnonzero(mean_squares > MIN_RESIDUAL**2).tolist())

    def _helps(self, model: ServoModel, larger: ServoModel, joint: int) -> bool:
        """Return whether a larger model reduces a joint's squared residual enough.

        It must do so even without the run that gains most, so that one odd run does not decide.

        Args:
            model: the smaller model.
            larger: the model with one more law at the joint.
            joint: index of the joint.
        """
        # Squared residual (R,) of each run.
        before, after = (
            np.square(self._compute_residual(one.simulated)[:, :, joint]).sum(axis=1)
            for one in (model, larger)
        )
        others = np.arange(len(before)) != np.argmax(before - after)
        return bool(
            after.sum() < (1.0 - MIN_GAIN) * before.sum()
            and after[others].sum() < (1.0 - MIN_OTHER_GAIN) * before[others].sum()
        )

    def _estimate_gains(
        self, model: ServoModel, joints: Collection[int]
    ) -> dict[int, list[_Trial]]:
        """Simulate every law at joints, and return the best trials of each joint, best first.

        Each law is simulated with a few coefficients of either sign. Its gain, together with a
        change of the joint's present parameters, is estimated by linear least squares. The best
        coefficient of each law is kept. At most `MAX_FITTED_LAWS` laws of a joint are returned;
        those that gain far less than its best one are left out.

        Args:
            model: the fitted model.
            joints: the joints.
        """
        blocks = self._compute_jacobians(model, sorted(joints))
        residual = self._compute_residual(model.simulated)
        # The best trial of each effect, by joint.
        trials: dict[int, dict[str, _Trial]] = {joint: {} for joint in joints}
        for law in sorted(set().union(*self._laws_at_joint)):
            # The effect of this law at each joint that can have it and does not have it yet.
            names = {
                joint: at_joint[law]
                for joint, at_joint in enumerate(self._laws_at_joint)
                if joint in joints and law in at_joint and at_joint[law] not in model.laws[joint]
            }
            for share in TRIED_SHARES:
                for sign in (1.0, -1.0):
                    for trial, joint in self._simulate_law(
                        model, names, sign * share, blocks, residual
                    ):
                        known = trials[joint].get(trial.name)
                        if known is None or trial.gain > known.gain:
                            trials[joint][trial.name] = trial
            if self._evaluator.search_control.is_over():
                break
        ranked = dict[int, list[_Trial]]()
        for joint, at_joint in trials.items():
            best = sorted(at_joint.values(), key=lambda trial: -trial.gain)[:MAX_FITTED_LAWS]
            ranked[joint] = [t for t in best if t.gain >= COMPETING_SHARE * best[0].gain]
        return ranked

    def _simulate_law(
        self,
        model: ServoModel,
        names: Mapping[int, str],
        share: float,
        blocks: Mapping[int, Array],
        residual: Array,
    ) -> Iterator[tuple[_Trial, int]]:
        """Simulate a law at several joints at once, and yield trial and joint for each.

        The joints do not influence each other much, so one simulation is enough. Trials whose
        estimated gain is small are not yielded.

        Args:
            model: the fitted model.
            names: the law's effect at each joint.
            share: coefficients as a share of the upper end of their range; negative for a share of
                the lower end, if that is negative.
            blocks: block of the Jacobian of each joint.
            residual: (R, T, n) residual of the model in units of the noise; n joints.
        """
        evaluator = self._evaluator
        theta, coefficients = model.theta.copy(), dict[int, Array]()
        for joint, name in names.items():
            coefficient_slice = evaluator.coefficient_slices[name]
            low, high = np.array([p.bounds for p in evaluator.parameters[coefficient_slice]]).T
            # A coefficient that is nonnegative has no other sign to try.
            if share < 0.0 and not (low < 0.0).any():
                continue
            theta[coefficient_slice] = np.where(
                (share < 0.0) & (low < 0.0), -share * low, abs(share) * high
            )
            coefficients[joint] = theta[coefficient_slice].copy()
        if not coefficients:
            return
        displaced = self.simulate(theta, model.laws)
        for joint, joint_coefficients in coefficients.items():
            change = self._compute_change(displaced, model, joint)
            block, joint_residual = blocks[joint], residual[:, :, joint].ravel()
            gain = _estimate_gain(block, change, joint_residual)
            if gain > MIN_ESTIMATED_GAIN:
                parameters = self._step_parameters(model, joint, block, joint_residual - change)
                yield _Trial(gain, names[joint], joint_coefficients, parameters), joint

    def compute_gains(self, model: ServoModel) -> dict[str, float]:
        """Return the loss in twice the log-likelihood without each effect, by the Wald statistic.

        The residual of each joint is taken as white noise, whose variance is its mean square; its
        Fisher information is J'J over this variance, with the joint's block J of the Jacobian.
        Effects that gain less than their penalty are left out.

        Args:
            model: the fitted model.
        """
        gains: dict[str, float] = {}
        for joint, block in self._compute_jacobians(model, self._joints).items():
            laws, sample_count = model.laws[joint], int(self._mask[:, :, joint].sum())
            # The variance is the cost divided by the number of samples.
            information = Information(
                self._list_parameters(joint, laws),
                block.T @ block * sample_count / model.costs[joint],
            )
            gains |= compute_wald_statistics(self._evaluator, model.theta, laws, information)
        penalty = self.context.filters.penalty
        return {name: gain for name, gain in gains.items() if gain > penalty(name)}


def _estimate_gain(block: Array, change: Array, residual: Array) -> float:
    """Estimate by how much a law reduces a residual, together with the parameters in the model.

    What the parameters can explain is projected out of the change by the law and out of the
    residual (QR decomposition). The rest of the change is then scaled to reduce the rest of the
    residual.

    Args:
        block: (m, k) derivatives of the samples by these parameters.
        change: (m,) change of the samples by the law.
        residual: (m,) residual.

    Returns:
        The decrease of the squared residual, as a share, if the change is scaled within
        `SCALE_LIMITS`; zero if it would have to be smaller.
    """
    low, high = SCALE_LIMITS
    # Parameters without influence on the samples are left out of the basis.
    norms = np.linalg.norm(block, axis=0)
    basis, _ = np.linalg.qr(block[:, norms > 0.0] / norms[norms > 0.0])
    projected_change = change - basis @ (basis.T @ change)
    projected_residual = residual - basis @ (basis.T @ residual)
    square = float(projected_change @ projected_change)
    scale = float(projected_change @ projected_residual) / square if square > 0.0 else 0.0
    if not scale > low:
        return 0.0
    scale = min(scale, high)
    remaining = projected_residual - scale * projected_change
    reduction = projected_residual @ projected_residual - remaining @ remaining
    return float(reduction) / float(residual @ residual)
