"""Fitted models of a recording: effects, fit, likelihood and penalised log-likelihood.

For a model with log-likelihood L and k parameters determined by n samples, the penalised
log-likelihood is

    M = 2 log L - k log n - Σ_e max(c_e - k_e log n, 0)                                          (1)

Without the last term, this is the criterion of G. Schwarz (Ann. Stat. 6(2), 461, 1978,
doi:10.1214/aos/1176344136) with reversed sign, so that higher is better. The last term is for
effects e with many candidate shapes: c_e is the gain of the best shape under the null hypothesis,
of which the k_e coefficients already pay k_e log n.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.noise_model import Likelihood, Mask, NoiseModel, maximise_likelihood
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import FIT_HORIZONS
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter, compute_state_prior
from sims.core.simulator import Array
from sims.core.user_messages import join_first_names

EffectNames = tuple[str, ...]

MODELS_KEPT_PER_HORIZON = (12, 8)
"""Numbers of models that continue after each fit horizon but the last, in patient fits."""
MAX_ITERATIONS = 24
"""Maximum number of steps of each fit."""
MIN_SIGMA_SHARE = 1e-3
"""Minimum standard deviation of a channel in generalised fits, as a share of its noise."""
MAX_REWEIGHTED_FITS = 4
"""Maximum number of fits of the reported model, each weighted by the previous residual."""
MIN_GAIN_FOR_REWEIGHTING = 3.0
"""Minimum gain in penalised log-likelihood of such a fit for which another one is made."""
MAX_REWEIGHTED_SQUARES_RATIO = 1.2
"""Maximum growth factor of the sum of squares in a fit that assumes AR(1) noise.

A fit that grows more was distorted by structure that is not noise.
"""
MAX_SEED = 2**62
"""Upper limit of the integer that identifies the random number streams of a search."""
MODEL_SIZE_TEXTS = {
    0: ("the base model", "the base model"),
    1: ("one effect", "single effects"),
    2: ("one pair of effects", "pairs of effects"),
    3: ("one set of three effects", "sets of three effects"),
}
"""Singular and plural description of models by number of effects, for the progress display."""
MIN_EFFECTIVE_SAMPLES = 2
"""Minimum number of samples assumed for the price of a parameter, because log 1 is zero."""


@dataclass(frozen=True)
class FittedModel:
    """A fitted model and its penalised log-likelihood.

    Attributes:
        fit: the fit.
        likelihood: likelihood of the residual of the fit.
        penalised_log_likelihood: penalised log-likelihood, eq. (1) of the module docstring; it
            counts parameters, coefficients, and the initial states that the data determine.
    """

    fit: TrajectoryFit
    likelihood: Likelihood
    penalised_log_likelihood: float

    @property
    def effects(self) -> EffectNames:
        """Names of the effects of the model."""
        return self.fit.effects


def select_likeliest(*models: FittedModel) -> FittedModel:
    """Return the model with the highest penalised log-likelihood; the first one of equal ones."""
    return max(models, key=lambda model: model.penalised_log_likelihood)


@dataclass
class ModelSet:
    """Fitted models of one recording, by their effects.

    Attributes:
        evaluator: the runs for fitting.
        noise: sensor noise.
        fixed_parameters: indices of parameters that do not influence the data.
        rng: source of all random numbers.
        is_noise_stated: (C,) whether the recording specifies the noise of each channel.
        models: the best fit for each set of effects.
        null_gains: gain of each effect under the null hypothesis, about the base model.
        refined_jacobians: fits whose derivatives were recomputed with central differences, each
            with its original fit.
    """

    evaluator: RunEvaluator
    noise: NoiseModel
    fixed_parameters: frozenset[int]
    rng: np.random.Generator
    is_noise_stated: Mask
    models: dict[frozenset[str], FittedModel] = field(default_factory=dict)
    null_gains: dict[str, float] = field(default_factory=dict)
    refined_jacobians: dict[int, tuple[TrajectoryFit, TrajectoryFit]] = field(default_factory=dict)
    _stream_seed: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._stream_seed = int(self.rng.integers(MAX_SEED))

    def make_rng(self, question: str, names: Iterable[str] = ()) -> np.random.Generator:
        """Return the random generator of a question about a model with the given effects.

        A question is one test of the search, such as a score test. The random numbers do not depend
        on earlier questions, so the answer does not either.

        Args:
            question: name of the question.
            names: effects of the model.
        """
        return make_rng(self._stream_seed, question, *sorted(names))

    @property
    def observed_mask(self) -> Mask:
        """Mask (R, T, C) of the samples that were recorded."""
        return np.isfinite(self.evaluator.observed)

    def compute_residual(self, fit: TrajectoryFit) -> Array:
        """Return observed minus simulated (R, T, C), zero where no sample exists."""
        unmasked_residual = self.evaluator.observed - fit.simulated
        residual: Array = np.where(self.observed_mask, unmasked_residual, 0.0)
        return residual

    def add_fit(self, fit: TrajectoryFit) -> FittedModel:
        """Rate a fit, and store it unless a better fit of its effects is known.

        The better one is returned.
        """
        return self._store_if_better(self._rate_fit(fit))

    def _store_if_better(self, model: FittedModel) -> FittedModel:
        """Store a model unless a better one with the same effects is stored; return the better one.

        The better one has the higher penalised log-likelihood. If a model is replaced, what was
        computed about it is discarded (`on_replaced`).
        """
        # The key does not depend on the order in which effects were added.
        key = frozenset(model.effects)
        if (
            key not in self.models
            or model.penalised_log_likelihood > self.models[key].penalised_log_likelihood
        ):
            self.models[key] = model
            self.on_replaced(key)
        return self.models[key]

    def _rate_fit(self, fit: TrajectoryFit) -> FittedModel:
        """Return a fit with its likelihood and its penalised log-likelihood, eq. (1).

        It is M = 2 log L - k log n - sum_e max(c_e - k_e log n, 0), with the likelihood L, k fitted
        parameters and determined initial states, n samples, and for each effect e its k_e
        coefficients and the gain c_e of its best shape from noise alone.

        Args:
            fit: fit of a model; its cost is infinite if the model could not be simulated.
        """
        # k of (1): fitted parameters, and the effective number of initial states that the data
        # determine.
        freedom = fit.free_indices.size + count_identified_states(self.evaluator, fit, self.noise)
        # A model that could not be simulated is stored, too, so that it is not tried again.
        likelihood = FAILED_LIKELIHOOD
        if np.isfinite(fit.cost):
            likelihood = maximise_likelihood(
                self.compute_residual(fit), self.observed_mask, freedom
            )
        effect_penalty = sum(self.get_effect_penalty(name) for name in fit.effects)
        penalised_likelihood = (
            likelihood.value - freedom * self.parameter_penalty - effect_penalty
        )  # (1)
        return FittedModel(fit, likelihood, penalised_likelihood)

    def make_final_start(self, model: FittedModel) -> FitStart:
        """Return the start of a fit to final convergence; a subclass may add known derivatives."""
        return model.fit.make_start()

    def with_sensitivities(self, start: FitStart) -> FitStart:
        """Return the start with derivatives that are known near it, to save their computation.

        Here it is unchanged; a subclass may have derivatives from its linear model.
        """
        return start

    def score_unmodelled_force(self, model: FittedModel) -> tuple[float, str] | None:  # noqa: ARG002
        """Return the p-value of the best additional force and the signal that the force depends on.

        Here always None, since only a subclass with a Kalman filter has this test; without it, the
        test for unmodelled forces uses simulations.
        """
        return None

    def on_replaced(self, key: frozenset[str]) -> None:
        """React to a better fit of the effects `key`; a hook for subclasses, empty here."""

    @property
    def has_contact_jumps(self) -> bool:
        """True if simulated contacts may jump, so that a cost has several minima; False here."""
        return False

    @property
    def parameter_penalty(self) -> float:
        """Penalty log n of eq. (1) for each parameter that the data determine."""
        count = int(self.observed_mask.sum())
        return float(np.log(max(count, MIN_EFFECTIVE_SAMPLES)))

    def get_effect_penalty(self, name: str) -> float:
        """Return the part of the penalty in the penalised log-likelihood that belongs to an effect.

        An effect with many shapes, such as frequencies, gains likelihood from noise alone. The part
        of this gain that the penalty log n of each of its coefficients does not cover is
        subtracted: max(c_e - k_e log n, 0) of eq. (1), with k_e coefficients, n samples and the
        gain c_e of the best shape under the null hypothesis. It is zero if there are few shapes.
        """
        coefficient_count = len(self.evaluator.get_coefficient_indices(name))
        parameter_penalties = coefficient_count * self.parameter_penalty
        return float(max(self.null_gains.get(name, 0.0) - parameter_penalties, 0.0))

    def refit_models(
        self,
        starts: Sequence[FitStart],
        noise: NoiseModel | None = None,
        is_staged: bool = False,
        is_racing: bool = True,
        iterations: int = MAX_ITERATIONS,
    ) -> None:
        """Fit models from their starts, and store in `models` those that beat the known fits.

        1. With `is_staged`, reduce the starts by fits to the beginnings of the runs.
        2. Fit all of them in parallel; with `is_racing`, fits that fall far behind are stopped.
        3. Store the fits.

        Args:
            starts: starts of the fits.
            noise: noise that weights the samples; None for `self.noise`.
            is_staged: whether to fit the beginnings of the runs first, as in the base fit, and
                continue with the best models.
            is_racing: whether to stop fits that fall far behind.
            iterations: maximum number of steps of each fit.
        """
        control = self.evaluator.search_control
        control.report_and_check(f"refit of {_format_starts(starts)}")
        noise = noise or self.noise
        starts = [self.with_sensitivities(start) for start in starts]
        # 1. Stages.
        if is_staged:
            starts = self._select_promising_starts(starts, noise)
        # 2. Fits. Sums of squares with noise weights other than `self.noise` cannot be compared
        # with those of the stored fits, so then no fit is stopped early.
        is_race = is_racing and noise is self.noise
        lowest_cost = self._find_lowest_cost(starts) if is_race else np.inf
        fitter = TrajectoryFitter(self.evaluator, noise, self.fixed_parameters)
        control.begin_stage(_name_stage(starts), len(starts))
        for fit in fitter.fit_models(
            starts, iterations, is_racing=is_race, lowest_cost=lowest_cost, finished=control.advance
        ):
            # 3. Storage.
            self.add_fit(fit)
        # If the search has to end, fits may have been stopped early. They are stored above, and the
        # search ends here, before conclusions are drawn from them.
        control.check_not_stopped()
        self._report_best()

    def fit_all(
        self, starts: Sequence[FitStart], iterations: int = MAX_ITERATIONS
    ) -> list[FittedModel]:
        """Fit models from their starts together, and return the best known fit of each.

        Unlike in `refit_models`, no fit is stopped because another one is better.

        Args:
            starts: starts of the fits.
            iterations: maximum number of steps of each fit.
        """
        self.refit_models(starts, is_racing=False, iterations=iterations)
        return [self.models[frozenset(start.effects)] for start in starts]

    def fit_one(self, start: FitStart, iterations: int = MAX_ITERATIONS) -> FittedModel:
        """Fit a model from a start, and return the best known fit with the same effects.

        Args:
            start: effects, and the parameters and initial states from which the fit starts.
            iterations: maximum number of steps.
        """
        return self.fit_all([start], iterations)[0]

    def _report_best(self) -> None:
        """Report the effects of the best model, and how much they explain, to the progress display.

        The share is the part of the base model's excess over the noise that they remove. Nothing is
        reported if the base model is not fitted, or if it is the best one.
        """
        base = self.models.get(frozenset())
        best = max(
            self.models.values(), key=lambda model: model.penalised_log_likelihood, default=base
        )
        if base is None or best is None or not best.effects:
            return
        # Share of the excess of the base model that the best model removes.
        gap = self.compute_excess_residual(base)
        if gap > 0 and np.isfinite(gap):
            share = 1.0 - max(self.compute_excess_residual(best), 0.0) / gap
            self.evaluator.search_control.report_best_model(best.effects, max(share, 0.0))

    def refine_jacobian(self, model: FittedModel) -> FittedModel:
        """Return the model with derivatives at its own parameters, computed at most once.

        This is needed if the fit ended with derivatives from a nearby point, for example for
        confidence intervals. A fit with zero iterations computes them.

        Args:
            model: fitted model; the result with its own derivatives is stored if the model is
                stored.
        """
        # A model that could not be simulated has no derivatives.
        if model.fit.is_own_jacobian or not np.isfinite(model.fit.cost):
            return model
        # The stored model may be this fit, for which the derivatives were computed in an earlier
        # call.
        stored_model = self.models.get(frozenset(model.effects))
        if (
            stored_model is not None
            and stored_model.fit.is_own_jacobian
            and stored_model.fit.theta is model.fit.theta
        ):
            return stored_model
        fitter = TrajectoryFitter(self.evaluator, self.noise, self.fixed_parameters)
        (fit,) = fitter.fit_models([model.fit.make_start()], iterations=0)
        result = replace(model, fit=replace(model.fit, jacobian=fit.jacobian, is_own_jacobian=True))
        # Later calls for the stored model then need no computation.
        if stored_model is model:
            self.models[frozenset(model.effects)] = result
        return result

    def fit_to_convergence(self, model: FittedModel) -> FittedModel:
        """Return the model fitted to final convergence, weighted by the noise of its own residual.

        With AR(1) noise, confidence intervals require generalised least squares. Far from the data,
        the different weights also lead out of local minima, so the fit is repeated until nothing
        changes:

        1. Estimate the noise from the residual.
        2. Fit the model with this noise.
        3. Reject a fit with clearly larger residuals: with structured residuals, this method
           prefers smooth residuals to small ones.
        4. Stop if the penalised log-likelihood hardly increases.

        Args:
            model: fitted model, from which the first of these fits starts.

        Returns:
            The best of these fits, or the given model if none is better.
        """
        self.evaluator.search_control.begin_stage("refining the model")
        # Costs of fits with different noise weights are compared by those of the present noise.
        compute_cost = TrajectoryFitter(self.evaluator, self.noise).compute_cost
        for _ in range(MAX_REWEIGHTED_FITS):
            likelihood = model.likelihood
            if not np.isfinite(model.fit.cost):
                break
            # 1. Noise. A channel without samples has no estimate, so that of the recording is used.
            # A channel without noise would have infinite weight, hence the minimum.
            sigma = np.where(np.isfinite(likelihood.sigma), likelihood.sigma, self.noise.sigma)
            noise = NoiseModel(
                np.maximum(sigma, MIN_SIGMA_SHARE * self.noise.sigma), likelihood.phi
            )
            # 2. Fit.
            fitter = TrajectoryFitter(
                self.evaluator, noise, self.fixed_parameters, is_final_fit=True
            )
            (fit,) = fitter.fit_models([self.make_final_start(model)], MAX_ITERATIONS)
            if self.evaluator.search_control.is_over():
                break
            # 3. Comparison of the residuals.
            refitted = self._rate_fit(replace(fit, cost=compute_cost(fit)))
            if refitted.fit.cost > MAX_REWEIGHTED_SQUARES_RATIO * compute_cost(model.fit):
                break
            # 4. Convergence.
            gain = refitted.penalised_log_likelihood - model.penalised_log_likelihood
            if gain < MIN_GAIN_FOR_REWEIGHTING:
                if gain > 0:
                    # Stored directly, because `_store_if_better` would discard the scores about the
                    # old fit, which remain valid for a fit that is so close.
                    model = self.models[frozenset(refitted.effects)] = refitted
                break
            model = self._store_if_better(refitted)
        return model

    def _select_promising_starts(
        self, starts: Sequence[FitStart], noise: NoiseModel
    ) -> list[FitStart]:
        """Fit the first part of the runs, and return starts from the models that fit it best.

        This is repeated with a longer part of the runs (a fit horizon) and fewer models. The last
        horizon, whole runs, is left to the caller.

        Args:
            starts: starts of all fits.
            noise: noise of each channel.
        """
        remaining_starts = list(starts)
        # Fits to longer parts take longer, so fewer models continue after each horizon.
        for horizon, count in zip(FIT_HORIZONS[:-1], MODELS_KEPT_PER_HORIZON, strict=True):
            fitter = TrajectoryFitter(self.evaluator, noise, self.fixed_parameters, horizon.share)
            fits = fitter.fit_models(remaining_starts, horizon.iterations)
            fits.sort(key=lambda fit: fit.cost)
            remaining_starts = [fit.make_start() for fit in fits[:count]]
        return remaining_starts

    def _find_lowest_cost(self, starts: Sequence[FitStart]) -> float:
        """Return the lowest cost of fitted models that are at most as large as the starts.

        Fits that fall far behind this cost are stopped early. It is infinite without such models.
        """
        max_size = max(len(start.effects) for start in starts)
        fitted_models = self.models.values()
        # Larger models have lower costs merely because of their size.
        costs = [m.fit.cost for m in fitted_models if 0 < len(m.effects) <= max_size]
        return min(costs, default=np.inf)

    def get_best(self, size: int) -> FittedModel | None:
        """Return the model of `size` effects with the highest penalised log-likelihood.

        It is None if no model of this size was fitted.
        """
        fitted_models = self.models.values()
        models = [m for m in fitted_models if len(m.effects) == size]
        return select_likeliest(*models) if models else None

    def compute_excess_residual(self, model: FittedModel) -> float:
        """Return the RMS residual of a model, in units of the noise floor, minus one.

        A model whose residual is only noise has the excess 0.
        """
        scaled = self.compute_residual(model.fit) / self.noise.sigma
        squares = np.square(scaled[self.observed_mask])
        return float(np.sqrt(squares.mean())) - 1.0

    def compute_channel_weights(self, model: FittedModel) -> NoiseModel:
        """Return the noise that weights the channels in a score test about a model.

        It is the sensor noise, or the residual of the model where that is larger, so that a channel
        that the model does not follow does not dominate.
        """
        sigma = model.likelihood.sigma
        # A channel without samples has no sigma, and its weight has no influence.
        residual_sigma = np.where(np.isfinite(sigma), sigma, 0.0)
        return NoiseModel(np.maximum(self.noise.sigma, residual_sigma), self.noise.phi)


def _format_starts(starts: Sequence[FitStart]) -> str:
    """Return a short description of the models of these starts, for the progress display."""
    names = [" + ".join(start.effects) or "the base model" for start in starts]
    return join_first_names(names, 1) or "nothing"


def _name_stage(starts: Sequence[FitStart]) -> str:
    """Return the name of the stage that fits these models, for the progress display."""
    size = max((len(start.effects) for start in starts), default=0)
    singular, plural = MODEL_SIZE_TEXTS.get(
        size, (f"set of {size} effects", f"sets of {size} effects")
    )
    return f"fitting {singular if len(starts) == 1 else plural}"


def count_identified_states(
    evaluator: RunEvaluator, fit: TrajectoryFit, noise: NoiseModel
) -> float:
    """Return the number of initial states that the data determine, summed over all runs.

    They count as fitted parameters when the noise is estimated; a state without influence on the
    data does not. These are the effective degrees of freedom of ridge regression (T. Hastie, R.
    Tibshirani, J. Friedman, The Elements of Statistical Learning, 2nd ed., section 3.4.1). With the
    derivatives B_i of run i by its initial state in units of the noise, the diagonal matrix π of
    the prior standard deviations of the states, and the eigenvalues λ_ij of π B_iᵀ B_i π:

        f = Σ_ij λ_ij / (1 + λ_ij)                                                               (2)

    The result need not be an integer, because a state may be determined only in part.

    Args:
        evaluator: evaluator with the recorded runs.
        fit: fit of the model, with its Jacobian.
        noise: noise of each channel.
    """
    observed_mask = np.isfinite(evaluator.observed)
    state_jacobian = np.where(observed_mask[..., None], fit.state_jacobian, 0.0)
    scaled = state_jacobian / noise.sigma[:, None]
    # The shape is written out, because -1 is ambiguous if there are no states.
    run_count, length, channels, state_count = scaled.shape
    # B_i π of each run, (R, T C, s).
    columns = scaled.reshape(run_count, length * channels, state_count) * compute_state_prior(
        evaluator
    )
    # A known state is not a degree of freedom.
    columns = np.where(evaluator.known_state_mask[:, None, :], 0.0, columns)
    # π B_iᵀ B_i π of each run, (R, s, s).
    normal = np.matmul(columns.transpose(0, 2, 1), columns)
    eigenvalues = np.linalg.eigvalsh(normal)
    # Rounding may make an eigenvalue slightly negative.
    freedoms = eigenvalues / (1.0 + np.maximum(eigenvalues, 0.0))  # (2)
    return float(freedoms.clip(0.0, 1.0).sum())


FAILED_LIKELIHOOD = Likelihood(-np.inf, np.zeros(0), np.zeros(0))
"""Likelihood of a model that could not be simulated."""
