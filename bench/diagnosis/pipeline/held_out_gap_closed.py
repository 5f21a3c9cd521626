"""Share of the gap that the causes, and single effects, close on held-out runs.

For the RMS errors b of the base model and a of a model with effects, and the noise floor n, it is

    closed = (b - max(a, n)) / (b - n)                                                         (1)

Its 95 % interval is by bootstrap over runs, or over segments of too few runs (D. N. Politis, J. P.
Romano 1992). `HeldOutGainCalculator` selects the channels that count and their noise floor;
`compute_held_out_gain` computes the share for given predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from bench.benchmark.statistics.bootstrap import INTERVAL_QUANTILES
from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import EffectNames
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.verdict import HeldOutResult, to_finite_or_none
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array

BOOTSTRAP_RESAMPLES = 2000
"""Number of bootstrap samples."""
SINGLE_RUN_SEGMENTS = 10
"""Number of segments into which a run is divided for resampling if there are too few runs."""
MIN_REPORTED_GAIN = -9.0
"""Lower limit of the reported share of the gap closed; for a failed model the exact value has no
meaning.
"""
MAX_NOISE_LIKE_ERROR_RATIO = 1.05
"""Maximum ratio of an error to the noise at which the error is taken for noise."""
MOTION_UNITS = ("m", "rad", "m/s", "rad/s")
"""Units of motion, one of which an error may have if the usual unit shows none."""


@dataclass(frozen=True, eq=False)
class HeldOutGainCalculator:
    """Calculator of the gains of predictions of held-out runs over that of the base model.

    Attributes:
        result: Result of the search, with the predicted runs.
    """

    result: SearchResult

    @cached_property
    def noise_sigma(self) -> Array:
        """Return the noise (C,) of each of C channels: stated by the recording, or else estimated.

        It is a standard deviation in the unit of the channel. The estimate assumes white noise, and
        autocorrelated noise exceeds it. So it is replaced by the residual of the found model, if
        that is larger and has no structure.
        """
        finding, floor = self.result.finding, self.result.runs.floor
        residual_sigma = finding.model.likelihood.sigma
        is_usable = ~floor.is_stated & np.isfinite(residual_sigma) & (residual_sigma > floor.sigma)
        has_no_structure = not finding.lack_of_fit.has_structure
        return np.where(is_usable & has_no_structure, residual_sigma, floor.sigma)

    @cached_property
    def _channels(self) -> list[int]:
        """Return the indices of the channels that count: those of one unit.

        Errors in different units cannot be added. The unit is that of the channel on which sensor
        effects act (the usual unit). If the base model predicts the channels with this unit to
        within the noise, it is the unit of motion with the largest error in units of the noise: the
        pose of a robot's base may not show what the encoder of a wheel shows.
        """
        evaluator = self.result.runs.fitting
        units = [channel.unit for channel in evaluator.simulator.channels]
        # Name of the channel on which sensor effects act.
        sensor_channel = evaluator.simulator.system.reading(evaluator.channels)
        usual_unit = units[evaluator.channels.index(sensor_channel)]
        indices_by_unit = {
            unit: [c for c, channel_unit in enumerate(units) if channel_unit == unit]
            for unit in units
            if unit in (usual_unit, *MOTION_UNITS)
        }
        # Predictions by the effects of their model; the base model has none, and the key ().
        runs, held_out_fits = self.result.runs.predicted, self.result.finding.held_out_fits or {}
        if runs is None or () not in held_out_fits:
            return indices_by_unit[usual_unit]
        before = held_out_fits[()].simulated
        # RMS error of the base model over the channels of each unit, relative to their noise.
        ratios = {
            unit: _compute_rmse(runs, before, channels) / compute_rms(self.noise_sigma[channels])
            for unit, channels in indices_by_unit.items()
        }
        unit_of_largest = max(ratios, key=lambda unit: ratios[unit])
        is_visible_elsewhere = (
            ratios[usual_unit] < MAX_NOISE_LIKE_ERROR_RATIO < ratios[unit_of_largest]
        )
        return indices_by_unit[unit_of_largest if is_visible_elsewhere else usual_unit]

    @property
    def _noise_floor(self) -> float:
        """RMS of the noise floor over the channels that count."""
        return compute_rms(self.noise_sigma[self._channels])

    def measure(self) -> HeldOutResult | None:
        """Measure by how much the causes improve the prediction of held-out runs.

        The error of a prediction falls from that of the base model towards the noise floor. If
        another time step or solver option was chosen, the error before is that of the base model
        with the settings of the model file.

        Returns:
            Errors and the share of the gap that is closed, with its interval; None if the
            prediction of the base model failed, or if no runs were predicted with both models.
        """
        runs, finding = self.result.runs.predicted, self.result.finding
        held_out_fits, names = finding.held_out_fits, finding.model.effects
        if runs is None or held_out_fits is None or names not in held_out_fits:
            return None
        # Predictions of the base model, which has no effects and the key (), and of the found one.
        before, after = held_out_fits[()].simulated, held_out_fits[names].simulated
        # Prediction with the settings of the model file, if others were chosen.
        if self.result.runs.before is not None:
            before = self.result.runs.before
        # Without a prediction of the base model there is no gap to measure.
        if not np.isfinite(before[np.isfinite(runs.observed)]).all():
            return None
        gain = self._compute_gain(runs, before, after, self.result.rng)
        # All channels that count have the unit of the first one.
        channel = self.result.runs.fitting.simulator.channels[self._channels[0]]
        # Fields of the gain in their order; an interval that the data do not give is None.
        base, extended, floor, share, low, high = map(to_finite_or_none, astuple(gain))
        return HeldOutResult(base, extended, floor, share, low, high, channel.unit)

    def _compute_gain(
        self, runs: RunEvaluator, before: Array, after: Array, rng: np.random.Generator
    ) -> HeldOutGain:
        """Compute the gain of a prediction over that of the base model.

        Shapes: R runs, T samples, C channels.

        Args:
            runs: the predicted runs.
            before: (R, T, C) prediction of the base model.
            after: (R, T, C) the other prediction.
            rng: source of the bootstrap samples.
        """
        # Cross-validated runs are too few to resample, so segments of them are resampled.
        by_segments = self.result.runs.is_cross_validated
        return compute_held_out_gain(
            runs, before, after, self._channels, self._noise_floor, rng, by_segments
        )

    def get_closed_share(self, names: EffectNames) -> float | None:
        """Return the share of the held-out gap that a model closes; None if it is not measured.

        The gap is the RMS error of the base model above the noise floor. The share is at most 1,
        and negative if the prediction becomes worse.

        Args:
            names: names of the effects of the model.
        """
        runs, held_out_fits = self.result.runs.predicted, self.result.finding.held_out_fits
        if runs is None or held_out_fits is None or names not in held_out_fits:
            return None
        floor = self._noise_floor
        # The base model has no effects, and the key ().
        before = _compute_rmse(runs, held_out_fits[()].simulated, self._channels)
        after = _compute_rmse(runs, held_out_fits[names].simulated, self._channels)
        return to_finite_or_none(float(compute_closed_share(before, after, floor)))

    def compute_share_intervals(self) -> dict[str, tuple[float, float]]:
        """Compute 95 % intervals of the share of the held-out gap that single effects close.

        The intervals are by bootstrap. An effect with a much worse prediction than the base model
        has none, because its share is set to the lower limit `MIN_REPORTED_GAIN`.

        Returns:
            Low and high end by effect, for effects that were simulated alone on held-out runs.
        """
        runs, held_out_fits = self.result.runs.predicted, self.result.finding.held_out_fits
        if runs is None or held_out_fits is None:
            return {}
        # The base model has no effects, and the key ().
        before = held_out_fits[()].simulated
        intervals = {}
        for names, held_out_fit in held_out_fits.items():
            share = self.get_closed_share(names)
            if len(names) != 1 or share is None or share <= MIN_REPORTED_GAIN:
                continue
            (effect,) = names
            # Each effect has its own random stream, so that its interval does not depend on the
            # others.
            rng = make_rng("held-out share", effect)
            result = self._compute_gain(runs, before, held_out_fit.simulated, rng)
            if np.isfinite(result.low) and np.isfinite(result.high):
                intervals[effect] = result.low, result.high
        return intervals


def _compute_rmse(evaluator: RunEvaluator, simulated: Array, channels: list[int]) -> float:
    """Compute the RMS error over the channels that count, in their unit.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        simulated: (R, T, C) simulated channels.
        channels: indices of the channels that count.
    """
    observed_mask = np.isfinite(evaluator.observed)[..., channels]
    error = (evaluator.observed - simulated)[..., channels][observed_mask]
    return compute_rms(error)


def compute_held_out_excess(result: SearchResult) -> float | None:
    """Compute the excess RMS residual of the base model on held-out runs; None without them.

    Args:
        result: Result of the search, with the predicted runs.

    Returns:
        RMS residual in units of the noise, less 1.
    """
    runs, held_out_fits = result.runs.predicted, result.finding.held_out_fits
    if runs is None or held_out_fits is None or () not in held_out_fits:
        return None
    sigma = result.runs.floor.sigma
    normalised_residual = (runs.observed - held_out_fits[()].simulated) / sigma
    return compute_rms(normalised_residual[np.isfinite(runs.observed)]) - 1.0


@dataclass(frozen=True)
class HeldOutGain:
    """RMS errors of two models on held-out runs, and the share of the gap closed.

    Attributes:
        base: RMS error of the base model, in the unit of the channels.
        extended: RMS error of the extended model.
        floor: RMS of the noise.
        gap_closed: Share of the gap closed, eq. (1) of the module docstring.
        low: Lower end of its 95 % interval; NaN if there is none.
        high: Upper end of its 95 % interval; NaN if there is none.
    """

    base: float
    extended: float
    floor: float
    gap_closed: float
    low: float
    high: float


def compute_held_out_gain(
    evaluator: RunEvaluator,
    before: Array,
    after: Array,
    channels: Sequence[int],
    floor: float,
    rng: np.random.Generator,
    resamples_segments: bool = False,
) -> HeldOutGain:
    """Compute the share of the gap closed, with a 95 % bootstrap interval over runs.

    With the RMS errors b of the base model and a of the extended model, and the noise floor n, the
    share is (b - max(a, n)) / (b - n) (1).

    Whole runs are drawn with replacement, because samples of one run depend on each other. With a
    single run, or on request, segments of the runs are drawn instead (D. N. Politis, J. P. Romano
    1992). A single segment gives no interval, as all resamples would be equal.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the held-out runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended model.
        channels: Indices of the channels that count; they share a unit.
        floor: RMS of the noise over these channels.
        rng: Random generator of the resampling.
        resamples_segments: Whether the bootstrap draws segments of the runs instead of whole runs;
            two or three runs are too few to draw from.

    Returns:
        Both errors, the share, and the ends of its interval, which are NaN without an interval.
    """
    # Each row is a part, a run or a segment, with the squared errors of both models and the number
    # of samples.
    sums = _sum_squared_errors(evaluator, before, after, channels, resamples_segments)
    rms_before, rms_after = _compute_rms_errors(sums.sum(axis=0))
    part_count = len(sums)
    # A resample draws as many parts as there are, with replacement.
    drawn_parts = rng.integers(part_count, size=(BOOTSTRAP_RESAMPLES, part_count))
    resampled = sums[drawn_parts].sum(axis=1)
    shares = compute_closed_share(*_compute_rms_errors(resampled), floor)
    low = high = np.nan
    if part_count > 1:
        low, high = np.quantile(shares, INTERVAL_QUANTILES).tolist()
    gap_closed = float(compute_closed_share(rms_before, rms_after, floor))
    return HeldOutGain(float(rms_before), float(rms_after), floor, gap_closed, low, high)


def _sum_squared_errors(
    evaluator: RunEvaluator,
    before: Array,
    after: Array,
    channels: Sequence[int],
    resamples_segments: bool,
) -> Array:
    """Sum up the squared errors of two models over each run or segment, for the bootstrap.

    The bootstrap draws rows and adds them, so that no error is computed again. Each row (n, 3) has
    the sum of squares of the base model, that of the extended model, and the number of samples.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: the predicted runs.
        before: (R, T, C) prediction of the base model.
        after: (R, T, C) prediction of the extended model.
        channels: indices of the channels that count.
        resamples_segments: whether the rows are segments of runs, because there are too few runs to
            resample.
    """
    part_sums = []
    for run, part in _list_resampled_parts(evaluator, resamples_segments):
        observed = evaluator.observed[run, part][:, channels]
        observed_mask = np.isfinite(observed)
        # A part without samples would be a row of zeros with an undefined error.
        if not observed_mask.any():
            continue
        errors = [
            (observed - simulated[run, part][:, channels])[observed_mask]
            for simulated in (before, after)
        ]
        part_sums.append([*(float(error @ error) for error in errors), float(observed_mask.sum())])
    return np.array(part_sums)


def _list_resampled_parts(
    evaluator: RunEvaluator, resamples_segments: bool
) -> list[tuple[int, slice]]:
    """List the parts that the bootstrap resamples: whole runs, or segments of too few runs.

    Whole runs are better, because neighbouring segments depend on each other.

    Args:
        evaluator: the predicted runs.
        resamples_segments: whether the parts are segments even if there are several runs.

    Returns:
        Index of the run and slice of its samples, for each part.
    """
    count = len(evaluator.prepared_runs)
    if count > 1 and not resamples_segments:
        return [(run, slice(None)) for run in range(count)]
    parts = []
    for run, length in enumerate(evaluator.lengths.tolist()):
        samples = np.linspace(0, length, SINGLE_RUN_SEGMENTS + 1).astype(int).tolist()
        # A run of few samples has empty segments.
        parts += [(run, slice(begin, end)) for begin, end in pairwise(samples) if end > begin]
    return parts


def _compute_rms_errors(sums: Array) -> tuple[Array, Array]:
    """Compute RMS errors before and after from sums (..., 3) of squares, and numbers of samples."""
    before, after, counts = np.moveaxis(sums, -1, 0)
    return np.sqrt(before / counts), np.sqrt(after / counts)


def compute_closed_share(base: Array | float, extended: Array | float, floor: float) -> Array:
    """Compute the share of the gap closed of any number of models; 0 without a gap.

    It is (base - max(extended, floor)) / (base - floor) (1), between `MIN_REPORTED_GAIN` and 1.

    Args:
        base: RMS errors of base models.
        extended: RMS errors of extended models, of the same shape.
        floor: RMS of the noise.
    """
    gap = base - floor
    # An error below the noise floor closes the gap, but no more.
    reached_error = np.maximum(extended, floor)
    with np.errstate(all="ignore"):
        share = (base - reached_error) / np.asarray(gap)  # (1)
    # A gap below rounding errors would give an arbitrary share, and a resample may have no gap.
    shares = np.where(gap > 1e-3 * floor, share, 0.0)
    return np.clip(shares, MIN_REPORTED_GAIN, 1.0)
