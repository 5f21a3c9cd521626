"""Recognise a wrong unit or a reversed sign of recorded signals before causes are searched.

A column in another unit than its description specifies is wrong by a known factor, which no effect
of the library should explain. Each hypothesis multiplies one signal, or several with the same
mistake, by such a factor k, or by -1; the base model is fitted again to the rescaled recording.
With e the excess RMS residual (the RMS of the residual in units of the noise, minus one), the
hypothesis holds if

    e(k) <= REMAINING e(1),    e(k) < e(k / STEP),    e(k) < e(k STEP)                          (1)

that is, if it removes most of the misfit, and if other factors do not fit as well. The remaining
residual may have other causes, which move the best factor a little. But if a factor within 4 % of k
leaves less than a third of it, the signal has a gain error instead: for example a gain of 6.0,
close to the 2 pi of turns. Parameters may absorb the scale of an input; then a factor of zero,
which switches the input off, must fit clearly worse. No hypothesis is tested unless the base model
misses some channel by more than `MIN_BASE_RESIDUAL_SHARE` of its standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from bench.diagnosis.conventions.signal_changes import SignalChange, change_signals
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import bound_of
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import (
    FIT_HORIZONS,
    BaseFit,
    compute_lowest_start_cost,
    fit_base_model,
)
from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from bench.diagnosis.verdict import Cause, RecordingFault
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, InputError
from sims.core.toml_validation import toml_key
from sims.core.user_messages import join_first_names
from sims.recording.recording import Recording
from sims.recording.recording_description import read_stated_columns
from sims.system_simulator import SystemSimulator

MIN_BASE_RESIDUAL_SHARE = 0.1
"""Minimum residual of the base model, as a share of the standard deviation of a channel, for which
units are checked. A gain error of 5 % stays below it.
"""
MAX_REMAINING_SHARE = 0.3
"""Maximum share of the misfit that remains with a correct unit."""
FACTOR_STEP = 1.25
"""Factor by which a hypothesis is changed to test whether another factor fits as well."""
SMALL_FACTOR_STEP = 1.04
"""Factor by which a hypothesis is changed a little, to test whether a factor that is not a unit
explains the data far better.
"""
MAX_NEARBY_SHARE = 1.0 / 3.0
"""Maximum share of a hypothesis's misfit that remains with a nearby factor that rejects it."""
MAX_RESIDUAL_SHARE = 0.2
"""Maximum residual that remains with a hypothesis, as a share of the standard deviation of a
channel.
"""
MIN_MOTION_SIGMAS = 3.0
"""Minimum standard deviation of a channel that moves, in units of its noise."""
MAX_EXPLAINED_RESIDUAL = 1.5
"""Maximum RMS residual, in units of the noise, at which a hypothesis explains the data, so that no
nearby factor is tested.
"""
MAX_EQUAL_RATIO = 1.05
"""Maximum ratio of two misfits that count as equal."""
MIN_DISTINCT_GAIN = 7.0
"""Minimum gain in twice the log-likelihood of a factor over others near it."""
OFF_FACTOR = 1e-6
"""Factor that switches an input off."""
MIN_RATIO_WITHOUT_INPUT = 3.0
"""Minimum ratio of the misfit without an input to the misfit with it."""
FITTED_HYPOTHESES = 2
"""Number of hypotheses that are fitted after each of two screenings: by the beginning of the runs,
and by the whole runs.
"""
SCREENED_HYPOTHESES = 12
"""Number of hypotheses that are simulated over whole runs: those that fit the beginning of the runs
best.
"""
UNCONVERGED_COST_RATIO = 2.0
"""Minimum ratio of the cost at the beginning of the runs to the largest accepted cost of whole runs
at which a hypothesis is rejected without fitting them. It exceeds 1 as that fit may not have
converged.
"""
CHECKED_CHANNELS = 3
"""Number of channels of a robot with the largest misfit whose joints are checked."""
GAIN_TOLERANCE = 0.02
"""Maximum relative difference between a fitted gain and a unit conversion that are taken as equal.
"""
MIN_SENSOR_GAIN = 0.2
"""Maximum magnitude of a fitted sensor gain at which the reading hardly depends on the simulation;
it is the lower bound of the gain's range.
"""

SCREENING_SHARE = FIT_HORIZONS[0].share
"""First fraction of each run, by which hypotheses are screened."""
MAX_NAMED_SIGNALS = 4
"""Maximum number of signals that a sentence names."""
PARAMETER_AT_BOUND_TEXT = "parameter {} lies beyond the bounds of its range"
"""Alternative explanation for a recording whose base fit ends at a bound."""
DEGREE_RAD = math.pi / 180.0
STANDARD_GRAVITY = 9.80665
UNITS: Mapping[str, Mapping[str, float]] = {
    "rad": {"rad": 1.0, "deg": DEGREE_RAD, "mrad": 1e-3, "turn": 2.0 * math.pi},
    "rad/s": {
        "rad/s": 1.0,
        "deg/s": DEGREE_RAD,
        "rpm": math.pi / 30.0,
        "turn/s": 2.0 * math.pi,
    },
    "rad/s^2": {"rad/s^2": 1.0, "deg/s^2": DEGREE_RAD},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "m/s^2": {"m/s^2": 1.0, "g_0": STANDARD_GRAVITY, "mm/s^2": 1e-3},
    "N": {"N": 1.0, "kgf": STANDARD_GRAVITY, "mN": 1e-3, "kN": 1e3},
    "N*m": {"N*m": 1.0, "kgf*m": STANDARD_GRAVITY, "N*cm": 1e-2, "mN*m": 1e-3, "kN*m": 1e3},
    "V": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "A": {"A": 1.0, "mA": 1e-3, "kA": 1e3},
}
"""Factors to the SI unit, by SI unit and by unit in which signals are often recorded."""
UNIT_SYSTEMS = (
    {"rad": "deg", "rad/s": "deg/s", "rad/s^2": "deg/s^2"},
    {"rad": "turn", "rad/s": "turn/s"},
    {"m": "mm", "m/s": "mm/s", "m/s^2": "mm/s^2"},
    {"m": "cm", "m/s": "cm/s"},
)
"""Sets of units that all signals of a log may share, by SI unit."""
UNITS_IN_WORDS = {
    "deg": "degrees",
    "deg/s": "degrees per second",
    "rad": "radians",
    "rad/s": "radians per second",
    "mrad": "milliradians",
    "turn": "turns",
    "turn/s": "turns per second",
    "rpm": "revolutions per minute",
    "m": "metres",
    "mm": "millimetres",
    "cm": "centimetres",
    "g_0": "multiples of standard gravity",
}
"""Names of units in words."""
SAME_UNIT_TOLERANCE = 1e-6
"""Relative difference of two factors up to which they are the same unit."""


@dataclass(frozen=True)
class DescribedSignal:
    """Recorded channel or input.

    Attributes:
        name: Name of the column.
        kind: Table of the signal in the description, ``channels`` or ``inputs``.
        si: SI unit that the simulator uses.
        specified_unit: Unit that the description specifies.
        gain: Factor from the values of the column to SI units.
        scale: Part of `gain` that the description specifies as a separate factor.
    """

    name: str
    kind: str
    si: str
    specified_unit: str
    gain: float
    scale: float = 1.0

    @property
    def signal_text(self) -> str:
        """Signal in words, such as ``channel q``."""
        return f"{self.kind.removesuffix('s')} {self.name}"


@dataclass(frozen=True)
class UnitHypothesis:
    """Hypothesis that the values of signals have another unit or sign than specified.

    Attributes:
        signals: Signals that are concerned.
        units: Actual units of their values; the specified units if only a factor is wrong.
        scale: Factor of all signals, in addition to that of the units.
    """

    signals: tuple[DescribedSignal, ...]
    units: tuple[str, ...]
    scale: float = 1.0

    def factors(self) -> dict[str, float]:
        """Return the factors by which the SI values have to be multiplied, by signal."""
        pairs = zip(self.signals, self.units, strict=True)
        return {s.name: self.scale * _get_unit_gain(s, unit) / s.gain for s, unit in pairs}

    def make_error(self, file: str, before: float | None, after: float | None) -> RecordingFault:
        """Return the hypothesis as a fault of the recording, with the lines that correct it.

        The lines are those of the description file (TOML), one for the table of each signal.

        Args:
            file: Name of the description file.
            before: RMS residual of the base model in units of the noise; None if not measured.
            after: RMS residual with the correction; None if not measured.
        """
        factors = self.factors()
        lines = []
        for signal, unit in zip(self.signals, self.units, strict=True):
            keys = []
            if unit != signal.specified_unit:
                keys.append(f'unit = "{unit}"')
            if self._get_corrected_scale(signal) != 1.0:
                keys.append(f"scale = {self._get_corrected_scale(signal):.9g}")
            lines.append(f"[{signal.kind}.{toml_key(signal.name)}] {', '.join(keys)}")
        return RecordingFault(
            signals=tuple(signal.name for signal in self.signals),
            factor=factors[self.signals[0].name],
            unit=self.units[0] if self.units[0] != self.signals[0].specified_unit else None,
            says=self._format_correction(file, factors),
            lines=tuple(lines),
            error_before=before,
            error_after=after,
        )

    def _get_corrected_scale(self, signal: DescribedSignal) -> float:
        """Return the key `scale` of a signal's table, including a factor already specified."""
        return self.scale * signal.scale

    def _format_correction(self, file: str, factors: Mapping[str, float]) -> str:
        """Write what seems wrong with a unit, sign or scale, and how the user corrects it.

        The cases are a reversed sign alone, a conversion that was made twice, and a wrong unit,
        whose sign may be reversed too. Several signals have the same mistake.

        Args:
            file: name of the description file.
            factors: factor by which the recorded values have to be multiplied, by signal; shown for
                a wrong unit.
        """
        first_signal, unit = self.signals[0], self.units[0]
        names = join_first_names([signal.signal_text for signal in self.signals], MAX_NAMED_SIGNALS)
        table = (
            f"[{first_signal.kind}.{first_signal.name}]"
            if len(self.signals) == 1
            else "the tables of each"
        )
        scale = f"set scale = {self._get_corrected_scale(first_signal):.9g} in {table} of {file}"
        if unit == first_signal.specified_unit and self.scale == -1.0:
            return f"The sign of {names} looks reversed: {scale}"
        if unit == first_signal.specified_unit:
            return f"The recorded numbers of {names} look converted twice: {scale}"
        sign_text = f"; the sign is reversed too: {scale}" if self.scale < 0 else ""
        unit_words, stated_words = (
            UNITS_IN_WORDS.get(unit_name, unit_name)
            for unit_name in (unit, first_signal.specified_unit)
        )
        unit_keys = dict.fromkeys(f'unit = "{unit_name}"' for unit_name in self.units)
        return (
            f"The recorded numbers of {names} look like {unit_words}, stated as {stated_words} "
            f"(factor {abs(factors[first_signal.name]):.4g}): set {' and '.join(unit_keys)} "
            f"in {table} of {file}{sign_text}"
        )


@dataclass(frozen=True)
class Subject:
    """Input of the unit check.

    Attributes:
        kind: Simulator class.
        recording: Whole recording, in the units that its description specifies.
        engine: Name of the engine; None for the simulator's own.
        free: Constants that are estimated with the parameters.
    """

    kind: type[SystemSimulator]
    recording: Recording
    engine: str | None
    free: tuple[str, ...] = ()

    @property
    def file(self) -> str:
        """Name of the description file."""
        return self.recording.path.with_suffix(".toml").name

    def signals(self, channels: Sequence[str]) -> tuple[DescribedSignal, ...]:
        """Return the recorded signals with the units that the description states.

        They are the signals whose units may be wrong.

        Args:
            channels: Names of the recorded channels.

        Returns:
            Channels, then inputs, with declared unit, recorded unit and conversion factors.
        """
        # Stated unit, gain and separate scale, by name of the signal.
        try:
            conversions = read_stated_columns(self.recording.path, self.kind)
        except InputError:
            # A recording made in memory has no description and is in SI units.
            conversions = {}
        recorded_names = {"channels": channels, "inputs": self.recording.runs[0].inputs}
        declared_signals = {"channels": self.kind.channels, "inputs": self.kind.inputs}
        signals = []
        for kind, names in recorded_names.items():
            for declared in declared_signals[kind]:
                if declared.name in names:
                    specified_unit, gain, scale = conversions.get(
                        declared.name, (declared.unit, 1.0, 1.0)
                    )
                    signals.append(
                        DescribedSignal(
                            declared.name, kind, declared.unit, specified_unit, gain, scale
                        )
                    )
        return tuple(signals)

    def rescale(self, factors: Mapping[str, float]) -> Recording:
        """Return the recording with signals multiplied by factors."""
        changes = {name: SignalChange(name, factor) for name, factor in factors.items()}
        return change_signals(self.recording, changes)

    @cached_property
    def noise_floor(self) -> Array:
        """Standard deviation of the noise of each channel (C,), in the specified units."""
        evaluator = self.evaluator(self.recording)
        sigma = compute_noise_floor(evaluator, self.recording).sigma
        evaluator.close()
        return sigma

    def evaluator(self, recording: Recording) -> RunEvaluator:
        """Return a run evaluator of a recording's runs for fitting, without any effects."""
        return RunEvaluator(
            self.kind, recording, recording.training(), self.engine, (), self.free, candidates=()
        )


def find_wrong_units(
    subject: Subject, evaluator: RunEvaluator, noise: NoiseModel, base: BaseFit
) -> RecordingFault | None:
    """Find the wrong unit or sign that explains nearly all of the misfit of the base model.

    The base model is the simulator with fitted parameters, without effects.

    1. Stop if the base model explains every channel well enough.
    2. Select promising hypotheses, which rescale some signals.
    3. Fit the base model again with each. A hypothesis is accepted if it removes most of the misfit
       and other factors do not.
    4. Of several, prefer the one with the fewest signals; state the others as alternatives.

    Args:
        subject: Recording and simulator to check.
        evaluator: Run evaluator of the runs for fitting.
        noise: Noise of each channel.
        base: Fitted base model.

    Returns:
        The fault; None if there is none, or no channel has a gross misfit.
    """
    # 1. Misfit of the base model.
    is_recorded = np.isfinite(evaluator.observed)
    residual = np.where(is_recorded, evaluator.observed - base.fit.simulated, 0.0)
    shares = _compute_residual_shares(evaluator, residual, noise)
    if not (shares > MIN_BASE_RESIDUAL_SHARE).any():
        return None
    # 2. Promising hypotheses.
    # RMS residual of the base model, in units of the noise; None is reported if it is infinite.
    before = _compute_residual_rms(residual, is_recorded, noise)
    known_before = before if np.isfinite(before) else None
    signals = subject.signals(evaluator.channels)
    hypotheses = list(_generate_hypotheses(signals, _list_suspected_parts(evaluator, shares)))
    # A residual of 1 is only noise, and the rest is the excess.
    max_excess = MAX_REMAINING_SHARE * (before - 1.0)
    after_by_hypothesis: dict[UnitHypothesis, float] = {}
    alternative_texts: list[str] = []
    # 3. Fits. `after` is the RMS residual with the hypothesis, in units of the noise.
    for hypothesis in _select_promising(subject, hypotheses):
        after, residual_share = _fit_rescaled(subject, hypothesis.factors(), 1.0 + max_excess)
        if after - 1.0 > max_excess or residual_share > MAX_RESIDUAL_SHARE:
            continue
        distinction = _test_distinctness(subject, hypothesis, after, int(is_recorded.sum()))
        if distinction != "none":
            after_by_hypothesis[hypothesis] = after
        # A parameter may have absorbed the scale of the input, and has then moved to a bound.
        if distinction == "absorbed":
            alternative_texts += _describe_parameters_at_bounds(evaluator, base.fit)
    if not after_by_hypothesis:
        return None
    # 4. Choice.
    return _make_simplest_error(subject, after_by_hypothesis, known_before, alternative_texts)


def _make_simplest_error(
    subject: Subject,
    after_by_hypothesis: Mapping[UnitHypothesis, float],
    before: float | None,
    alternative_texts: Sequence[str],
) -> RecordingFault:
    """Return the simplest of the hypotheses that fit about equally well, as a fault.

    Args:
        subject: Recording and simulator.
        after_by_hypothesis: RMS residual with each accepted hypothesis, in units of the noise.
        before: RMS residual of the base model, in units of the noise; None if unknown.
        alternative_texts: Further explanations of the misfit, which are stated as alternatives, as
            are the other hypotheses.
    """
    max_equal_misfit = MAX_EQUAL_RATIO * min(after_by_hypothesis.values())
    # The fewest signals first, and a wrong unit before one with an additional factor or sign.
    best, *others = sorted(
        (h for h, after in after_by_hypothesis.items() if after <= max_equal_misfit),
        key=lambda h: (len(h.signals), h.scale != 1.0),
    )
    other_texts = [
        other.make_error(subject.file, None, None).says
        for other in others
        # Hypotheses that differ only in the sign are not alternatives.
        if (other.signals, other.units) != (best.signals, best.units)
    ]
    return replace(
        best.make_error(subject.file, before, after_by_hypothesis[best]),
        alternatives=tuple(dict.fromkeys([*other_texts, *alternative_texts])),
    )


def find_imitated_unit(
    subject: Subject, evaluator: RunEvaluator, cause: Cause, base: TrajectoryFit
) -> RecordingFault | None:
    """Return the wrong unit or sign that a fitted gain of a sensor or an input probably is.

    The search for causes may explain a wrong unit as a gain error: a gain of 57.3 is degrees
    instead of radians. A gain that makes a reading nearly independent of the simulation is reported
    as a fault too.

    1. Find the signal that the gain scales.
    2. Compare the gain with the factors of all units.
    3. Test for a gain near zero.

    Args:
        subject: Recording and simulator to check.
        evaluator: Run evaluator of the runs for fitting.
        cause: Diagnosed cause.
        base: Fit of the base model; the gain may compensate for a parameter at a bound.

    Returns:
        The fault; None if the cause is not such a gain.
    """
    # 1. The signal.
    effect = cause.effect.partition("@")[0]
    if effect not in ("sensor.gain", "input.gain") or len(cause.coefficients) != 1:
        return None
    (coefficient,) = cause.coefficients.values()
    gain = 1.0 + coefficient.value
    signal_name = evaluator.available_effects[cause.effect].signal
    kind = "channels" if effect == "sensor.gain" else "inputs"
    signals = [s for s in subject.signals(evaluator.channels) if s.kind == kind]
    # A gain of zero is not a unit, and has no reciprocal.
    if not signals or not gain:
        return None
    if not signal_name and kind == "channels":
        # An effect without a signal acts on the default reading of the system.
        signal_name = evaluator.simulator.system.reading(evaluator.channels)
    signal = next((s for s in signals if s.name == signal_name), signals[0])
    # 2. Units.
    # Factor by which the recorded values have to be multiplied. The reading is the gain times the
    # true value, so the gain is undone; the actual input is the gain times the recorded one.
    factor = 1.0 / gain if kind == "channels" else gain
    alternatives = _describe_parameters_at_bounds(evaluator, base)
    for hypothesis in _generate_unit_hypotheses((signal,)):
        unit_factor = hypothesis.factors()[signal.name]
        if unit_factor * factor > 0 and abs(math.log(unit_factor / factor)) < GAIN_TOLERANCE:
            return replace(
                hypothesis.make_error(subject.file, None, None), alternatives=alternatives
            )
    # 3. A gain near zero.
    if kind == "channels" and abs(gain) <= MIN_SENSOR_GAIN:
        message = (
            f"The fit makes {signal.signal_text} nearly independent of the simulation "
            f"(a sensor gain of {coefficient.value:.4g}), which is not an answer: "
            f"check the unit, the column and the sign of {signal.signal_text} in {subject.file}"
        )
        return RecordingFault(
            signals=(signal.name,),
            factor=factor,
            unit=None,
            says=message,
            lines=(),
            error_before=None,
            error_after=None,
            alternatives=alternatives,
        )
    return None


def _get_unit_gain(signal: DescribedSignal, unit: str) -> float:
    """Return the factor from the values of a signal to SI units, if the values have this unit.

    Args:
        signal: recorded signal with its declared and recorded unit.
        unit: name of the unit.
    """
    if unit == signal.specified_unit:
        return signal.gain
    return signal.scale * UNITS[signal.si][unit]


def _describe_parameters_at_bounds(evaluator: RunEvaluator, fit: TrajectoryFit) -> tuple[str, ...]:
    """Return a clause for each parameter whose value in the base fit is at a bound of its range.

    Such a clause is stated as an alternative explanation of the misfit: the right value may lie
    outside the range.

    Args:
        evaluator: the runs, with the bounds of the parameters.
        fit: fit of the base model: parameters, initial states, simulated runs and derivatives.
    """
    parameters = [evaluator.parameters[index] for index in fit.free_indices.tolist()]
    values = fit.theta[fit.free_indices].tolist()
    return tuple(
        PARAMETER_AT_BOUND_TEXT.format(parameter.name)
        for parameter, value in zip(parameters, values, strict=True)
        if bound_of(value, *parameter.bounds) is not None
    )


def _compute_residual_shares(evaluator: RunEvaluator, residual: Array, noise: NoiseModel) -> Array:
    """Return the RMS residual beyond the noise, relative to each channel's deviation (C,).

    It is 0 for a channel that does not move beyond its noise. A large value means a gross misfit,
    as a wrong unit causes.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: run evaluator with the recorded runs.
        residual: (R, T, C) residual of the base model; zero where no sample exists.
        noise: noise of each channel.
    """
    residual_ratios = []
    for channel_index, sigma in enumerate(noise.sigma.tolist()):
        is_recorded = np.isfinite(evaluator.observed[..., channel_index])
        values = evaluator.observed[..., channel_index][is_recorded]
        # A channel may be recorded in held-out runs only.
        deviation = float(np.std(values)) if values.size else 0.0
        if not deviation > MIN_MOTION_SIGMAS * sigma:
            residual_ratios.append(0.0)
            continue
        # A failed simulation counts as an infinite residual.
        channel_residual = np.nan_to_num(residual[..., channel_index][is_recorded], nan=np.inf)
        mean_square = float(np.mean(channel_residual**2))
        # RMS residual beyond the noise.
        excess = max(mean_square - sigma**2, 0.0) ** 0.5
        residual_ratios.append(excess / deviation)
    return np.array(residual_ratios)


def _compute_residual_rms(residual: Array, is_recorded: Any, noise: NoiseModel) -> float:
    """Return the RMS of a residual over its samples, in units of the noise.

    It is 0 without samples, and infinite if a simulation failed.

    Shapes: R runs, T samples, C channels.

    Args:
        residual: (R, T, C) residual.
        is_recorded: (R, T, C) mask of the recorded samples.
        noise: noise of each channel.
    """
    scaled = (residual / noise.sigma)[is_recorded]
    rms = compute_rms(scaled) if scaled.size else 0.0
    return rms if np.isfinite(rms) else np.inf


def _list_suspected_parts(evaluator: RunEvaluator, shares: Array) -> frozenset[str] | None:
    """Return the joints and actuators of a robot whose signals may have a wrong unit or sign.

    These are the joints of the `CHECKED_CHANNELS` channels with the largest residual, and the
    actuators that drive them. For a system that is not a robot, the result is None: check all.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        shares: (C,) RMS residual of each of C channels, as a share of its standard deviation.
    """
    if not evaluator.kind.has_model:
        return None
    worst_channels = np.argsort(-shares)[:CHECKED_CHANNELS].tolist()
    # A channel is named after its joint, such as `q.elbow`: the part after the point.
    joints = {evaluator.channels[channel].partition(".")[2] for channel in worst_channels}
    kind: Any = evaluator.kind
    actuators = {actuator.name for actuator in kind.robot.actuators if actuator.joint in joints}
    return frozenset(joints | actuators)


def _generate_hypotheses(
    signals: Sequence[DescribedSignal], suspects: frozenset[str] | None
) -> Iterator[UnitHypothesis]:
    """Yield all hypotheses about wrong units and signs.

    1. One signal has another unit.
    2. All signals with one stated unit have another one.
    3. All signals are in another system of units, such as millimetres and degrees.
    4. The direction of a joint is reversed in all its signals.

    Args:
        signals: recorded channels and inputs.
        suspects: names of the joints and actuators to check; None for all.
    """
    # 1. Single signals.
    for signal in signals:
        if suspects is None or signal.name.partition(".")[2] in suspects:
            yield from _generate_unit_hypotheses((signal,))
    by_unit: dict[tuple[str, str, str], list[DescribedSignal]] = {}
    for signal in signals:
        by_unit.setdefault((signal.kind, signal.si, signal.specified_unit), []).append(signal)
    # 2. Common unit.
    for same_unit_signals in by_unit.values():
        if len(same_unit_signals) > 1:
            yield from _generate_unit_hypotheses(tuple(same_unit_signals))
    # 3. Systems of units.
    for units in UNIT_SYSTEMS:
        related_signals = [s for s in signals if s.si in units]
        # The values may be in this system instead of the specified units, or in SI units.
        for actual_units in (units, {si: si for si in units}):
            changed_signals = tuple(
                s for s in related_signals if s.specified_unit != actual_units[s.si]
            )
            # A single quantity is case 2.
            if len({s.si for s in changed_signals}) > 1:
                yield UnitHypothesis(
                    changed_signals, tuple(actual_units[s.si] for s in changed_signals)
                )
        # If the log was converted from this system twice, all signals have the same wrong factor,
        # which is that of the first one: deg, deg/s and deg/s^2 have one factor to their SI units.
        if len({s.si for s in related_signals}) > 1:
            si = related_signals[0].si
            specified_units = tuple(s.specified_unit for s in related_signals)
            yield UnitHypothesis(
                tuple(related_signals), specified_units, 1.0 / UNITS[si][units[si]]
            )
    # 4. Reversed joints.
    yield from _generate_reversed_joints(signals, suspects)


def _generate_unit_hypotheses(signals: tuple[DescribedSignal, ...]) -> Iterator[UnitHypothesis]:
    """Yield hypotheses that signals of one unit have another unit, a reversed sign, or both.

    Factors that undo a conversion that was made twice are tried as well, unless they equal that of
    a unit. For a quantity without known other units, these are 1000 and 1/1000.

    Args:
        signals: one signal, or several with the same stated unit.
    """
    # 1. Sign.
    first = signals[0]
    stated_units = (first.specified_unit,) * len(signals)
    yield UnitHypothesis(signals, stated_units, -1.0)
    # 2. Units, by their factors to the SI unit.
    units = UNITS.get(first.si, {})
    # The gain is the product of the factor of the stated unit and a stated `scale`.
    stated_gain = abs(first.gain / first.scale)
    tested_factors = {1.0}
    for unit, gain in units.items():
        if unit != first.specified_unit and not math.isclose(
            gain, stated_gain, rel_tol=SAME_UNIT_TOLERANCE
        ):
            yield UnitHypothesis(signals, (unit,) * len(signals))
            yield UnitHypothesis(signals, (unit,) * len(signals), -1.0)
            tested_factors.add(gain / stated_gain)
    # 3. Double conversions.
    double_conversions = [1.0 / gain for gain in units.values()] if units else [1e3, 1e-3]
    for factor in double_conversions:
        if not any(math.isclose(factor, known, rel_tol=GAIN_TOLERANCE) for known in tested_factors):
            yield UnitHypothesis(signals, stated_units, factor)
            yield UnitHypothesis(signals, stated_units, -factor)


def _generate_reversed_joints(
    signals: Sequence[DescribedSignal], suspects: frozenset[str] | None
) -> Iterator[UnitHypothesis]:
    """Yield hypotheses of joints with reversed direction: all their channels change sign.

    Only joints with several channels count; a single channel is tested as a single signal.

    Args:
        signals: recorded channels and inputs.
        suspects: names of the joints to check; None for all.
    """
    joints: dict[str, list[DescribedSignal]] = {}
    for signal in signals:
        quantity, _, joint = signal.name.partition(".")
        if signal.kind == "channels" and quantity in ("q", "qd", "tau"):
            joints.setdefault(joint, []).append(signal)
    for joint, joint_signals in joints.items():
        if len(joint_signals) > 1 and (suspects is None or joint in suspects):
            yield UnitHypothesis(
                tuple(joint_signals), tuple(s.specified_unit for s in joint_signals), -1.0
            )


def _select_promising(
    subject: Subject, hypotheses: Sequence[UnitHypothesis]
) -> list[UnitHypothesis]:
    """Select the hypotheses that are worth a fit, by their misfit without a fit.

    They are screened by the beginning of the runs, where wrong parameters matter least, and then by
    the whole runs. The best of both rankings are returned.

    Args:
        subject: recording with its simulator.
        hypotheses: hypotheses to select from.
    """

    def rank(hypotheses: Sequence[UnitHypothesis], share: float) -> list[UnitHypothesis]:
        """Sort hypotheses by their misfit in the first `share` of each run, smallest first.

        The recording is simulated with the starting values of the base fit; nothing is fitted here.

        Args:
            hypotheses: changes of units or signs of signals.
            share: fraction of each run that is simulated, from 0 to 1.
        """
        scores = []
        for hypothesis in hypotheses:
            evaluator, noise = _build_rescaled_evaluator(subject, hypothesis.factors())
            scores.append(compute_lowest_start_cost(evaluator, noise, share))
            evaluator.close()
        return [hypotheses[i] for i in np.argsort(scores, kind="stable").tolist()]

    best_at_beginning = rank(hypotheses, SCREENING_SHARE)[:SCREENED_HYPOTHESES]
    best_in_whole_runs = rank(best_at_beginning, 1.0)[:FITTED_HYPOTHESES]
    return list(dict.fromkeys([*best_at_beginning[:FITTED_HYPOTHESES], *best_in_whole_runs]))


def _build_rescaled_evaluator(
    subject: Subject, factors: Mapping[str, float]
) -> tuple[RunEvaluator, NoiseModel]:
    """Build the run evaluator of the rescaled recording, and white noise at its noise floor.

    Args:
        subject: Recording and simulator to check.
        factors: Factor of each signal that is rescaled, by name.

    Returns:
        The run evaluator, which the caller closes, and the noise with the standard deviation sigma
        (C,) of each of C channels and no autocorrelation.
    """
    evaluator = subject.evaluator(subject.rescale(factors))
    # The noise is scaled with its channel.
    scales = np.abs([factors.get(name, 1.0) for name in evaluator.channels])
    return evaluator, NoiseModel.make_white(subject.noise_floor * scales)


def _fit_rescaled(
    subject: Subject, factors: Mapping[str, float], max_rms: float = np.inf
) -> tuple[float, float]:
    """Fit the base model to the recording with some signals rescaled, and return its misfit.

    Args:
        subject: Recording and simulator to check.
        factors: Factor of each signal that is rescaled, by name.
        max_rms: Maximum RMS residual that is of interest, in units of the noise. If the beginning
            of the runs exceeds it, or `MAX_RESIDUAL_SHARE`, both results are infinite.

    Returns:
        RMS residual in units of the noise, and the largest residual of a channel beyond the noise
        as a share of the channel's standard deviation.
    """
    evaluator, noise = _build_rescaled_evaluator(subject, factors)
    is_recorded = np.isfinite(evaluator.observed)
    # A fit that exceeds this cost at the beginning of the runs is not continued.
    max_cost = np.inf
    if np.isfinite(max_rms):
        max_cost = UNCONVERGED_COST_RATIO * _compute_max_cost(evaluator, noise, max_rms)
    fit = fit_base_model(evaluator, noise, max_cost=max_cost).fit
    residual = np.where(is_recorded, evaluator.observed - fit.simulated, 0.0)
    evaluator.close()
    return _compute_residual_rms(residual, is_recorded, noise), float(
        _compute_residual_shares(evaluator, residual, noise).max()
    )


def _compute_max_cost(evaluator: RunEvaluator, noise: NoiseModel, max_rms: float) -> float:
    """Return the largest cost (sum of squared residuals in units of the noise) of a useful fit.

    A fit with a larger cost explains the recording too badly, and need not be finished. The result
    is the smaller one of two limits: that of the RMS residual of all channels together, and the sum
    of the limits of all channels, which is infinite if a channel hardly moves, because such a
    channel has no limit.

    Args:
        evaluator: Run evaluator of the rescaled recording.
        noise: White noise of each channel.
        max_rms: Maximum RMS residual in units of the noise. The residual of each channel beyond its
            noise is limited to `MAX_RESIDUAL_SHARE` of its standard deviation.
    """
    is_recorded = np.isfinite(evaluator.observed)
    max_squares = 0.0
    for channel_index, sigma in enumerate(noise.sigma.tolist()):
        values = evaluator.observed[..., channel_index][is_recorded[..., channel_index]]
        deviation = float(np.std(values)) if values.size else 0.0
        is_moving = deviation > MIN_MOTION_SIGMAS * sigma
        # Largest RMS residual of the channel beyond its noise.
        excess = MAX_RESIDUAL_SHARE * deviation if is_moving else np.inf
        # Squares of the excess and of the noise add.
        max_squares += values.size * ((excess / sigma) ** 2 + 1.0) if values.size else 0.0
    return min(max_rms**2 * float(is_recorded.sum()), max_squares)


def _test_distinctness(
    subject: Subject, hypothesis: UnitHypothesis, after: float, samples: int
) -> Literal["sharp", "absorbed", "none"]:
    """Test whether a hypothesis fits clearly better than nearby factors.

    The hypothesis is that signals have another unit or sign, so that their values have to be
    multiplied by a factor k. A wrong unit has one exact factor k. If other factors fit as well, the
    misfit has another reason. With the RMS residual e(k), the condition is e(k) < e(k / s) and e(k)
    < e(k s), with the step s = `FACTOR_STEP`. The tests are:

    1. A reversed sign has no nearby factors.
    2. A factor within 4 % of k that fits much better means a gain error.
    3. Clearly different factors must fit worse.
    4. Parameters may absorb the scale of an input. Then a factor of zero must fit clearly worse.

    Args:
        subject: Recording and simulator to check.
        hypothesis: Hypothesis to test.
        after: RMS residual with the hypothesis, in units of the noise.
        samples: Number of recorded values of all channels.

    Returns:
        ``sharp`` if no nearby factor fits as well; ``absorbed`` if parameters absorb the scale of
        an input, but its unit can be recognised; ``none`` otherwise.
    """

    def residual_with_factor(step: float) -> float:
        """Return the RMS residual if the signals are multiplied by `step` in addition."""
        factors = {name: step * k for name, k in hypothesis.factors().items()}
        rms, _ = _fit_rescaled(subject, factors)
        return rms

    # 1. Sign.
    if hypothesis.scale == -1.0 and hypothesis.units == tuple(
        s.specified_unit for s in hypothesis.signals
    ):
        return "sharp"
    # 2. Gain error.
    if after > MAX_EXPLAINED_RESIDUAL:
        nearby_residual = min(
            residual_with_factor(1.0 / SMALL_FACTOR_STEP), residual_with_factor(SMALL_FACTOR_STEP)
        )
        if nearby_residual - 1.0 < MAX_NEARBY_SHARE * (after - 1.0):
            return "none"
    # 3. Clearly different factors.
    nearby_residual = min(
        residual_with_factor(1.0 / FACTOR_STEP), residual_with_factor(FACTOR_STEP)
    )
    # Gain in twice the log-likelihood, which for white noise is -n log(RMS residual squared), up to
    # a constant.
    gain = 2.0 * samples * math.log(nearby_residual / after)
    if gain > MIN_DISTINCT_GAIN:
        return "sharp"
    # 4. Absorbed scale. The unit is still recognised if the input has an influence, and nearby
    # factors do not fit clearly better. A factor that is not a unit cannot be recognised for an
    # input of arbitrary scale.
    is_input_unit = hypothesis.scale == 1.0 and all(
        signal.kind == "inputs" for signal in hypothesis.signals
    )
    is_absorbed = (
        is_input_unit
        and nearby_residual * MAX_EQUAL_RATIO > after
        and residual_with_factor(OFF_FACTOR) > MIN_RATIO_WITHOUT_INPUT * after
    )
    return "absorbed" if is_absorbed else "none"
