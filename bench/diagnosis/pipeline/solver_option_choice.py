"""Choice of MuJoCo's solver options for a robot with contacts: those of the model file or others.

Two simulators of one model file can differ in options that change the motion where geoms touch: the
friction cone, the ratio of the friction's impedance to that of the normal force (`impratio`), the
iterations that prevent slip, the constraint solver and its iterations, and the integrator.

The options are changed one after the other. In each round, alternatives are ranked by a simulation
of the runs with the present fit (`rank_option_alternatives`), and the base model is fitted with the
best few (`RatedOptions`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.numerics_cause import OptionFinding
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.cause_search import CauseSearch
from bench.diagnosis.pipeline.run_filtering import filter_simulated_runs
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.pipeline.time_step_choice import closes_gap_alone, is_clearly_better
from bench.diagnosis.search.verdict_rules import is_indistinguishable
from sims.core.simulator import Array

if TYPE_CHECKING:
    from sims.robot.integrator_settings import IntegratorSettings
    from sims.robot.robot_simulator import RobotSimulator

MAX_LINEAR_RESIDUAL = 3.0
"""Maximum residual of the base model, in units of the noise, at which effects act linearly."""
MAX_COMPETING_SQUARES_RATIO = 2.0
"""Maximum sum of squares of an effect that competes with other options, relative to theirs."""
MIN_COMPETING_GAIN_SHARE = 0.7
"""Minimum gain of an effect that competes with other options, relative to theirs, near the noise.

Gains are in twice the log-likelihood, and those of effects to first order.
"""
MAX_OPTION_ROUNDS = 3
"""Maximum number of options of the solver that are changed."""
MAX_FITTED_OPTIONS = 3
"""Maximum number of alternative options that are fitted in a round."""
IMPEDANCE_RATIOS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Values of `impratio` that are tried; model files state numbers between 1 and 100."""
NOSLIP_ITERATIONS = (0, 5)
"""Numbers of iterations without slip that are tried: without, and with as many as usual."""
SOLVER_ITERATIONS = (1, 3, 10, 30, 100)
"""Numbers of iterations of the solver that are tried."""
MIN_DISTINCT_CHANGE = 0.05
"""Minimum RMS difference of two alternatives, in units of the noise, of which both are tried."""
MIN_SQUARES_DECREASE = 20.0
"""Minimum decrease of the sum of squares by an alternative, in units of the noise."""
MAX_EXCESS_RATIO = 0.4
"""Maximum excess of the sum of squares over that of noise by another option, relative to without.

The initial states belong to the options in use. An option is accepted only if it leaves at most a
quarter of this excess with initial states of its own.
"""
MIN_CLEAR_MEAN_SQUARE = 9.0
"""Minimum mean square of the residual, in units of the noise, for `MAX_EXCESS_RATIO` to apply.

Nearer to the noise, the residual also depends on the initial states.
"""


class RatedOptions(NamedTuple):
    """Base model with some options of the solver, and how well it explains the recording.

    Attributes:
        model: The base model.
        log_likelihood: Twice the log-likelihood.
        penalised_log_likelihood: Penalised log-likelihood.
        residual: RMS residual in units of the noise.
        held_out: Penalised log-likelihood of the held-out runs; 0 without validation.
        is_noise_like: Whether the residual may be noise.
    """

    model: BaseModel
    log_likelihood: float
    penalised_log_likelihood: float
    residual: float
    held_out: float
    is_noise_like: bool

    @classmethod
    def rate(cls, model: BaseModel) -> RatedOptions:
        """Rate how well a base model explains the fitted runs and predicts the held-out ones.

        Args:
            model: fitted base model, whose runs have the options to rate.
        """
        search = model.runs.create_search(model.fit)
        rated = search.base_model
        # Without validation, held-out runs count as equally likely.
        held_out = 0.0
        if model.runs.validation is not None:
            (prediction,) = model.runs.validation.validate([model.fit.fit])
            held_out = prediction.penalised_log_likelihood
        return cls(
            model=model,
            log_likelihood=float(rated.likelihood.value),
            penalised_log_likelihood=rated.penalised_log_likelihood,
            residual=1.0 + search.compute_excess_residual(rated),
            held_out=held_out,
            is_noise_like=search.is_noise_like(rated),
        )

    def is_better_than(self, other: RatedOptions) -> bool:
        """Return whether these options explain the recording better than others, on their own.

        They must close half of the gap, which is the residual beyond the noise, and predict the
        held-out runs at least as well. If the same options are changed, only to other values, a
        clearly higher likelihood is enough.

        Args:
            other: base model with other options, to compare with.
        """
        # This import is needed for robots only.
        from sims.robot.integrator_settings import list_changed_options

        # Names of the options that differ from the model file.
        kinds: list[Any] = [rated.model.runs.kind for rated in (self, other)]
        options, other_options = (
            list_changed_options(kind.robot, kind.numerics).keys() for kind in kinds
        )
        gain = self.log_likelihood - other.log_likelihood
        if options == other_options:
            return not is_indistinguishable(gain)
        # A residual of 1 is only noise, and the rest is the gap.
        gap, remaining_gap = other.residual - 1.0, self.residual - 1.0
        return self.held_out >= other.held_out and closes_gap_alone(gain, gap, remaining_gap)


class SolverOptionChoice:
    """Choice of the options of MuJoCo's solver, before and after the search for causes.

    Attributes:
        finding: finding that other options than the file's are used; None while the file's are.
    """

    def __init__(self) -> None:
        """Begin with the options of the model file."""
        self.finding: OptionFinding | None = None
        self._possible_options: RatedOptions | None = None

    def choose(self, model: BaseModel) -> BaseModel:
        """Choose the options of the base model: those of the file, or others.

        Other options are used before the search if they alone close the gap down to the noise, and
        if no effect comes near with the file's options. Otherwise, options that are better than the
        file's are kept for `reconsider`, which compares them with the result of the search.

        Args:
            model: base model with the options of the file.
        """
        runs = model.runs
        if (
            not runs.contacts.has_contacts_off_ground
            or runs.context.options.tuner is not None
            or not model.is_usable
        ):
            return model
        file_options = RatedOptions.rate(model)
        if file_options.is_noise_like:
            return model
        options = _improve_options(file_options)
        if options is file_options:
            return model
        if options.is_noise_like and not _has_competing_effect(options, file_options):
            return self._use(options, file_options)
        self._possible_options = options
        return model

    def reconsider(self, result: SearchResult, cause_search: CauseSearch) -> SearchResult:
        """Return the result with other options, if they explain the data better, or this result.

        The other options are those that `choose` kept. They are searched for causes only if they
        alone are better than the present result, or if that result does not explain the data.

        Args:
            result: result with the options and the time step of the model file.
            cause_search: search for causes from another base model.
        """
        options = self._possible_options
        if options is None or result.has_ended:
            return result
        # A rating is the penalised log-likelihood and the excess of the RMS residual, in units of
        # the noise, over the 1 of noise alone.
        rating = result.rate()
        option_rating = options.penalised_log_likelihood, options.residual - 1.0
        if not is_clearly_better(rating, option_rating) and result.is_explained:
            return result
        model = self._use(options, RatedOptions.rate(result.base))
        other = cause_search.search(model.finish())
        if is_clearly_better(rating, other.rate()):
            return other
        # `_use` has stored the other options as a finding, but they are not used after all.
        self.finding = None
        return result

    def _use(self, options: RatedOptions, file_options: RatedOptions) -> BaseModel:
        """Use other options of the solver than the model file's, and return their base model.

        Args:
            options: The other options.
            file_options: The options of the model file, with the base model fitted with them.
        """
        model = options.model
        robot_kind: Any = model.runs.kind
        gain = options.log_likelihood - file_options.log_likelihood
        self.finding, self._possible_options = OptionFinding(robot_kind, gain), None
        model.runs.context.say("simulated with other options of the solver than the model file's")
        # The gain on held-out runs is measured against the options of the model file.
        return replace(
            model, runs=replace(model.runs, before=file_options.model.predict_held_out())
        )


def _improve_options(rated: RatedOptions) -> RatedOptions:
    """Return the best options, changed one after the other while the base model improves.

    In each round, a fast estimate ranks the alternatives (settings with one option changed), and
    the base model is fitted with the best few.

    Args:
        rated: base model with the options of the model file, and its rating.
    """
    runs = rated.model.runs
    for _ in range(MAX_OPTION_ROUNDS):
        evaluator = rated.model.runs.fitting
        tried = []
        alternatives = rank_option_alternatives(
            evaluator, runs.noise, rated.model.fit.fit.theta, evaluator.initial_state_guesses
        )
        for alternative in alternatives[:MAX_FITTED_OPTIONS]:
            if runs.context.search_control.is_over():
                break
            robot_kind: Any = runs.kind
            # The runs take over the filter of the alternative before, if it has one.
            runs = runs.with_kind(robot_kind.with_integrator_settings(alternative.numerics))
            if runs.fitting.filtered_runs is None:
                filter_simulated_runs(runs)
            tried.append(RatedOptions.rate(rated.model.refit(runs)))
        best = max(tried, key=lambda one: one.log_likelihood, default=rated)
        # Nothing was tried, or nothing is better: further options are not changed.
        if best is rated or not best.is_better_than(rated):
            break
        rated = best
    return rated


class OptionAlternative(NamedTuple):
    """Settings with other options than those in use.

    Attributes:
        numerics: the settings.
        squares: sum of squares of the residual with them, in units of the noise.
    """

    numerics: IntegratorSettings
    squares: float


def rank_option_alternatives(
    evaluator: RunEvaluator, noise: NoiseModel, theta: Array, initial_states: Array
) -> list[OptionAlternative]:
    """Simulate the runs with alternative solver options, and rank those that explain them better.

    1. Compute the sum of squares that an alternative must not exceed. It is lower if the
       alternative changes a further option than if it only has another value of an option that
       already differs from the model file, because each changed option must clearly help.
    2. Simulate all alternatives.
    3. Leave out those that make the same motion as a better one.

    Shapes: R runs, P parameters, s states of a run.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        noise: noise of each channel.
        theta: (P,) parameters of the fitted model.
        initial_states: (R, s) initial states.

    Returns:
        The alternatives, the smallest sum of squares first.
    """
    # These imports are needed for robots only.
    from bench.diagnosis.evaluation.discretisation_error import simulate_with_settings
    from sims.robot.integrator_settings import list_changed_options
    from sims.robot.robot_simulator import RobotSimulator

    kind = evaluator.kind
    assert issubclass(kind, RobotSimulator)
    is_recorded = np.isfinite(evaluator.observed)

    def simulate(numerics: IntegratorSettings) -> Array:
        """Return the simulated readings in units of the noise, zero where none is recorded."""
        motion = simulate_with_settings(evaluator, numerics, theta, initial_states)
        return np.where(is_recorded, motion, 0.0) / noise.sigma

    observed = np.where(is_recorded, evaluator.observed, 0.0) / noise.sigma
    samples = max(int(is_recorded.sum()), 1)
    # 1. Limits.
    present_squares = float(np.square(simulate(kind.numerics) - observed).sum())
    limit = present_squares - MIN_SQUARES_DECREASE
    limit_of_further_option = limit
    if present_squares > MIN_CLEAR_MEAN_SQUARE * samples:
        # Noise alone has a sum of squares of one per sample; the rest is the excess.
        limit_of_further_option = samples + MAX_EXCESS_RATIO * (present_squares - samples)
    # Options that differ from the model file.
    changed_options = list_changed_options(kind.robot, kind.numerics).keys()
    # 2. Simulations.
    ranked: list[tuple[OptionAlternative, Array]] = []
    for numerics in _iterate_alternatives(kind):
        evaluator.search_control.check_not_stopped()
        motion = simulate(numerics)
        squares = float(np.square(motion - observed).sum())
        options = list_changed_options(kind.robot, numerics).keys()
        if squares < (limit if options == changed_options else limit_of_further_option):
            ranked.append((OptionAlternative(numerics, squares), motion))
    # 3. Distinct motions, the best one first.
    ranked.sort(key=lambda pair: pair[0].squares)
    distinct: list[tuple[OptionAlternative, Array]] = []
    for alternative, motion in ranked:
        mean_square_differences = [
            float(np.square(motion - known).sum()) / samples for _, known in distinct
        ]
        if all(difference >= MIN_DISTINCT_CHANGE**2 for difference in mean_square_differences):
            distinct.append((alternative, motion))
    return [alternative for alternative, _ in distinct]


def _iterate_alternatives(kind: type[RobotSimulator]) -> Iterator[IntegratorSettings]:
    """Yield solver settings that differ from the present ones in one option.

    The solver and its number of iterations count as one option, so both may change at once; many
    iterations, which are more common, come first.

    Args:
        kind: simulator class of the robot.
    """
    # These imports are needed for robots only.
    from sims.robot.integrator_settings import CONE_IDS, INTEGRATOR_IDS, SOLVER_IDS, read_option

    settings = kind.numerics
    # Present value of each option: changed already, or that of the model file. The integrator is
    # always among the settings.
    present = settings.to_model_options()
    for name in ("cone", "impratio", "noslip_iterations", "solver", "iterations"):
        present.setdefault(name, read_option(kind.robot, name))
    values_by_option = {
        "cone": list(CONE_IDS.values()),
        "impratio": IMPEDANCE_RATIOS,
        "noslip_iterations": NOSLIP_ITERATIONS,
        "integrator": list(INTEGRATOR_IDS.values()),
    }
    for name, option_values in values_by_option.items():
        for number in option_values:
            if number != present[name]:
                yield settings.replace_options({name: number})
    for solver in (present["solver"], *SOLVER_IDS.values()):
        for iterations in (present["iterations"], *SOLVER_ITERATIONS[::-1]):
            pair = {"solver": solver, "iterations": iterations}
            changed = {name: number for name, number in pair.items() if number != present[name]}
            if changed:
                yield settings.replace_options(changed)


def _has_competing_effect(options: RatedOptions, file_options: RatedOptions) -> bool:
    """Return whether an effect may explain the recording as other options of the solver do.

    1. Scan the coefficients of effects at contacts by simulation. Far from the noise, linear scores
       are not valid, so that these effects alone decide, by the sum of squares.
    2. Score all other effects to first order, except laws with many shapes: an option is the
       simpler explanation.
    3. Compare the gain in twice the log-likelihood of the best effect with that of the options.

    Args:
        options: the other solver options, with the base model fitted to them.
        file_options: options of the model file, with the base model fitted to them.
    """
    # This import is needed for robots only.
    from bench.diagnosis.search.contact_search import (
        exclude_laws_with_many_shapes,
        find_lowest_scan,
    )

    runs = file_options.model.runs
    search = runs.create_search(file_options.model.fit)
    # 1. Effects at contacts. A scan simulates an effect with several coefficients.
    lowest_squares = find_lowest_scan(search)
    if file_options.residual > MAX_LINEAR_RESIDUAL:
        return lowest_squares < MAX_COMPETING_SQUARES_RATIO * options.model.fit.fit.cost
    # 2. Other effects.
    exclude_laws_with_many_shapes(search)
    model = search.base_model
    # Scores are gains in twice the log-likelihood.
    score = float(search.score_missing_effects(model).score.max(initial=0.0))
    # 3. Gains.
    squares = np.square(search.compute_residual(model.fit) / runs.noise.sigma).sum()
    sample_count = float(search.observed_mask.sum())
    # With the size of the noise estimated, twice the log-likelihood of n samples of white noise is
    # -n log(sum of squares), up to a constant.
    scan_gain = sample_count * float(np.log(squares / lowest_squares))
    option_gain = options.log_likelihood - file_options.log_likelihood
    return max(scan_gain, score) > MIN_COMPETING_GAIN_SHARE * option_gain
