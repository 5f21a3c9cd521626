"""Detection limits: how large each absent effect would have to be for the data to reveal it.

The limits of absent effects (`compute_detection_limits`) are computed at a fitted model. A are the
whitened derivatives by the parameters of the model, and d the derivatives by one more coefficient;
the initial states of each run are projected out of both (`validation.confidence_intervals`). The
remaining information on the coefficient, after A is projected out too, is

    power = d'd - d'A (A'A)^-1 A'd                                                              (1)

Its 95 % interval extends 1.96 / sqrt(power) to both sides (E. Walter, L. Pronzato, Identification
of Parametric Models from Experimental Data, 1997, chapter 4). With the residual e of the model, one
Gauss-Newton step from zero would give the coefficient the value

    c = (d'e - d'A (A'A)^-1 A'e) / power                                                        (2)

The noise is the residual of the model with its autocorrelation (AR(1)). With a lack of fit it is
larger than the sensor noise, and (2) may be far from zero although the effect is not a cause.
The effect of a limit or backlash is not proportional to its size. It is detectable at the sizes at
which it changes the runs by at least the smallest detectable amount (`diagnosis.identifiability`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.core.random_streams import make_rng
from bench.diagnosis.datasheet.datasheet_joint import ModelFileValue, SheetSubject
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import ModelSet
from bench.diagnosis.fitting.levenberg_marquardt import (
    FitStart,
    TrajectoryFit,
    compute_schur_complement,
)
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.identifiability import CONFOUNDING_CORRELATION, MIN_DETECTABLE_LIMIT_SIGMAS
from bench.diagnosis.score_extended import build_theta
from bench.diagnosis.search.candidate_directions import (
    NONLINEAR_COEFFICIENT_KINDS,
    DirectionSet,
    compute_directions,
    compute_responses,
)
from bench.diagnosis.validation.confidence_intervals import (
    MAX_INTERVAL_WIDTH,
    Z95,
    compute_fisher_blocks_from_jacobian,
    get_central_jacobian,
    invert_scaled,
)
from bench.diagnosis.validation.held_out_runs import HeldOutRuns
from bench.diagnosis.validation.run_consistency import (
    assess_consistency,
    compute_prediction_half_widths,
)
from sims.core.effect import ALL_PLACES
from sims.core.simulator import Array, InputError
from sims.extended_simulator import ExtendedSimulator, FittedValue

SAME_COEFFICIENT_CORRELATION = 0.999
"""Minimum correlation for which the coefficient of an effect counts as equivalent to that of a
simpler effect.
"""
GAP_HALVINGS = 5
"""Number of times that the smallest backlash of the search is halved."""
MIN_CONFOUNDING_SHARE = 0.1
"""Minimum share of the largest contribution for a parameter to be reported as confounded."""


@dataclass(frozen=True)
class DetectionLimit:
    """Detection limit of one coefficient.

    Attributes:
        size: Half its 95 % interval; for a limit or backlash the size at which it is detectable;
            infinite if the data are insensitive to it.
        estimate_if_fitted: Estimate after one Gauss-Newton step from zero, eq. (2) of the module
            docstring; zero for a limit or backlash.
        limit: ``above`` for backlash, which is detectable from that size on; ``below`` for a limit,
            which is detectable up to it; empty for proportional effects.
        confounded_with: Parameters of the model that are confounded with it.
        is_unbounded: Whether it could be larger than all plausible values.
    """

    size: float
    estimate_if_fitted: float = 0.0
    limit: str = ""
    confounded_with: tuple[str, ...] = ()
    is_unbounded: bool = False

    @property
    def is_nonzero_if_fitted(self) -> bool:
        """Return whether its estimate would differ from zero if it were fitted."""
        return abs(self.estimate_if_fitted) > self.size

    def to_document(self) -> dict[str, Any]:
        """Return the keys of the limit in the row of a data sheet, as TOML data.

        `resolved` is the smallest detectable size of an effect that is proportional to its
        coefficient. `none_above` states that no backlash larger than a size exists, `none_below`
        that no limit smaller than a size exists. The size is omitted if the data are insensitive to
        the effect. `vague` states that this size is more than all plausible values. `leans_to` is
        the estimate after one Gauss-Newton step from zero, if it is larger than the detectable
        size. `mixed_with` names the parameters that the data cannot distinguish from the effect.
        """
        document: dict[str, Any] = {}
        if np.isfinite(self.size):
            size_key = {"": "resolved", "above": "none_above", "below": "none_below"}[self.limit]
            document[size_key] = self.size
            if self.is_unbounded:
                document["vague"] = True
            if self.is_nonzero_if_fitted:
                document["leans_to"] = self.estimate_if_fitted
        if self.confounded_with:
            document["mixed_with"] = list(self.confounded_with)
        return document


@dataclass(frozen=True)
class DetectionLimits:
    """Detection limits and parameter uncertainty at a fitted model.

    Attributes:
        free: Names of the fitted parameters of the model.
        covariance: (q, q) covariance of these parameters.
        limits: Detection limits of absent effects, by effect and coefficient.
        prediction_half_widths: Half the 95 % interval of a parameter in a log, or a run, that is
            not yet recorded, by name; only for parameters that several groups identify.
    """

    free: tuple[str, ...]
    covariance: Array
    limits: Mapping[tuple[str, str], DetectionLimit]
    prediction_half_widths: Mapping[str, float]


def make_limit_from_interval(
    number: FittedValue, file_value: ModelFileValue | None
) -> DetectionLimit:
    """Return the detection limit of a fitted number: the larger end of its 95 % interval.

    Such a number may be zero, as its interval contains zero.

    Args:
        number: Fitted number with its interval; an end that is not known counts as zero.
        file_value: Its value in the model file, by which the limit is scaled; None if the file has
            none.
    """
    low, high = number.low or 0.0, number.high or 0.0
    size = max(abs(low), abs(high))
    return DetectionLimit(size if file_value is None else file_value.compute_half_width(size))


def list_absent_effects(subject: SheetSubject, extended: ExtendedSimulator) -> Iterator[str]:
    """Yield the names of effects that can act at the subject but are not in the model.

    Simpler forms of the effects in the model are left out: a model with Stribeck friction does not
    lack Coulomb friction. So are effects at all places of a kind at once (families). An effect
    whose coefficients are all zero counts as absent.

    Args:
        subject: Joint or system of the sheet.
        extended: Extended simulator.
    """
    local_effects = [
        effect
        for name, coefficients in extended.effects.items()
        for effect, _, fitted_value in subject.localise_effect(name, coefficients)
        if fitted_value.value != 0
    ]
    modelled = {*local_effects, *extended.effects}
    effect_classes = {effect.name: effect for effect in subject.list_effects()}
    # An effect names in `contains` the simpler ones to which it reduces if some of its coefficients
    # are zero.
    simpler_effects = {
        contained_effect
        for name in local_effects
        for contained_effect in getattr(effect_classes.get(name), "contains", ())
    }
    for name in effect_classes:
        if name not in modelled | simpler_effects and name.partition("@")[2] != ALL_PLACES:
            yield name


def compute_detection_limits(
    evaluator: RunEvaluator, extended: ExtendedSimulator, names: Sequence[str]
) -> DetectionLimits:
    """Compute how large each absent effect would have to be for the recording to reveal it.

    1. Simulate the runs with the extended simulator, which lacks these effects.
    2. Take its residual as the noise.
    3. Compute the directions of the absent effects, and the limits.

    Args:
        evaluator: Evaluator of the runs, with the effects of the simulator and the absent ones.
        extended: Extended simulator of a diagnosis.
        names: Names of the absent effects.

    Raises:
        InputError: The simulation fails on the runs.
    """
    # 1. Simulation.
    noise_floor = compute_noise_floor(evaluator, evaluator.recording)
    white_noise = NoiseModel.make_white(noise_floor.sigma)
    fit = _linearise_extended(evaluator, extended, white_noise)
    if not np.isfinite(fit.simulated[np.isfinite(evaluator.observed)]).all():
        raise InputError(f"{evaluator.recording.path}: the simulation of it fails")
    # 2. Noise.
    # The random stream is not used, because there is no search.
    models = ModelSet(evaluator, white_noise, frozenset(), make_rng("sheet"), noise_floor.is_stated)
    model = models.add_fit(fit)
    likelihood = model.likelihood
    # The residual of the model is taken as the noise, whatever the recording specifies. It is not
    # zero, because derivatives are divided by it.
    noise = NoiseModel(np.maximum(likelihood.sigma, 1e-300), likelihood.phi)
    # 3. Directions and limits.
    directions = _add_small_gaps(evaluator, fit, compute_directions(evaluator, fit, names))
    calculator = _DetectionLimitCalculator(
        evaluator,
        noise,
        get_central_jacobian(models, fit),
        directions,
        models.compute_residual(fit),
    )
    return calculator.compute_limits(
        compute_prediction_half_widths(assess_consistency(models, model))
    )


def _add_small_gaps(
    evaluator: RunEvaluator, fit: TrajectoryFit, directions: DirectionSet
) -> DirectionSet:
    """Add directions of backlash below the tried sizes, of an input or a robot's transmission.

    Dead bands and limits of an input or a servo error are included. A direction is the change of
    the runs by an effect. These effects are not linear in their size, so each size is simulated. If
    the smallest backlash that the search tries is detectable, smaller ones may be, too, and the
    detection limit would be unknown. Each further size is half the previous one, `GAP_HALVINGS`
    times.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        fit: fit of the model, at which the directions are computed.
        directions: directions of all candidates.
    """
    # A probe is an effect with given coefficients; its direction is valid only at this size if
    # `is_single_size`. The first coefficient is the size, and the others are the shape, such as the
    # share of the inertia of a rotor: each shape has a smallest size of its own.
    smallest_probes: dict[tuple[str, bytes], CandidateDirection] = {}
    for probe in directions.candidates:
        kind = evaluator.available_effects[probe.effect].coefficients[0].of
        # Whether the effect vanishes with its size. Backlash of a transmission does so in a robot,
        # where the flanks are rigid; in a system they are springs, which remain at any gap. The
        # other kinds, for example rate limits and compliances, are only tried at the sizes of the
        # search.
        vanishes = kind not in NONLINEAR_COEFFICIENT_KINDS or (
            kind == "travel" and evaluator.kind.has_model
        )
        key = probe.effect, probe.coefficients[1:].tobytes()
        smallest = smallest_probes.get(key)
        is_smaller = smallest is None or probe.coefficients[0] < smallest.coefficients[0]
        if probe.is_single_size and vanishes and is_smaller:
            smallest_probes[key] = probe
    smaller_probes = [
        replace(
            probe,
            coefficients=np.append(probe.coefficients[0] * 0.5**halvings, probe.coefficients[1:]),
        )
        for probe in smallest_probes.values()
        for halvings in range(1, GAP_HALVINGS + 1)
    ]
    if not smaller_probes:
        return directions
    # Shape: sizes, runs, samples, channels. A failed simulation counts as no change.
    responses = np.nan_to_num(
        compute_responses(
            evaluator, fit, [(probe.effect, probe.coefficients) for probe in smaller_probes]
        )
    )
    return DirectionSet(
        (*directions.candidates, *smaller_probes),
        np.concatenate([directions.responses, np.moveaxis(responses, 0, -1)], axis=3),
    )


def _linearise_extended(
    evaluator: RunEvaluator, extended: ExtendedSimulator, noise: NoiseModel
) -> TrajectoryFit:
    """Simulate the runs with the extended simulator, and compute its Jacobian at this point.

    Only the initial states are fitted; parameters and coefficients keep their values.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        extended: extended simulator of a diagnosis: fitted parameters, constants and effects.
        noise: noise of each channel.
    """
    theta = build_theta(evaluator, extended)
    (prediction,) = HeldOutRuns(evaluator, noise).fit_initial_states([theta])
    fitted_values = [
        extended.parameters.get(parameter.name)
        for parameter in evaluator.parameters[: evaluator.system_parameter_count]
    ]
    # A parameter without an interval was not fitted.
    unfitted_indices = frozenset(
        index
        for index, fitted_value in enumerate(fitted_values)
        if fitted_value is None or fitted_value.low is None
    )
    start = FitStart(tuple(extended.effects), theta, prediction.states)
    # Without iterations, the fitter only simulates and differentiates at the start.
    fitter = TrajectoryFitter(evaluator, noise, unfitted_indices)
    (fit,) = fitter.fit_models([start], iterations=0)
    return fit


class _DetectionLimitCalculator:
    """Information in the runs about the coefficients of absent effects, at a fitted model."""

    def __init__(
        self,
        evaluator: RunEvaluator,
        noise: NoiseModel,
        fit: TrajectoryFit,
        direction_set: DirectionSet,
        residual: Array,
    ) -> None:
        """Compute the information on each candidate coefficient, and its Gauss-Newton step.

        The columns of the least-squares problem are the q fitted parameters A, the K candidate
        directions d_k and the residual e, whitened. The attributes are, after the initial states
        are projected out of all columns by a Schur complement:

        - `products` (q + K + 1, q + K + 1): inner products of the columns.
        - `covariance` (q, q): (A'A)^-1.
        - `projections` (K, q): coefficients d_k'A (A'A)^-1 with which the parameters reproduce each
          direction.
        - `powers` (K,): information d_k'd_k - d_k'A (A'A)^-1 A'd_k that remains, eq. (1).
        - `newton_steps` (K,): estimate (d_k'e - d_k'A (A'A)^-1 A'e) / power after one step from
          zero, eq. (2).

        Shapes: R runs, T samples, C channels.

        Args:
            evaluator: Run evaluator of the recording.
            noise: AR(1) noise with which derivatives and residual are whitened.
            fit: Fitted model, with the derivatives of the runs.
            direction_set: Directions of all candidate effects.
            residual: (R, T, C) recorded minus simulated runs.
        """
        self.evaluator, self.direction_set = evaluator, direction_set
        self.q = fit.free_indices.size
        self.free_indices = fit.free_indices.tolist()
        self.free = tuple(evaluator.parameters[index].name for index in self.free_indices)
        columns = np.concatenate(
            [fit.parameter_jacobian, direction_set.responses, residual[..., None]], axis=3
        )
        # Only the initial states are eliminated, so all other columns count as parameters.
        fisher_blocks = compute_fisher_blocks_from_jacobian(
            evaluator,
            np.concatenate([columns, fit.state_jacobian], axis=3),
            columns.shape[3],
            noise,
        )
        parameter_block = fisher_blocks.parameters.sum(axis=0)
        self.products, _ = compute_schur_complement(
            parameter_block, fisher_blocks.cross, fisher_blocks.states
        )
        # The columns are the q parameters, then the K candidates, and the residual as the last one.
        # So `[self.q : -1]` selects the candidates, and `[-1]` the residual.
        inner = slice(0, self.q)
        self.covariance = invert_scaled(parameter_block[inner, inner], self.products[inner, inner])
        cross_products = self.products[self.q : -1, : self.q]  # d'A
        self.projections = projections = cross_products @ self.covariance
        raw_powers = np.diagonal(self.products)[self.q : -1]  # d'd
        self.powers = np.maximum(
            raw_powers - np.einsum("kq,kq->k", projections, cross_products), 0.0
        )  # (1)
        # d'e - d'A (A'A)^-1 A'e
        gradients = self.products[self.q : -1, -1] - projections @ self.products[: self.q, -1]
        self.newton_steps = gradients / np.maximum(self.powers, 1e-300)  # (2)

    def compute_limits(self, prediction_half_widths: Mapping[str, float]) -> DetectionLimits:
        """Compute the detection limit of each coefficient, for the shape that is detected best.

        There are two kinds of effects:

        - Proportional effects: a shape is a choice of the effect's other coefficients, such as a
          frequency, and its direction is one candidate of index k. At its best shape, an effect
          may equal a simpler one that it contains; its next shape is used then. If all shapes
          equal simpler effects, the effect gets no limit.
        - Switching effects (a limit or backlash) do not change the runs in proportion to their
          size, so their detection limit is one of the sizes that were tried.

        Args:
            prediction_half_widths: half the 95 % interval of each parameter in a run that is not
                yet recorded, by name; passed on to the result.
        """
        # Indices of the shapes by effect and coefficient index, the most informative first.
        shapes_by_coefficient: dict[tuple[str, int], list[int]] = {}
        for k in np.argsort(-self.powers, kind="stable").tolist():
            probe = self.direction_set.candidates[k]
            if not probe.is_single_size:
                shapes_by_coefficient.setdefault(
                    (probe.effect, probe.coefficient_index), []
                ).append(k)
        best_shape = {key: shapes[0] for key, shapes in shapes_by_coefficient.items()}
        # Names in the order of the candidates; the directions of these effects have a fixed size.
        switching_effects = dict.fromkeys(
            probe.effect for probe in self.direction_set.candidates if probe.is_single_size
        )
        detection_limits = {}
        for (name, coefficient_index), shapes in shapes_by_coefficient.items():
            new_shapes = [
                k for k in shapes if not self._is_covered_by_simpler_effect(name, k, best_shape)
            ]
            if name not in switching_effects and new_shapes:
                detection_limits[name, self._get_coefficient_name(name, coefficient_index)] = (
                    self._compute_proportional_limit(new_shapes[0])
                )
        # The size of a limit or backlash is its first coefficient.
        for name in switching_effects:
            detection_limits[name, self._get_coefficient_name(name, 0)] = (
                self._compute_switching_limit(name)
            )
        return DetectionLimits(self.free, self.covariance, detection_limits, prediction_half_widths)

    def _get_coefficient_name(self, effect: str, coefficient_index: int) -> str:
        """Return the name of a coefficient of an effect.

        Args:
            effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
            coefficient_index: index of the coefficient within the effect.
        """
        return (
            self.evaluator.available_effects[effect]
            .on(self.evaluator.simulator.system)[coefficient_index]
            .name
        )

    def _compute_proportional_limit(self, k: int) -> DetectionLimit:
        """Return the detection limit of direction k, whose effect is proportional to its size.

        The limit is half the 95 % interval of the coefficient, 1.96 / sqrt(power) with the
        information (power) of eq. (1) of the module docstring. It is infinite if the data contain
        no information on the coefficient, and marked as unbounded if it exceeds all plausible
        values.

        Args:
            k: index of the direction.
        """
        power = self.powers[k]
        size = float(Z95 / np.sqrt(power)) if power > 0 else np.inf
        confounded_with = self._list_confounded_parameters(k)
        coefficient_index = self._get_coefficient_index(self.direction_set.candidates[k])
        low, high = self.evaluator.parameters[coefficient_index].bounds
        # The interval exceeds all plausible values, so the data say nothing about the coefficient.
        if 2.0 * size > MAX_INTERVAL_WIDTH * (high - low):
            return DetectionLimit(size, confounded_with=confounded_with, is_unbounded=True)
        return DetectionLimit(size, float(self.newton_steps[k]), confounded_with=confounded_with)

    def _get_coefficient_index(self, probe: CandidateDirection) -> int:
        return self.evaluator.get_coefficient_indices(probe.effect)[probe.coefficient_index]

    def _list_confounded_parameters(self, k: int) -> tuple[str, ...]:
        """Return the parameters of the model that together have nearly the same influence.

        `products` has the inner products of the columns of the least-squares problem: first the q
        parameters, then the candidates. Without the parameters, the information on candidate k
        would be its diagonal element i = q + k; with them only `powers[k]` remains. If the share
        that remains is above 1 - `CONFOUNDING_CORRELATION`^2, nothing is confounded with it.

        Args:
            k: Index of the candidate coefficient.

        Returns:
            Names in descending order of their contribution.
        """
        i = self.q + k
        # Nothing is confounded if the parameters leave most of the information.
        if self.powers[k] > (1.0 - CONFOUNDING_CORRELATION**2) * self.products[i, i]:
            return ()
        # Norm of each parameter's part in the direction of the candidate, relative to the largest.
        contributions = np.abs(self.projections[k]) * np.sqrt(np.diagonal(self.products)[: self.q])
        contributions /= max(float(contributions.max(initial=0.0)), 1e-300)
        order = np.argsort(-contributions).tolist()
        return tuple(self.free[j] for j in order if contributions[j] > MIN_CONFOUNDING_SHARE)

    def _is_covered_by_simpler_effect(
        self, name: str, k: int, best: Mapping[tuple[str, int], int]
    ) -> bool:
        """Return whether a simpler effect that this effect contains has an equivalent coefficient.

        Then both change the runs alike (their directions are nearly parallel), and a limit for the
        richer effect would only repeat that of the simpler one. The simpler effect may be absent,
        or it may be in the model.

        Args:
            name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
            k: index of the candidate direction of its coefficient.
            best: index of the candidate direction with the best shape, by effect and coefficient
                index.
        """
        simpler_effects = set(self.evaluator.available_effects[name].contains)
        # Columns of the least-squares problem: the fitted parameters, then the candidates.
        simpler_columns = [
            self.q + candidate
            for (effect, _), candidate in best.items()
            if effect in simpler_effects
        ]
        # A simpler effect in the model has columns among those of the fitted parameters.
        for effect in simpler_effects & set(self.evaluator.coefficient_slices):
            coefficient_indices = self.evaluator.get_coefficient_indices(effect)
            simpler_columns += [
                column
                for column, parameter_index in enumerate(self.free_indices)
                if parameter_index in coefficient_indices
            ]
        own_column = self.q + k
        for column in simpler_columns:
            norms = np.sqrt(self.products[own_column, own_column] * self.products[column, column])
            product = abs(self.products[own_column, column])
            if norms > 0 and product / norms > SAME_COEFFICIENT_CORRELATION:
                return True
        return False

    def _compute_switching_limit(self, name: str) -> DetectionLimit:
        """Return the detection limit of a limit or backlash, whose response is not linear.

        Directions of several fixed sizes of the effect were computed. A size is detectable if it
        changes the runs by at least `MIN_DETECTABLE_LIMIT_SIGMAS`, after the parameters of the
        model have absorbed what they can. The result is the largest detectable size of a limit
        (which has more influence the smaller it is), or the smallest one of backlash (which has
        more influence the larger it is); infinite if no size is detectable.

        Args:
            name: Name of the effect, with its place on a robot: ``drag.linear@elbow``.
        """
        sizes_and_candidates = sorted(
            (float(probe.coefficients[0]), k)
            for k, probe in enumerate(self.direction_set.candidates)
            if probe.effect == name and probe.is_single_size
        )
        detectable_sizes = [
            size
            for size, k in sizes_and_candidates
            if np.sqrt(self.powers[k]) >= MIN_DETECTABLE_LIMIT_SIGMAS
        ]
        # Information on a candidate before the parameters absorb a part of it.
        (_, smallest), (_, largest) = sizes_and_candidates[0], sizes_and_candidates[-1]
        information = np.diagonal(self.products)[self.q : -1]
        # It is a limit if the smallest size has more influence than the largest one; else a
        # backlash.
        if information[smallest] > information[largest]:
            return DetectionLimit(max(detectable_sizes, default=np.inf), limit="below")
        return DetectionLimit(min(detectable_sizes, default=np.inf), limit="above")
