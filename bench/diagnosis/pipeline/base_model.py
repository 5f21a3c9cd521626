"""Base model of a diagnosis: fit of its parameters, ranges and first states without causes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
from bench.diagnosis.verdict import RecordingFault
from sims.core.simulator import Array, InputError

MIN_REFITTED_RESIDUAL = 1.05
"""Minimum RMS residual, in units of the noise, at which first states are fitted again."""


class DivergingSimulationError(InputError):
    """Error if no simulation follows the runs, at any starting point of the base fit.

    Attributes:
        longest_segment: maximum duration in seconds of segments that a simulation may follow.
    """

    def __init__(self, message: str, longest_segment: float = np.inf) -> None:
        super().__init__(message)
        self.longest_segment = longest_segment


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

        Args:
            runs: the same runs, whose simulator has another time step or other solver options.
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

    def correct_step_errors(self) -> BaseModel:
        """Correct the discretisation error of the engine's steps, and refit the base model.

        Effects would otherwise explain this error. The model is returned as it is in three cases:

        * A Kalman filter of the runs found that a force is missing. The missing force may look like
          this error, so that the search decides later, with the force in the model.
        * The filter found no error of the steps.
        * The error is too large for a correction.

        Without a filter of the runs, the error is corrected in any case, unless it is too large.
        """
        # These imports are needed for robots only.
        from bench.diagnosis.evaluation.discretisation_error import correct_discretisation
        from bench.diagnosis.prediction_error.regression_selection import shows_step_errors

        evaluator = self.runs.fitting
        # The filtered runs; None if no filter is valid for them.
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
        # The search found no better first states.
        if start is None:
            return self
        return replace(self, fit=self.fit.refit(runs.fitting, runs.noise, start))


def filter_and_fit(runs: SimulatedRuns) -> BaseModel:
    """Fit the base model; the runs of a robot are filtered before."""
    if runs.kind.has_model:
        filter_simulated_runs(runs)
    model = BaseModel(runs, fit_base_model(runs.fitting, runs.noise, _get_starts(runs)))
    return model.refit_first_states()


def _get_starts(runs: SimulatedRuns) -> Array | None:
    """Return starting values of the base parameters; None for the default starts.

    They come from a registered tuner if the user names one; otherwise they are those identified by
    prediction errors, if there are any.

    Args:
        runs: the runs, with the options of the user and the identified parameters in their context.
    """
    options = runs.context.options
    if options.tuner is None:
        identified = runs.context.identified
        return None if identified is None else identified.base
    return find_start_with_tuner(options.tuner, runs.fitting, runs.noise, options.seed)


def make_simulation_error(base: BaseModel, errors: Sequence[RecordingFault]) -> InputError:
    """Return the error that explains why nothing could be simulated.

    Args:
        base: Base model whose fit failed.
        errors: Wrong units and signs of the recording, which may be the reason.
    """
    path = base.runs.recording.path
    if errors:
        return InputError(f"{path}: {errors[0].says}")
    if base.runs.context.search_control.is_over():
        return InputError(
            f"{path}: the search was stopped before the first fit of the recording was finished"
        )
    return DivergingSimulationError(
        f"{path}: the simulation fails at every starting point of the fit; "
        "check constants, units, inputs and initial states"
    )
