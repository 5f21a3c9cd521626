"""Least-squares fit of trajectories with shared parameters and initial states of each run.

Levenberg-Marquardt for many models at once, so that one engine call serves all of them. A single
step of one model, and the state of its fit, are in `levenberg_marquardt`; derivatives are in
`trajectory_derivatives`. AR(1) noise is whitened first (`noise_model`), so the fit is a generalised
least-squares fit. Parallel fits share their best cost between rounds, and those that fall far
behind are stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel, whiten
from bench.diagnosis.evaluation.parameter_bounds import Bounds, get_bounds_by_index
from bench.diagnosis.evaluation.run_evaluator import MIN_CHUNK_SIZE, Indices, RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import (
    INITIAL_DAMPING,
    INITIAL_DAMPING_GROWTH,
    MAX_DAMPING,
    FitPoint,
    FitStart,
    FitState,
    TrajectoryFit,
    combine_runs,
    compute_gauss_newton_step,
)
from bench.diagnosis.fitting.trajectory_derivatives import (
    INITIAL_PARAMETER_STEP,
    INITIAL_STATE_STEP,
    build_displaced_inputs,
    compute_difference_quotients,
    compute_difference_steps,
    compute_initial_state_derivatives,
    compute_state_jacobian,
)
from sims.core.effect import is_dry_friction
from sims.core.simulator import Array

MIN_ITERATIONS_BEFORE_ELIMINATION = 4
"""Minimum number of iterations before a fit can be eliminated."""
ITERATIONS_PER_ROUND = 3
"""Number of iterations per racing round; the best cost is shared between rounds."""
ELIMINATION_MARGIN = 100.0
"""Margin of the sum of squares, in units of the noise variance, beyond which a fit is eliminated.

It compares the optimistic final cost of the fit (see `PREDICTED_DECREASE_FACTOR`) with the best
cost.
"""
PREDICTED_DECREASE_FACTOR = 10.0
"""Decrease of the cost that a fit may still reach, as a multiple of its next predicted decrease."""


class RacingRound(NamedTuple):
    """Iterations `first` to `last` (exclusive) of a fit with `all` iterations in total."""

    first: int
    last: int
    all: int


def iterate_rounds(iterations: int, is_racing: bool) -> Iterator[RacingRound]:
    """Yield the rounds of a fit: ranges of iterations after which parallel fits are compared.

    The first round is longer, because in the first steps even the right model may be far behind.

    Args:
        iterations: total number of iterations; with 0, one empty round is generated, in which only
            the starts are simulated.
        is_racing: whether the fits exchange their best cost after each short round, to stop those
            that are far behind; otherwise there is only one round.
    """
    # The total is 1 and not 0, because it is a divisor of the progress.
    if not iterations:
        yield RacingRound(0, 0, 1)
    begin = 0
    while begin < iterations:
        end = iterations
        if is_racing:
            length = ITERATIONS_PER_ROUND if begin else MIN_ITERATIONS_BEFORE_ELIMINATION
            end = min(iterations, begin + length)
        yield RacingRound(begin, end, iterations)
        begin = end


def eliminate_losing_fits(fit_states: Sequence[FitState], lowest_cost: float) -> None:
    """Mark fits as finished if several more steps would not bring them close to the best cost.

    The cost is the sum of squares in units of the noise. The decrease that a fit may still reach is
    taken as a multiple of the decrease that was predicted for its last step.

    Args:
        fit_states: states of the fits; `is_finished` is set in place.
        lowest_cost: lowest cost of fits that are not among `fit_states`.
    """
    best = min(lowest_cost, *(fit_state.point.cost for fit_state in fit_states))
    for fit_state in fit_states:
        fit_state.is_finished |= (
            fit_state.point.cost - PREDICTED_DECREASE_FACTOR * fit_state.predicted_decrease
            > best + ELIMINATION_MARGIN
        )


UNOBSERVED_STATE_PRIOR_SIGMA = 3.0
"""Prior standard deviation of an initial state that no sample shows, SI units."""
OBSERVED_STATE_PRIOR_SIGMA = 100.0
"""Prior standard deviation of an initial state that samples show, SI units.

It is so wide that the samples alone decide.
"""

GROUP_COST_SAMPLES = 60_000
"""Approximate cost of one step of a group of models, in simulated samples."""
ALGEBRA_COST_SAMPLES = 8_000
"""Cost of solving the equations of one model, in simulated samples."""

_TrialStep = tuple[FitState, FitStart]
"""A model, and the point that its next step proposes."""


@dataclass(frozen=True)
class TrajectoryFitter:
    """Fits models to the runs of a `RunEvaluator`.

    Attributes:
        evaluator: the runs.
        noise: noise of each channel.
        fixed_parameters: indices of parameters that are not fitted, because the data do not show
            them.
        share: only this initial share of each run counts.
        fits_parameters: False to fit only initial states.
        is_final_fit: whether fits are refined to final convergence, as needed for reported
            parameters.
    """

    evaluator: RunEvaluator
    noise: NoiseModel
    fixed_parameters: frozenset[int] = frozenset()
    share: float = 1.0
    fits_parameters: bool = True
    is_final_fit: bool = False

    def fit_models(
        self,
        starts: Sequence[FitStart],
        iterations: int = 12,
        is_racing: bool = False,
        lowest_cost: float = np.inf,
        finished: Callable[[], None] = lambda: None,
    ) -> list[TrajectoryFit]:
        """Fit each model from its start.

        All fits advance together in racing rounds of several Levenberg-Marquardt steps:

        1. Stop if all fits have ended, or the search has to end.
        2. Find the lowest cost; when racing, fits that are far behind it end in this round.
        3. Split the unfinished fits into groups, and advance each group in a worker.

        Args:
            starts: starts of the fits; one or more.
            iterations: maximum number of steps of each fit.
            is_racing: whether to stop fits that are far behind the best one or behind
                `lowest_cost`.
            lowest_cost: lowest cost of other models.
            finished: called once for each model whose fit has ended.

        Returns:
            The fits in the order of their starts.
        """
        fit_states = [self._create_fit_state(start) for start in starts]
        for racing_round in iterate_rounds(iterations, is_racing):
            # 1. Unfinished fits.
            unfinished = [i for i, fit_state in enumerate(fit_states) if not fit_state.is_finished]
            if not unfinished:
                break
            # The first round, which begins with iteration 0, is always made, because it simulates
            # the starts.
            if racing_round.first and self.evaluator.search_control.should_abandon_fit(
                racing_round.first / iterations
            ):
                break
            # 2. Lowest cost.
            best = min(lowest_cost, *(fit_state.point.cost for fit_state in fit_states))
            # 3. Groups, which exchange nothing within a round.
            groups = self._group_fits(fit_states, unfinished)
            worker_arguments = [
                (
                    self._list_worker_arguments(),
                    [fit_states[i] for i in group],
                    racing_round,
                    is_racing,
                    best,
                )
                for group in groups
            ]
            for number, members in self.evaluator.worker_pool.map_unordered(
                self.evaluator, _advance_group, worker_arguments
            ):
                # A worker returns changed copies of the states.
                for i, fit_state in zip(groups[number], members, strict=True):
                    fit_states[i] = fit_state
                    if fit_state.is_finished or racing_round.last >= iterations:
                        finished()
        return [fit_state.make_fit() for fit_state in fit_states]

    def predict_costs(self, starts: Sequence[FitStart]) -> list[float]:
        """Return the cost that the first step of each fit would reach if the model were linear.

        This takes one simulation of the start and its derivatives. From a start near the optimum, a
        fit ends close to this cost.

        Args:
            starts: starts of the fits; one or more.

        Returns:
            Predicted costs, in the order of the starts; infinite if the simulation fails.
        """
        sample_mask = self.evaluator.get_sample_mask(self.share)
        fit_states = [self._create_fit_state(start) for start in starts]
        self._simulate_starts(fit_states, sample_mask)
        predicted_costs = []
        for fit_state in fit_states:
            # This computes the predicted decrease, unless the simulation has failed.
            self._propose_trial(fit_state, sample_mask)
            cost = fit_state.point.cost
            predicted_costs.append(
                cost - fit_state.predicted_decrease if np.isfinite(cost) else np.inf
            )
        return predicted_costs

    def _list_worker_arguments(self) -> tuple[Any, ...]:
        """Return all fields except the run evaluator, which workers have already.

        A worker creates its own fitter from them; see `_advance_group`.
        """
        return (
            self.noise,
            self.fixed_parameters,
            self.share,
            self.fits_parameters,
            self.is_final_fit,
        )

    def _group_fits(
        self, fit_states: Sequence[FitState], unfinished: Sequence[int]
    ) -> list[list[int]]:
        """Split unfinished fits into groups that workers advance in parallel.

        A group simulates about `GROUP_COST_SAMPLES` samples in a step, so that the groups are large
        enough to be worth a message and small enough to share the work. Models that need the same
        time steps, which can share an engine call, are in one group as far as possible. There is
        only one group if large engine calls cost less per batch element.

        Args:
            fit_states: states of all fits.
            unfinished: indices of the fits that have not ended.

        Returns:
            For each group, the indices of its fits.
        """
        evaluator = self.evaluator
        if not evaluator.is_cheap_to_split:
            return [list(unfinished)]
        run_count, length, _ = evaluator.observed.shape
        state_count = self._list_displaced_states().size
        # Batch elements of a step: each run of each fit, once without a displacement and once with
        # each unknown displaced, as finite differences need.
        element_count = (
            sum(1 + fit_states[i].free_indices.size + state_count for i in unfinished) * run_count
        )
        cost = element_count * length * self.share + ALGEBRA_COST_SAMPLES * len(unfinished)
        # The number of groups is limited, so that each has about `MIN_CHUNK_SIZE` elements or more,
        # however long they are: the engine steps the elements of a call in parallel.
        group_count = int(np.ceil(min(cost / GROUP_COST_SAMPLES, element_count / MIN_CHUNK_SIZE)))
        step_kinds = evaluator.group_compatible(
            np.stack([fit_states[i].point.start.theta for i in unfinished])
        )
        ordered_fits = [unfinished[i] for i in np.argsort(step_kinds, kind="stable")]
        groups = np.array_split(ordered_fits, min(group_count, len(ordered_fits)))
        return [group.tolist() for group in groups]

    def advance_round(
        self,
        fit_states: Sequence[FitState],
        racing_round: RacingRound,
        is_racing: bool,
        lowest_cost: float,
    ) -> list[FitState]:
        """Advance a group of fits by the Levenberg-Marquardt steps of one racing round.

        1. In the first round, simulate the starts.
        2. End fits that are far behind, if racing.
        3. Compute derivatives where they are not accurate enough. When racing, this waits for fits
           that may have converged until it is known that they are not far behind.
        4. Propose a step for each fit, simulate all of them together, and accept or reject each.

        Args:
            fit_states: states of the fits, changed in place.
            racing_round: first and last step of this round.
            is_racing: whether to stop fits that are far behind the best fit or behind
                `lowest_cost`.
            lowest_cost: lowest cost of other models, including those of other groups.

        Returns:
            The fits after the round.
        """
        # 1. Starts.
        # Mask of the samples that count, (R, T, C).
        sample_mask = self.evaluator.get_sample_mask(self.share)
        if not racing_round.first:
            self._simulate_starts(fit_states, sample_mask)
        for iteration in range(racing_round.first, racing_round.last):
            # 2. Fits that are far behind.
            # In the first steps even the correct model may be far behind.
            if is_racing and iteration >= MIN_ITERATIONS_BEFORE_ELIMINATION:
                eliminate_losing_fits(fit_states, lowest_cost)
            # 3. Derivatives.
            self._renew_derivatives(
                fit_states,
                sample_mask,
                includes_waiting=not is_racing or iteration >= MIN_ITERATIONS_BEFORE_ELIMINATION,
            )
            # 4. Steps.
            trials = list(self._propose_trials(fit_states, sample_mask))
            if not trials:
                # Fits that wait for derivatives continue in a later iteration.
                if any(fit.is_waiting and not fit.is_finished for fit in fit_states):
                    continue
                break
            # The search has to end, at its deadline for example. The caller checks whether a fit
            # was stopped early here.
            if self.evaluator.search_control.should_abandon_fit(iteration / racing_round.all):
                break
            # If derivatives are updated, a trial point needs a single simulation.
            simulate_points = (
                self._simulate_without_derivatives
                if self._updates_derivatives
                else self._simulate_points
            )
            points = simulate_points(trials, sample_mask)
            for (fit_state, _), point in zip(trials, points, strict=True):
                self._accept_or_reject_trial(fit_state, point, sample_mask)
        return list(fit_states)

    def _simulate_starts(self, fit_states: Sequence[FitState], sample_mask: Mask) -> None:
        """Simulate the start of each fit, and compute its derivatives unless they are known.

        1. Starts without known derivatives are simulated in one engine call, with derivatives.
        2. All others are simulated in a second one. Known are only derivatives by parameters, so
           those by initial states are added.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_states: states of the fits, changed in place.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        known_fits = [fit for fit in fit_states if self._has_derivatives(fit)]
        unknown_fits = [fit for fit in fit_states if not self._has_derivatives(fit)]
        # 1. Without known derivatives.
        if unknown_fits:
            points = self._simulate_points(
                [(fit, fit.point.start) for fit in unknown_fits], sample_mask
            )
            for fit_state, point in zip(unknown_fits, points, strict=True):
                self._move_to_point(fit_state, point)
        # 2. With known derivatives.
        if known_fits:
            points = self._simulate_without_derivatives(
                [(fit, fit.point.start) for fit in known_fits], sample_mask
            )
            for fit_state, point in zip(known_fits, points, strict=True):
                known_jacobian = point.start.known_jacobian
                assert known_jacobian is not None
                # Known derivatives are those of whole runs, of which only the first part may be
                # simulated here.
                sample_count = point.simulated.shape[1]
                state_jacobian = self._get_state_derivatives(fit_state, point.start, sample_count)
                jacobian = np.concatenate(
                    [known_jacobian.jacobian[:, :sample_count], state_jacobian], axis=3
                )
                self._move_to_point(fit_state, replace(point, jacobian=jacobian))
                fit_state.has_own_jacobian = known_jacobian.is_at_start

    @property
    def _updates_derivatives(self) -> bool:
        """True if accepted steps update derivatives (Broyden) instead of recomputing them.

        Half of the trial points are rejected, and updated derivatives serve for several steps. For
        initial states alone, and where each call of the engine is slow, it would not save time.
        """
        evaluator = self.evaluator
        return evaluator.has_linearisation or (evaluator.is_cheap_to_split and self.fits_parameters)

    def _has_derivatives(self, fit_state: FitState) -> bool:
        """Return whether the derivatives by all fitted parameters are known near the start.

        This saves one simulation per parameter. Only robots without contacts, which have a
        linearisation, reuse derivatives.
        """
        known_jacobian = fit_state.point.start.known_jacobian
        return (
            self.evaluator.has_linearisation
            and known_jacobian is not None
            and np.array_equal(known_jacobian.free_indices, fit_state.free_indices)
        )

    def _renew_derivatives(
        self, fit_states: Sequence[FitState], sample_mask: Mask, includes_waiting: bool
    ) -> None:
        """Compute new derivatives for the fits whose present ones predict steps poorly.

        Others continue with Broyden's updates, which need no simulations. A robot's derivatives by
        initial states are those of the base model, which all models share, until a fit needs its
        own (`needs_own_state_jacobian`), because the shared ones are not good enough; these are
        then computed first, by a linearisation. Derivatives by parameters are finite differences.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_states: states of the fits, changed in place.
            sample_mask: (R, T, C) samples that count in the cost.
            includes_waiting: whether to include fits that may have converged, whose derivatives
                are only needed if they are not far behind other fits.
        """
        stale_fits = [
            fit
            for fit in fit_states
            if fit.is_jacobian_stale
            and not fit.is_finished
            and (includes_waiting or not fit.is_waiting)
        ]
        if not stale_fits:
            return
        for fit_state in stale_fits:
            fit_state.jacobian_renewals += 1
            if fit_state.needs_own_state_jacobian:
                if fit_state.has_unreliable_states:
                    self._replace_first_states(fit_state, sample_mask)
                start = fit_state.point.start
                fit_state.own_state_jacobian = compute_initial_state_derivatives(
                    self.evaluator, start.theta, start.initial_states
                )
                fit_state.own_state_cost = fit_state.point.cost
                fit_state.has_unreliable_states = False
        points = self._simulate_points([(fit, fit.point.start) for fit in stale_fits], sample_mask)
        for fit_state, point in zip(stale_fits, points, strict=True):
            self._move_to_point(fit_state, point)

    def _replace_first_states(self, fit_state: FitState, sample_mask: Mask) -> None:
        """Replace the initial states of runs that the guessed ones explain better.

        Steps with wrong derivatives may have moved a joint to where it slides at first, and then
        sticks in the same place from wherever it began. No fit would find back from there. Each run
        is compared on its own.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_state: state of the fit, whose point is changed in place.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        point, guesses = fit_state.point, self.evaluator.initial_state_guesses
        start = point.start
        (simulated,) = self.evaluator.simulate_all_runs(
            start.theta[None], guesses[None], self.share
        )
        costs = self._compute_run_costs(point.simulated, start.initial_states, sample_mask)
        is_better = self._compute_run_costs(simulated, guesses, sample_mask) < costs
        states = np.where(is_better[:, None], guesses, start.initial_states)
        fit_state.point = replace(point, start=replace(start, initial_states=states))

    def _create_fit_state(self, start: FitStart) -> FitState:
        """Create the state of a new fit: fitted parameters, their bounds and difference steps.

        Args:
            start: effects, theta and initial states from which the fit begins.
        """
        evaluator = self.evaluator
        # Bounds of the fitted parameters by index in theta: base parameters, then coefficients of
        # the effects of the start.
        bounds: dict[int, Bounds] = {}
        if self.fits_parameters:
            base = [i for i in evaluator.base_indices.tolist() if i not in self.fixed_parameters]
            bounds = {i: evaluator.parameters[i].bounds for i in base}
            bounds |= get_bounds_by_index(evaluator, start.effects)
        fitted_indices = list(bounds)
        # The shape has two columns even if nothing is fitted.
        bounds_table = np.array(list(bounds.values()), dtype=np.float64).reshape(-1, 2)
        low, high = bounds_table.T

        # Plausible ranges scale the finite differences; a fit may go far beyond them.
        plausible_ranges = [evaluator.parameters[i].bounds for i in fitted_indices]
        widths = np.array([upper - lower for lower, upper in plausible_ranges], dtype=np.float64)
        state_steps = np.full(len(evaluator.state_names), INITIAL_STATE_STEP)

        # A start may have a size from a score test, or come from wider bounds.
        theta = start.theta.copy()
        theta[fitted_indices] = np.clip(theta[fitted_indices], low, high)
        clipped_start = replace(start, theta=theta, initial_states=start.initial_states.copy())
        return FitState(
            # The start is simulated later, together with those of other fits.
            point=FitPoint(clipped_start, np.empty(0), np.empty(0), np.inf),
            free_indices=np.array(fitted_indices, dtype=np.intp),
            low=low,
            high=high,
            widths=widths,
            steps=np.concatenate([INITIAL_PARAMETER_STEP * widths, state_steps]),
            channels_of_states=_find_channels_of_states(evaluator),
            state_damping=np.full(start.initial_states.shape, INITIAL_DAMPING),
            state_growth=np.full(start.initial_states.shape, INITIAL_DAMPING_GROWTH),
            predicted_decreases=np.zeros((len(start.initial_states), len(evaluator.channels))),
            is_final_fit=self.is_final_fit,
            # The cost of a robot is not smooth at the scale of the noise.
            has_rough_cost=evaluator.has_linearisation,
            sample_count=int(evaluator.get_sample_mask(self.share).sum()),
            own_state_jacobian=start.state_jacobian,
            # Whether dry friction may hold a joint at rest.
            can_stick=evaluator.has_linearisation and _can_stick(evaluator, start.effects),
        )

    def _simulate_points(self, trials: Sequence[_TrialStep], sample_mask: Mask) -> list[FitPoint]:
        """Simulate trial points of several fits together with their derivatives and costs.

        One engine call contains every run of every model with every unknown displaced, so it
        integrates over time only once. An initial state that is known in every run is not an
        unknown. A robot's derivatives by initial states come from a linearisation instead.

        Shapes: R runs, T samples, C channels.

        Args:
            trials: each fit with its trial point.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        # 1. Displace each unknown of each trial point.
        state_indices = self._list_displaced_states()
        all_steps = [fit_state.compute_inward_steps(start.theta) for fit_state, start in trials]
        displaced_inputs = [
            build_displaced_inputs(start, fit_state.free_indices, steps, state_indices)
            for (fit_state, start), steps in zip(trials, all_steps, strict=True)
        ]
        # 2. Simulate all of them.
        # Sets of parameters are ordered by model, then by unknown.
        thetas, states = (np.concatenate(parts) for parts in zip(*displaced_inputs, strict=True))
        simulated = self.evaluator.simulate_all_runs(thetas, states, self.share)

        # 3. Compute differences and costs.
        points = []
        first = 0
        for (fit_state, start), steps in zip(trials, all_steps, strict=True):
            # The first of the simulations of a point is not displaced; each other one has one
            # unknown displaced.
            end = first + 1 + fit_state.free_indices.size + state_indices.size
            point_simulations = simulated[first:end]
            first = end
            jacobian = compute_difference_quotients(
                point_simulations, steps, state_indices, self.evaluator.known_state_mask
            )
            # The last columns are the derivatives by initial states.
            if self.evaluator.has_linearisation:
                jacobian[..., fit_state.free_indices.size :] = self._get_state_derivatives(
                    fit_state, start, point_simulations.shape[2]
                )
            cost = self._compute_cost(point_simulations[0], start.initial_states, sample_mask)
            points.append(FitPoint(start, point_simulations[0], jacobian, cost))
        return points

    def _simulate_without_derivatives(
        self, trials: Sequence[_TrialStep], sample_mask: Mask
    ) -> list[FitPoint]:
        """Simulate trial points, and give each the derivatives of its fit's present point.

        This costs one simulation for each point. If the point is accepted,
        `_accept_or_reject_trial` updates these derivatives.

        Shapes: R runs, T samples, C channels.

        Args:
            trials: each fit with its trial point.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        simulated = self.evaluator.simulate_all_runs(
            np.array([start.theta for _, start in trials]),
            np.array([start.initial_states for _, start in trials]),
            self.share,
        )
        return [
            FitPoint(
                start,
                point_simulation,
                fit_state.point.jacobian,
                self._compute_cost(point_simulation, start.initial_states, sample_mask),
            )
            for (fit_state, start), point_simulation in zip(trials, simulated, strict=True)
        ]

    def _list_displaced_states(self) -> Indices:
        """Return the indices (n,) of initial states that finite differences displace.

        There are none if the derivatives come from a linearisation.
        """
        if self.evaluator.has_linearisation:
            return np.array([], dtype=np.intp)
        return np.flatnonzero(~self.evaluator.known_state_mask.all(axis=0))

    def _get_state_derivatives(self, fit_state: FitState, start: FitStart, samples: int) -> Array:
        """Return the derivatives (R, T, C, s) of the runs by their initial states.

        They are zero where a state is known. The derivatives of the fit itself are used, if it has
        any; otherwise those that all models share, because they differ little near the data.

        Shapes: R runs, C channels, s states of a run.

        Args:
            fit_state: state of the fit.
            start: parameters and initial states about which the runs are linearised.
            samples: number T of samples of each run, the fitted share.
        """
        evaluator = self.evaluator
        state_jacobian = fit_state.own_state_jacobian
        if state_jacobian is None:
            state_jacobian = compute_state_jacobian(evaluator, start.theta, start.initial_states)
        derivatives = state_jacobian[:, :samples]
        masked_derivatives: Array = derivatives * ~evaluator.known_state_mask[:, None, None, :]
        return masked_derivatives

    def _move_to_point(self, fit_state: FitState, point: FitPoint) -> None:
        """Move a fit to a point with its derivatives, and adapt the difference steps to them.

        Args:
            fit_state: state of the fit, changed in place.
            point: the point, simulated together with its derivatives.
        """
        fit_state.point = point
        fit_state.has_own_jacobian = True
        fit_state.is_jacobian_stale = fit_state.is_waiting = False
        fit_state.steps = compute_difference_steps(point.jacobian, self.noise, fit_state.widths)

    def _compute_residual(self, simulated: Array, sample_mask: Mask) -> Array:
        """Return observed minus simulated (R, T, C), zero where no sample counts.

        Shapes: R runs, T samples, C channels.

        Args:
            simulated: (R, T, C) simulated channels.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        residual: Array = np.where(sample_mask, self.evaluator.observed - simulated, 0.0)
        return residual

    def _compute_state_deviation(self, states: Array) -> Array:
        """Return initial states minus their guesses (R, s), in prior standard deviations.

        For run i it is d_i = (z_i - g_i) / pi, with the initial state z_i and the mean g_i and
        standard deviation pi of its prior. The squares are a term of the cost, eq. (1) of
        `levenberg_marquardt`.

        Shapes: R runs, s states of a run.
        """
        deviation: Array = (states - self.evaluator.initial_state_guesses) / compute_state_prior(
            self.evaluator
        )
        return deviation

    def compute_cost(self, fit: TrajectoryFit) -> float:
        """Return the cost that a fit has with the noise weights of this fitter.

        Costs with different weights cannot be compared directly.
        """
        return self._compute_cost(
            fit.simulated, fit.initial_states, self.evaluator.get_sample_mask(self.share)
        )

    def _compute_cost(self, simulated: Array, states: Array, sample_mask: Mask) -> float:
        """Return the sum of squares of the whitened residual and of the state deviations.

        This is the cost, eq. (1) of `levenberg_marquardt`: sum_i |r_i|^2 + sum_i |d_i|^2, with the
        whitened residual r_i of run i and the deviation d_i of its initial state from the prior
        mean, in standard deviations. It is infinite if a simulation was abandoned.

        Shapes: R runs, T samples, C channels, s states of a run.

        Args:
            simulated: (R, T, C) simulated runs.
            states: (R, s) initial states.
            sample_mask: (R, T, C) mask of the samples that count.
        """
        return float(self._compute_run_costs(simulated, states, sample_mask).sum())

    def _compute_run_costs(self, simulated: Array, states: Array, sample_mask: Mask) -> Array:
        """Return the part of each run (R,) in the cost; arguments as those of `_compute_cost`.

        It is infinite for a run whose simulation was abandoned.
        """
        return self._sum_run_costs(self._compute_squares(simulated, sample_mask), states)

    def _sum_run_costs(self, squares: Array, states: Array) -> Array:
        """Return the part of each run (R,) in the cost, from its squared residuals.

        It is the sum over the channels, and the squared deviations of the initial states from their
        guesses, in prior standard deviations.

        Shapes: R runs, C channels, s states of a run.

        Args:
            squares: (R, C) squared whitened residual of each channel of each run.
            states: (R, s) initial states.
        """
        with np.errstate(all="ignore"):
            deviation = self._compute_state_deviation(states)
            sums = squares.sum(axis=1) + np.square(deviation).sum(axis=1)
        # An abandoned batch element is NaN, which cannot be compared.
        costs: Array = np.where(np.isfinite(sums), sums, np.inf)
        return costs

    def _compute_squares(self, simulated: Array, sample_mask: Mask) -> Array:
        """Return the squared whitened residual (R, C) of each channel of each run.

        It is NaN or infinite where a simulation was abandoned.

        Shapes: R runs, T samples, C channels.

        Args:
            simulated: (R, T, C) simulated runs.
            sample_mask: (R, T, C) mask of the samples that count.
        """
        with np.errstate(all="ignore"):
            residual = self._compute_residual(simulated, sample_mask)
            whitened = whiten(residual, sample_mask, self.noise)
            squares: Array = np.square(whitened).sum(axis=1)
        return squares

    def _propose_trials(
        self, fit_states: Sequence[FitState], sample_mask: Mask
    ) -> Iterator[_TrialStep]:
        """Propose the next point of each fit that is neither finished nor waiting.

        A fit without a useful step is marked as finished or waiting and yields nothing.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_states: states of the fits.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        for fit_state in fit_states:
            if fit_state.is_finished or fit_state.is_waiting:
                continue
            next_start = self._propose_trial(fit_state, sample_mask)
            if next_start is not None:
                yield fit_state, next_start

    def _propose_trial(self, fit_state: FitState, sample_mask: Mask) -> FitStart | None:
        """Return the next parameters and initial states to try: one damped Gauss-Newton step.

        Parameters at a bound that the data push against do not move. If hardly any decrease of the
        cost is predicted, mark the fit as finished or as waiting for derivatives, and return None.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_state: state of the fit.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        point = fit_state.point
        # A point that could not be simulated has an infinite cost, and no descent direction.
        if not np.isfinite(point.cost):
            fit_state.is_finished = True
            return None

        unwhitened_residual = self._compute_residual(point.simulated, sample_mask)
        derivatives = np.where(sample_mask[..., None], point.jacobian, 0.0)
        residual = whiten(unwhitened_residual, sample_mask, self.noise)
        jacobian = whiten(derivatives, sample_mask, self.noise)
        step = compute_gauss_newton_step(
            residual,
            jacobian,
            q=fit_state.free_indices.size,
            drift=self._compute_state_deviation(point.start.initial_states),
            prior=compute_state_prior(self.evaluator),
            known_mask=self.evaluator.known_state_mask,
            damping=fit_state.damping,
            state_damping=fit_state.compute_state_damping(),
            # Clipping these parameters after the step would distort it.
            blocked_mask=fit_state.find_blocked_parameters(residual, jacobian),
        )
        fit_state.predicted_decrease = step.predicted_decrease
        fit_state.predicted_decreases = step.predicted_decreases
        # The fit has converged, no step is short enough, or numbers overflow.
        if (
            not np.isfinite(step.predicted_decrease)
            or step.predicted_decrease < fit_state.get_tolerance(point.cost)
            or fit_state.damping > MAX_DAMPING
        ):
            fit_state.mark_converged()
            return None

        # Copy the parameters, because the old point is still needed if the trial is rejected.
        theta = point.start.theta.copy()
        trial_values = theta[fit_state.free_indices] + step.parameter_step
        theta[fit_state.free_indices] = np.clip(trial_values, fit_state.low, fit_state.high)
        return replace(
            point.start, theta=theta, initial_states=point.start.initial_states + step.state_steps
        )

    def _accept_or_reject_trial(
        self, fit_state: FitState, point: FitPoint, sample_mask: Mask
    ) -> None:
        """Accept a trial point if its cost is lower, else reject it, and update the damping.

        If only initial states of a robot are fitted, the trial is accepted in the runs whose cost
        is lower. If the trial was simulated without derivatives, Broyden's method updates those of
        the last point.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_state: state of the fit, changed in place.
            point: the simulated trial point.
            sample_mask: (R, T, C) samples that count in the cost.
        """
        has_worse_runs = False
        # Only initial states of a robot are fitted.
        if fit_state.fits_rough_states:
            point, has_worse_runs = self._step_improved_runs(fit_state, point, sample_mask)
        decrease = fit_state.point.cost - point.cost
        # A small gain of some runs is no sign of convergence while the steps of others fail.
        min_decrease = fit_state.get_tolerance(point.cost) if has_worse_runs else 0.0
        is_accepted = decrease > min_decrease
        # True if the step was computed with derivatives of the point where it began; the flag of
        # the fit is about the new point from here on.
        is_own_jacobian = fit_state.has_own_jacobian
        if is_accepted:
            if self._updates_derivatives:
                fit_state.point = replace(point, jacobian=fit_state.update_jacobian(point))
                # Updated derivatives are approximate. Those of a robot by initial states, from a
                # linearisation, count as exact if no parameter is fitted.
                is_linearised = self.evaluator.has_linearisation
                fit_state.has_own_jacobian = is_linearised and not fit_state.free_indices.size
            else:
                self._move_to_point(fit_state, point)
            fit_state.accept_step(decrease, point.cost, is_own_jacobian)
        else:
            fit_state.reject_step()

    def _step_improved_runs(
        self, fit_state: FitState, trial: FitPoint, sample_mask: Mask
    ) -> tuple[FitPoint, bool]:
        """Take a step of initial states in the runs that it improves, and update their damping.

        Shapes: R runs, T samples, C channels.

        Args:
            fit_state: state of a fit of initial states alone, changed in place.
            trial: the simulated trial point.
            sample_mask: (R, T, C) samples that count in the cost.

        Returns:
            The trial point, with the present states in the runs whose cost the trial does not
            decrease; and whether the trial increases the cost of any run.
        """
        last = fit_state.point
        last_squares, squares = (
            self._compute_squares(point.simulated, sample_mask) for point in (last, trial)
        )
        last_costs = self._sum_run_costs(last_squares, last.start.initial_states)
        costs = self._sum_run_costs(squares, trial.start.initial_states)
        is_moved = costs < last_costs
        with np.errstate(all="ignore"):
            fit_state.adapt_state_damping(last_squares - squares, is_moved)
        combined = combine_runs(last, trial, is_moved, np.minimum(costs, last_costs))
        return combined, bool((costs > last_costs).any())


def _find_channels_of_states(evaluator: RunEvaluator) -> Mask:
    """Return the channels whose residuals show each initial state best, as a mask (C, s).

    These are the position and the velocity of the same joint, or all channels if neither is
    recorded.

    Shapes: C channels, s states of a run.

    Args:
        evaluator: the runs.
    """
    # Names are `q.JOINT` for a position and `qd.JOINT` for a velocity.
    joints_of_channels, joints_of_states = (
        np.array([name.partition(".")[2] for name in names])
        for names in (evaluator.channels, evaluator.state_names)
    )
    is_of_joint = np.array([name.startswith(("q.", "qd.")) for name in evaluator.channels])
    shows: Mask = (joints_of_channels[:, None] == joints_of_states) & is_of_joint[:, None]
    # A state that no channel shows gets all channels.
    return shows | ~shows.any(axis=0)


def _can_stick(evaluator: RunEvaluator, names: Sequence[str]) -> bool:
    """Return whether one of some effects is, or contains, dry friction that can hold a joint.

    An effect names in `contains` the simpler effects to which it reduces if some of its
    coefficients are zero.

    Args:
        evaluator: the runs, with all effects of their simulator.
        names: names of the effects of a model.
    """
    available = evaluator.available_effects
    parts = {part for name in names for part in (name, *available[name].contains)}
    return any(is_dry_friction(available[part]) for part in parts & available.keys())


def _advance_group(
    evaluator: RunEvaluator, fields: tuple[Any, ...], *arguments: Any
) -> list[FitState]:
    """Advance one group of fits by one racing round; runs in this process or in a worker.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        fields: further fields of `TrajectoryFitter`, from `_list_worker_arguments`.
        *arguments: arguments of `TrajectoryFitter.advance_round`.
    """
    return TrajectoryFitter(evaluator, *fields).advance_round(*arguments)


def compute_state_prior(evaluator: RunEvaluator) -> Array:
    """Return the standard deviations (s,) of the normal priors of the initial states, SI units.

    A state that samples show has such a wide prior that only the samples decide. Other states stay
    near their guesses. If a filter has estimated the states, its uncertainty is the prior.

    Shapes: s states of a run.

    Args:
        evaluator: run evaluator of the recording.
    """
    if evaluator.state_prior is not None:
        return evaluator.state_prior
    system, recorded_channels = evaluator.simulator.system, set(evaluator.channels)
    # Samples of a coordinate also show its rate; a user-defined system may have further states.
    coordinates = dict(zip(system.rates, system.coordinates, strict=False))
    is_measured = [
        name in recorded_channels or coordinates.get(name) in recorded_channels
        for name in evaluator.state_names
    ]
    return np.where(is_measured, OBSERVED_STATE_PRIOR_SIGMA, UNOBSERVED_STATE_PRIOR_SIGMA)
