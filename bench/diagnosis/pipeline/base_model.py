"""Fit of the base model of a diagnosis: parameters, ranges, first states, discretisation error."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.fitting.base_fit import (
    BaseFit,
    find_start_with_tuner,
    fit_base_model,
    fit_wider,
)
from bench.diagnosis.identifiability import freeze_unidentified_parameters
from bench.diagnosis.pipeline.run_filtering import filter_simulated_runs
from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns
from bench.diagnosis.search.fit_starts import find_first_states
from sims.core.simulator import Array
from sims.recording.recorded_poses import ANGLES

MAX_ROTATION_ERROR = 0.5
"""Maximum error in rad of the simulated orientation of a floating body.

Beyond it, the effects of small changes are not linear.
"""
SEGMENT_DURATIONS = (1.0, 0.5, 0.25)
"""Durations in seconds of the segments that are tried if no simulation of whole runs succeeds."""
MAX_RUN_AMPLIFICATION = 1000.0
"""Maximum factor by which whole runs may amplify an error of their first positions."""
MAX_SEGMENT_AMPLIFICATION = 100.0
"""Maximum factor by which segments may amplify an error of their first positions."""
MIN_REFITTED_RESIDUAL = 1.05
"""Minimum RMS residual, in units of the noise, at which first states are fitted again."""
MIN_UNFOLLOWED_RESIDUAL = 3.0
"""Minimum RMS residual, in units of the noise, of whole runs that are cut into segments."""


@dataclass(frozen=True, eq=False)
class BaseModel:
    """Fitted base model of runs.

    Attributes:
        runs: the runs.
        fit: its fit.
    """

    runs: SimulatedRuns
    fit: BaseFit

    @property
    def is_simulated(self) -> bool:
        """Return whether the fitted model simulates all recorded samples."""
        is_recorded = np.isfinite(self.runs.fitting.observed)
        return bool(np.isfinite(self.fit.fit.simulated[is_recorded]).all())

    @property
    def is_usable(self) -> bool:
        """Return whether the fit succeeded, and the search need not end."""
        return not self.runs.context.search_control.is_over() and bool(
            np.isfinite(self.fit.fit.cost)
        )

    def join_names(self, indices: Iterable[int]) -> str:
        """Join the names of parameters with these indices in theta."""
        parameters = self.runs.fitting.parameters
        return ", ".join(parameters[i].name for i in sorted(indices))

    def rate(self) -> tuple[float, float]:
        """Rate the fit on the fitted runs.

        Returns:
            Twice the log-likelihood, and the RMS residual in units of the noise.
        """
        search = self.runs.create_search(self.fit)
        model = search.base_model
        return float(model.likelihood.value), 1.0 + search.compute_excess_residual(model)

    def predict_held_out(self) -> Array | None:
        """Predict the held-out runs; None without validation."""
        validation = self.runs.validation
        return None if validation is None else validation.validate([self.fit.fit])[0].simulated

    def refit(self, runs: SimulatedRuns) -> BaseModel:
        """Fit the base model to runs with other numerical settings.

        They change the best parameters only a little, so the fit starts from those of this fit,
        unless it failed or parameters were identified by prediction errors.
        """
        can_start_from_fit = np.isfinite(self.fit.fit.cost) and runs.context.identified is None
        initial_base = (
            self.fit.fit.theta[runs.fitting.base_indices]
            if can_start_from_fit
            else _get_starts(runs)
        )
        return BaseModel(runs, fit_base_model(runs.fitting, runs.noise, initial_base))

    def widen_ranges(self) -> BaseModel:
        """Widen the ranges of base parameters that the fit leaves at a bound."""
        with self.runs.record_widened_ranges():
            return replace(self, fit=fit_wider(self.runs.fitting, self.runs.noise, self.fit))

    def freeze_unidentified(self) -> BaseModel:
        """Freeze free numbers of a robot that the data cannot identify, at their nominal values.

        A note to the user names the frozen numbers. Systems that are not robots are not treated so:
        they have few parameters, and would have no result without them; there the verdict reports
        that they are not identified.
        """
        if not self.is_usable:
            return self
        runs = self.runs
        fit = freeze_unidentified_parameters(runs.fitting, runs.noise, self.fit, runs.create_search)
        if names := self.join_names(fit.unidentified_parameters):
            runs.context.say(
                "kept at the nominal value, because the recording does not identify it "
                f"together with the others: {names}"
            )
        return replace(self, fit=fit)

    def shows_step_errors(self) -> bool:
        """Return whether the recording shows the discretisation error of the engine's steps.

        The innovations of a Kalman filter show it. Without a filter of the runs this is not known,
        and true is returned.
        """
        runs = self.runs
        if runs.fitting.filtered_runs is None or not self.is_usable:
            return True
        # These imports are needed for robots only.
        from bench.diagnosis.kalman.linearised_filter import FollowedRuns
        from bench.diagnosis.prediction_error.regression_selection import shows_step_errors

        # The filter with the fitted parameters, which may be the stored one.
        theta = self.fit.fit.theta
        return shows_step_errors(FollowedRuns.get_or_follow(runs.fitting, theta, runs.noise))

    def correct_step_errors(self) -> BaseModel:
        """Return the base model without the discretisation error of the engine's steps.

        Effects would otherwise explain this error. It is corrected if the recording shows it, or if
        no filter could decide, unless it is too large. If a force is missing, such as that of a
        mass, it may imitate this error, so that the search decides later, with the force in the
        model.
        """
        # These imports are needed for robots only.
        from bench.diagnosis.evaluation.discretisation_error import correct_discretisation
        from bench.diagnosis.prediction_error.regression_selection import shows_step_errors

        evaluator = self.runs.fitting
        # The runs, followed by a Kalman filter; None if no filter could decide.
        followed = evaluator.filtered_runs
        if followed is not None and (followed.has_missing_force or not shows_step_errors(followed)):
            return self
        fit, noise = self.fit.fit, self.runs.noise
        # This stores the correction in the evaluator, unless the error is too large.
        correct_discretisation(evaluator, noise, fit.theta, fit.initial_states)
        if evaluator.discretisation_correction is None:
            return self
        return replace(self, fit=self.fit.refit(evaluator, noise))

    def finish(self) -> BaseModel:
        """Widen ranges, freeze unidentified numbers and correct the step error of a robot.

        The step is chosen before, because the correction hides the discretisation error.
        """
        return self.widen_ranges().freeze_unidentified().correct_step_errors()

    def refit_first_states(self) -> BaseModel:
        """Fit the first states again if the filter follows the runs and the simulation does not.

        First states are the initial positions and velocities of each run. A fit to whole runs from
        the readings may end in a local minimum. If the filter lacks no force, its first states are
        better starts.
        """
        runs, followed = self.runs, self.runs.fitting.filtered_runs
        if followed is None or followed.has_missing_force or not self.is_usable:
            return self
        _, residual_rms = self.rate()
        # The simulation follows the runs down to the noise.
        if residual_rms < MIN_REFITTED_RESIDUAL:
            return self
        start = find_first_states(runs.fitting, runs.noise, self.fit.fit)
        # No better first states were found.
        if start is None:
            return self
        return replace(self, fit=self.fit.refit(runs.fitting, runs.noise, start))

    def find_segment_duration(self) -> float | None:
        """Return the duration in seconds of segments that a simulation can follow.

        An unstable or chaotic motion amplifies the error of an estimated first state, until no
        simulation follows it. Shorter segments begin at new first states.

        Returns:
            The longest of `SEGMENT_DURATIONS` with a small amplification, or the shortest if none
            has one. None if whole runs can be used: the base model simulates them well, they
            amplify errors little, or no filter can tell.
        """
        followed = self.runs.fitting.filtered_runs
        if followed is None or not self.is_usable:
            return None
        _, residual_rms = self.rate()
        is_simulated = residual_rms < MIN_UNFOLLOWED_RESIDUAL
        if is_simulated or not followed.compute_amplification() > MAX_RUN_AMPLIFICATION:
            return None
        for seconds in SEGMENT_DURATIONS:
            if followed.compute_amplification(seconds) <= MAX_SEGMENT_AMPLIFICATION:
                return seconds
        return SEGMENT_DURATIONS[-1]

    def loses_orientation(self) -> bool:
        """Return whether a simulated floating body is far from its recorded orientation.

        Beyond a certain error a fit does not find back; the runs are then divided into shorter
        segments.
        """
        # Channels of the orientation, such as `q.base.yaw`.
        names = [
            f"q.{base_name}.{angle}"
            for base_name in self.runs.kind.system.base_orientations
            for angle in ANGLES
        ]
        evaluator = self.runs.fitting
        angle_channels = [c for c, name in enumerate(evaluator.channels) if name in names]
        errors = (self.fit.fit.simulated - evaluator.observed)[..., angle_channels]
        return bool(np.nanmax(np.abs(errors), initial=0.0) > MAX_ROTATION_ERROR)


def filter_and_fit(runs: SimulatedRuns) -> BaseModel:
    """Fit the base model; the runs of a robot are filtered before."""
    if runs.kind.has_model:
        filter_simulated_runs(runs)
    model = BaseModel(runs, fit_base_model(runs.fitting, runs.noise, _get_starts(runs)))
    return model.refit_first_states()


def _get_starts(runs: SimulatedRuns) -> Array | None:
    """Return starting values of the base parameters; None for the default starts.

    They come from a registered tuner, or are those identified by prediction errors.
    """
    options = runs.context.options
    if options.tuner is None:
        identified = runs.context.identified
        return None if identified is None else identified.base
    return find_start_with_tuner(options.tuner, runs.fitting, runs.noise, options.seed)
