"""Identifiability of each parameter and cause: identifiable, weak or not, and what it confounds.

D are the derivatives of all recorded samples by the parameters, in units of the noise and projected
onto the complement of the derivatives by the initial states of each run. The covariance of a fit is
then the inverse of the Fisher information

    F = D'D,    cov = F^-1                                                                     (1)

(E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data, 1997, chapter
4; C. Brun, P. Reichert, H. R. Kuensch, Water Resources Research 37(4), 1015, 2001, for weak and
collinear parameters). Free parameters are assessed together. Each cause is assessed alone, in
addition to the free parameters, because causes are tested one at a time. Two causes are confounded
if their derivatives are nearly parallel,

    corr = |d_i'd_j| / (|d_i| |d_j|)                                                           (2)

White noise is assumed, and the derivatives are those of the model that fits the recording now.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import BaseFit, fit_base_model
from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from bench.diagnosis.fitting.trajectory_derivatives import (
    CandidateDirection,
    compute_central_jacobian,
)
from bench.diagnosis.fitting.trajectory_fit import compute_state_prior
from bench.diagnosis.search.candidate_directions import DirectionSet, compute_directions
from bench.diagnosis.search.diagnose import find_unidentified_parameters
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.validation.confidence_intervals import Z95, invert_scaled
from bench.logs.filter_settling import leave_out_settling
from bench.logs.recording_loading import load_recording
from bench.logs.segmentation import segment_recording
from sims.core.effect import ALL_PLACES
from sims.core.simulator import Array, InputError, Parameter
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator

IdentifiabilityLevel = Literal["identifiable", "weak", "not identifiable"]
MAX_IDENTIFIABLE_WIDTH, MAX_WEAK_WIDTH = 0.1, 1.0
"""Maximum width of a 95 % interval, as a fraction of a parameter's range, for identifiable and for
weak parameters.
"""
MIN_DETECTABLE_LIMIT_SIGMAS = 5.0
"""Minimum norm of the change of all samples by a limit or backlash, in noise standard deviations,
for it to be detectable.
"""
CONFOUNDING_CORRELATION = 0.95
"""Minimum correlation of two parameters that are reported as confounded."""
CANDIDATES_PER_BLOCK = 256
"""Number of candidates that are projected together, which limits the memory."""
MAX_NAMED_CONFOUNDERS = 4
"""Maximum number of confounded parameters that are reported for one parameter."""
MAX_REFITS = 4
"""Maximum number of refits with more frozen numbers; the last one freezes all that remain."""


@dataclass(frozen=True)
class ParameterIdentifiability:
    """Identifiability of one parameter or coefficient of a cause.

    Attributes:
        name: Name of the parameter, or of the cause with its coefficient.
        free: Whether it is a free parameter of the fit; False for a cause.
        unit: Unit of the value.
        half: Half the width of the 95 % interval; infinite if the recording is insensitive to it,
            NaN for a limit or backlash, which is either detectable or not.
        low, high: Plausible range.
        word: Identifiability level.
        mixed: Names of confounded parameters with their correlation.
    """

    name: str
    free: bool
    unit: str
    half: float
    low: float
    high: float
    word: IdentifiabilityLevel
    mixed: tuple[tuple[str, float], ...]


def check_identifiability(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
) -> tuple[ParameterIdentifiability, ...]:
    """Assess which free numbers and which causes a recording can identify.

    The base model is fitted first. The derivatives of the runs at the fit then show what the
    recording can determine; white noise is assumed, so no correlation is estimated.

    Args:
        source: Recording, or the path of its table.
        system: Name of the system to use instead of the one in the description.
        model: Model file of a robot to use instead of the one in the description.
        free: Numbers of a robot's model file, or constants of a system, that are estimated.

    Returns:
        Identifiability of each free number, then of each cause.

    Raises:
        InputError: The recording cannot be read, or its simulator takes no effects.
    """
    recording, kind = load_recording(source, system, model, free)
    if not issubclass(kind, SystemSimulator):
        raise InputError(f"{recording.path}: simulator {recording.system} takes no effects")
    recording, _ = leave_out_settling(recording, kind)
    recording, _ = segment_recording(recording, kind)
    engine = kind.default_engine if kind.own_engine else "batch"
    # The freed numbers of a robot are parameters of `kind` already.
    constants = () if kind.has_model else tuple(free)
    with closing(ForkedWorkerPool(1)) as worker_pool:
        evaluator = RunEvaluator(kind, recording, recording.training(), engine, (), constants)
        evaluator.worker_pool = worker_pool
        worker_pool.register(evaluator)
        noise = NoiseModel.make_white(compute_noise_floor(evaluator, recording).sigma)
        base = fit_base_model(evaluator, noise)
        if not np.isfinite(base.fit.cost):
            raise InputError(
                f"{recording.path}: the simulation fails at every starting point of the fit; "
                "check constants, units, inputs and initial states"
            )
        fit_with_derivatives = compute_central_jacobian(evaluator, base.fit, noise)
        numbers = assess_identifiability(evaluator, noise, fit_with_derivatives)
        evaluator.close()
    return numbers


def assess_identifiability(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    fit: TrajectoryFit,
    direction_set: DirectionSet | None = None,
) -> tuple[ParameterIdentifiability, ...]:
    """Assess the identifiability of every free parameter and of every cause.

    Args:
        evaluator: Run evaluator of the runs.
        noise: Noise of each channel.
        fit: Fit with its derivatives; the linearisation point.
        direction_set: Sensitivity directions of the causes at this point, if they are known.

    Returns:
        Free parameters first, then causes, those with the narrowest intervals first.
    """
    if direction_set is None:
        # An effect at all places is represented by those at single places.
        names = [
            name
            for name in evaluator.library
            if evaluator.available_effects[name].place != ALL_PLACES
        ]
        direction_set = compute_directions(evaluator, fit, names)
    return _IdentifiabilityAssessment(evaluator, noise, fit, direction_set).numbers()


def assess_identifiability_after_search(
    search: EffectSearch,
) -> tuple[ParameterIdentifiability, ...]:
    """Assess identifiability from the responses of the runs to effects (directions).

    The search has computed them about the base model, on their own or together with scores. If it
    has not, the result is empty. This is the last step that uses the search, so its memory is
    released first.

    Args:
        search: Finished search.

    Returns:
        Free parameters first, then causes, those with the narrowest intervals first.
    """
    search.release_memory()
    directions = search.get_known_directions()
    if directions is None:
        # Scans are scores with their directions, by the effects of the model; the base model has no
        # effects. That of an earlier fit is used if a better fit has replaced it without a scan.
        key: frozenset[str] = frozenset()
        scan = search.cached_scans.get(key) or search.superseded_scans.get(key)
        if scan is None:
            return ()
        directions = scan.fit, scan.directions
    return assess_identifiability(search.evaluator, search.noise, *directions)


class _Direction(NamedTuple):
    """The most sensitive direction of a coefficient.

    Attributes:
        probe: the candidate.
        norm: information on the coefficient, in units of the noise.
        unit_column: (N,) whitened response without states and parameters, scaled to length one.
    """

    probe: CandidateDirection
    norm: float
    unit_column: Array


class _IdentifiabilityAssessment:
    """Linearised runs at a fit, from which the identifiability of each number follows."""

    def __init__(
        self,
        evaluator: RunEvaluator,
        noise: NoiseModel,
        fit: TrajectoryFit,
        direction_set: DirectionSet,
    ) -> None:
        """Scale the derivatives by the noise, and project the unknown initial states out of them.

        `states` (R, n, s) has the scaled derivatives by the initial states, where n = T · C is
        the number of samples times channels of a run. `parameters` (R · n, q) has those by the q
        free parameters, without the part that a change of the initial states can reproduce. In
        `fit.jacobian` (R, T, C, q + s) the parameters come first.

        Shapes: R runs, s states of a run.

        Args:
            evaluator: Run evaluator of the recording.
            noise: Noise of each channel.
            fit: Fitted model, with the derivatives of the runs.
            direction_set: Directions of all candidate effects.
        """
        self.evaluator, self.noise = evaluator, noise
        self.fit, self.direction_set = fit, direction_set
        self.observed_mask = np.isfinite(evaluator.observed)
        q = fit.free_indices.size
        jacobian = np.where(self.observed_mask[..., None], fit.jacobian, 0.0)
        jacobian /= noise.sigma[:, None]
        runs = len(jacobian)
        flat = jacobian.reshape(runs, -1, jacobian.shape[3])
        # A known initial state is not fitted, so nothing is projected out for it.
        self.states = flat[..., q:] * ~evaluator.known_state_mask[:, None, :]
        self.parameters = self._project_out_states(flat[..., :q])

    def numbers(self) -> tuple[ParameterIdentifiability, ...]:
        """Return the identifiability of the free parameters, then of the causes, the best first."""
        free = self._assess_free_parameters()
        causes = sorted(self._assess_causes(), key=_share_of_range)
        return (*free, *causes)

    def _project_out_states(self, columns: Array) -> Array:
        """Project the initial states of each run out of k columns (R, n, k); return (R n, k).

        A column is the derivative of all samples by a parameter, or the response to an effect.
        What a change of the initial states could explain gives no information on a parameter. The
        prior of the initial states limits their change: it is added to the normal equations of the
        least-squares fit of each column by the derivatives `states` (R, n, s). An unstable motion
        has nearly parallel derivatives, which the scaled inverse allows.

        Shapes: R runs, n samples times channels of a run, s states of a run.

        Args:
            columns: (R, n, k) columns in units of the noise, zero where nothing is recorded.
        """
        state_jacobian = self.states
        precision = np.diag(compute_state_prior(self.evaluator) ** -2.0)
        normal = np.matmul(state_jacobian.transpose(0, 2, 1), state_jacobian) + precision
        inverse = np.array([invert_scaled(run_normal, run_normal) for run_normal in normal])
        coefficients = inverse @ np.matmul(state_jacobian.transpose(0, 2, 1), columns)
        projected: Array = columns - np.matmul(state_jacobian, coefficients)
        runs, samples, count = projected.shape
        return projected.reshape(runs * samples, count)

    def _project_out_states_and_parameters(self, candidates: Sequence[int], basis: Array) -> Array:
        """Return the part of k responses, in units of the noise, that nothing else can reproduce.

        The parts that a change of the initial states or of the q free parameters can reproduce are
        projected out. The result is (N, k), for N samples times channels of all runs.

        Args:
            candidates: indices of k candidates.
            basis: (N, q) orthonormal basis of the derivatives by the free parameters, from which
                the changes by initial states are already projected out.
        """
        responses = np.where(
            self.observed_mask[..., None], self.direction_set.responses[..., candidates], 0.0
        )
        responses = responses / self.noise.sigma[:, None]
        columns = self._project_out_states(responses.reshape(len(responses), -1, len(candidates)))
        projected: Array = columns - basis @ (basis.T @ columns)
        return projected

    def _assess_free_parameters(self) -> list[ParameterIdentifiability]:
        """Assess all free parameters from their joint covariance (D'D)^-1, eq. (1).

        The columns of D are the derivatives `self.parameters` (samples, parameters) in units of the
        noise. A parameter without any influence has an infinite variance, and so has one to which
        the runs are insensitive, which the fit has frozen.
        """
        curvature = self.parameters.T @ self.parameters
        covariance = invert_scaled(curvature, curvature)
        # Standard error of each parameter; infinite without influence.
        errors = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        errors = np.where(np.diagonal(curvature) > 0, errors, np.inf)
        correlations = np.abs(covariance / np.outer(errors, errors))
        free_indices = self.fit.free_indices.tolist()
        names = [self.evaluator.parameters[i].name for i in free_indices]
        assessments = []
        for index, error, row in zip(free_indices, errors.tolist(), correlations, strict=True):
            parameter = self.evaluator.parameters[index]
            confounders = [
                (name, correlation)
                for name, correlation in zip(names, row.tolist(), strict=True)
                if name != parameter.name
            ]
            assessments.append(
                _classify_parameter(parameter.name, True, parameter, Z95 * error, confounders)
            )
        # Parameters to which the runs are insensitive: they are frozen, so D has no column of them.
        for index in sorted(set(self.evaluator.base_indices.tolist()) - set(free_indices)):
            parameter = self.evaluator.parameters[index]
            assessments.append(_classify_parameter(parameter.name, True, parameter, np.inf, ()))
        return assessments

    def _assess_causes(self) -> list[ParameterIdentifiability]:
        """Assess the coefficient of each possible cause, fitted with the free parameters.

        1. Select the most sensitive direction of each coefficient: the change of all samples by it.
        2. Compute the interval of the coefficient from the norm of its direction, and its
           correlations with the coefficients of other effects.
        """
        evaluator = self.evaluator
        # 1. Directions.
        most_sensitive = self._select_strongest_directions()
        # 2. Intervals and correlations.
        selected = list(most_sensitive.values())
        unit_columns = np.array([direction.unit_column for direction in selected])
        correlations = np.abs(unit_columns @ unit_columns.T)
        assessments = []
        for row, ((name, coefficient_index), direction) in zip(
            correlations, most_sensitive.items(), strict=True
        ):
            parameter_index = evaluator.get_coefficient_indices(name)[coefficient_index]
            parameter = evaluator.parameters[parameter_index]
            probe, norm = direction.probe, direction.norm
            # The direction is in units of the noise, so the standard error is 1 / norm.
            half_width = Z95 / norm if norm > 0 else np.inf
            confounders = [
                (other_effect, float(correlation))
                for (other_effect, _), other, correlation in zip(
                    most_sensitive, selected, row, strict=True
                )
                if other_effect != name and other.norm > 0
            ]
            label = name
            # Of an effect with several coefficients, the name of the coefficient is added.
            if sum(effect == name for effect, _ in most_sensitive) > 1:
                label += f" {parameter.name.rpartition('.')[2]}"
            identifiability = _classify_parameter(label, False, parameter, half_width, confounders)
            if probe.is_single_size:
                # The response to a limit or backlash is not proportional to its size, so it has no
                # interval (NaN). It is rated by the response at the tried sizes.
                identifiability = replace(
                    identifiability, half=np.nan, word=_rate_switching_effect(norm)
                )
            assessments.append(identifiability)
        return assessments

    def _select_strongest_directions(self) -> dict[tuple[str, int], _Direction]:
        """Return the most sensitive direction of each coefficient, by effect and its index.

        A direction is the change of all samples by a coefficient. A coefficient may have several:
        one for each shape, a choice of the other coefficients such as a frequency. A limit or
        backlash (a switching effect) has one for each tried size.

        1. Project initial states and parameters out of each direction. The norm of the rest, in
           units of the noise, is the information on the coefficient.
        2. Select the direction with the largest norm.

        Effects that act at all places are represented by their members at single places.
        """
        evaluator, candidates = self.evaluator, self.direction_set.candidates
        indices = [
            k
            for k, probe in enumerate(candidates)
            if evaluator.available_effects[probe.effect].place != ALL_PLACES
        ]
        switching_effects = {probe.effect for probe in candidates if probe.is_single_size}
        basis, _ = np.linalg.qr(self.parameters)
        most_sensitive: dict[tuple[str, int], _Direction] = {}
        # All responses at once would need too much memory.
        for begin in range(0, len(indices), CANDIDATES_PER_BLOCK):
            block = indices[begin : begin + CANDIDATES_PER_BLOCK]
            # 1. Information on each direction.
            columns = self._project_out_states_and_parameters(block, basis)
            norms = np.sqrt(np.einsum("nk,nk->k", columns, columns))
            # 2. The most sensitive direction.
            for column, norm, k in zip(columns.T, norms.tolist(), block, strict=True):
                probe = candidates[k]
                # A switching effect is only assessed at its tried sizes.
                if probe.effect in switching_effects and not probe.is_single_size:
                    continue
                key = probe.effect, probe.coefficient_index
                if key not in most_sensitive or norm > most_sensitive[key].norm:
                    most_sensitive[key] = _Direction(probe, norm, column / max(norm, 1e-300))
        return most_sensitive


def _rate_switching_effect(norm: float) -> IdentifiabilityLevel:
    """Rate how well the data identify a limit or backlash, from the size of its response.

    It is not identifiable if the noise hides the response; weak if the response is only a little
    larger than the smallest detectable one.

    Args:
        norm: norm of the change of all samples by the effect, in units of the noise.
    """
    if norm < MIN_DETECTABLE_LIMIT_SIGMAS:
        return "not identifiable"
    is_weak = norm < MIN_DETECTABLE_LIMIT_SIGMAS / MAX_IDENTIFIABLE_WIDTH
    return "weak" if is_weak else "identifiable"


def _classify_parameter(
    name: str,
    free: bool,
    parameter: Parameter,
    half_width: float,
    confounders: Sequence[tuple[str, float]],
) -> ParameterIdentifiability:
    """Classify a parameter by the width of its 95 % interval as a share of its plausible range.

    It is identifiable, weak or not identifiable. Parameters that are strongly correlated with it
    are named.

    Args:
        name: Name of the parameter or cause.
        free: Whether it is a free parameter of the model, not a possible cause.
        parameter: Parameter with its unit and plausible range.
        half_width: Half the width of its 95 % interval; infinite if the data are insensitive to it.
        confounders: Other parameters with their correlation; only the strongly correlated ones are
            kept.
    """
    low, high = parameter.bounds
    # Width of the interval as a share of the range.
    share = 2.0 * half_width / max(high - low, 1e-300)
    level: IdentifiabilityLevel = "not identifiable"
    if share <= MAX_WEAK_WIDTH:
        level = "identifiable" if share <= MAX_IDENTIFIABLE_WIDTH else "weak"
    correlation_by_name: dict[str, float] = {}
    for other, correlation in sorted(confounders, key=lambda entry: entry[1], reverse=True):
        if correlation > CONFOUNDING_CORRELATION:
            # Of several entries with one name, the first one is the strongest.
            correlation_by_name.setdefault(other, correlation)
    named_confounders = tuple(correlation_by_name.items())[:MAX_NAMED_CONFOUNDERS]
    return ParameterIdentifiability(
        name, free, parameter.unit, float(half_width), low, high, level, named_confounders
    )


def _share_of_range(number: ParameterIdentifiability) -> float:
    """Return half the width of an interval as a fraction of the plausible range."""
    width = number.high - number.low
    with np.errstate(over="ignore"):
        return float(np.nan_to_num(number.half) / width) if width > 0 else 0.0


def freeze_unidentified_parameters(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    base: BaseFit,
    searching: Callable[[BaseFit], EffectSearch],
) -> BaseFit:
    """Freeze at the nominal value all free numbers that the data cannot identify.

    The worse half of the unidentified parameters is frozen and the rest refitted, because the
    others may become identifiable then; in the last of `MAX_REFITS` rounds all of them are frozen.

    Args:
        evaluator: Run evaluator of the runs.
        noise: Noise of each channel.
        base: Fitted base model.
        searching: function that begins a search from a base model; the search shows which
            parameters the data identify.

    Returns:
        The base model, fitted without these numbers.
    """
    for iteration in range(MAX_REFITS):
        search = searching(base)
        unidentified = find_unidentified_parameters(search, search.base_model)
        index_by_name = {
            evaluator.parameters[index].name: index for index in evaluator.base_indices.tolist()
        }
        # The names are sorted by the width of the intervals, the widest first.
        frozen_indices = [index_by_name[name] for name in unidentified if name in index_by_name]
        if not frozen_indices:
            break
        # The worse half, rounded up.
        if iteration < MAX_REFITS - 1:
            frozen_indices = frozen_indices[: (len(frozen_indices) + 1) // 2]
        base = replace(
            base, unidentified_parameters=base.unidentified_parameters | frozenset(frozen_indices)
        ).refit_at_nominal(evaluator, noise, frozen_indices)
    return base
