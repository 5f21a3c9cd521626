"""Checks of a recording for conventions, units and signs that differ from those of the model."""

from __future__ import annotations

from bench.diagnosis.conventions.unit_check import Subject, find_imitated_unit, find_wrong_units
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.run_filtering import needs_nonlinear_filter
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns, list_free
from bench.diagnosis.pipeline.verdict_builder import build_causes
from bench.diagnosis.verdict import RecordingFault
from sims.core.simulator import InputError
from sims.recording.recording_description import read_meta

MAX_EXCESS_SHARE_WITH_RIGHT_UNITS = 0.1
"""Maximum excess over the noise, as a share of that of the base model, with right units."""
MAX_EXCESS_SHARE_OF_INCOMPLETE = 0.5
"""Maximum excess, likewise, of a model that stays incomplete with right units, too."""


class RecordingErrorCheck:
    """Checks for wrong units and signs, which effects would only imitate.

    Units of a robot are checked only after no effect has explained the gap, unless its free numbers
    could not be identified.

    Attributes:
        errors: the wrong units and signs; once there are some, causes are no longer searched.
    """

    def __init__(self) -> None:
        """Begin without errors."""
        self.errors: tuple[RecordingFault, ...] = ()

    def check_base(self, base: BaseModel) -> None:
        """Check the units by the fit of the base model, unless they are checked later."""
        if not (_is_checked_late(base.runs) or base.runs.context.search_control.is_over()):
            self.errors = _find_wrong_units(base)

    def check_result(self, result: SearchResult) -> None:
        """Check whether causes imitate a wrong unit, or whether one explains an open gap."""
        self.errors = _find_imitated_units(result) or self._find_in_unexplained(result)

    def _find_in_unexplained(self, result: SearchResult) -> tuple[RecordingFault, ...]:
        """Test for a wrong unit or sign of a robot's recording, if no effect explains the residual.

        Nothing is tested if the effects explain most of the discrepancy: with a wrong unit or sign
        they would not.

        Args:
            result: result of the search.

        Returns:
            The wrong units and signs; empty if all are right or if nothing was tested.
        """
        is_over = result.runs.context.search_control.is_over()
        # For the other recordings, units and signs were tested before the search.
        if not _is_checked_late(result.runs) or result.is_explained or is_over:
            return ()
        search, finding = result.search, result.finding
        # With a wrong unit or sign, effects would leave more of the discrepancy. A model that stays
        # incomplete leaves more of it in any case: no set of effects was found that explains all.
        max_share = (
            MAX_EXCESS_SHARE_OF_INCOMPLETE
            if finding.is_incomplete
            else MAX_EXCESS_SHARE_WITH_RIGHT_UNITS
        )
        # The excess is the RMS residual in units of the noise, minus one.
        base_excess = search.compute_excess_residual(search.base_model)
        if search.compute_excess_residual(finding.model) < max_share * base_excess:
            return ()
        return _find_wrong_units(result.searched_base)


def refuse_broken_conventions(runs: SimulatedRuns) -> None:
    """Refuse a robot's recording whose conventions differ from those of its model file.

    Conventions are signs, zeros, units and frames of the signals. The test compares forces of the
    linear model, so it is left out where contacts make these wrong, and with ``--force``.

    Args:
        runs: the prepared runs; those of a system that is not a robot are not tested.

    Raises:
        InputError: The conventions differ; the message names the change to make.
    """
    context, contacts, path = runs.context, runs.contacts, runs.recording.path
    if not runs.kind.has_model or context.options.force:
        return
    # These imports are needed for robots only.
    from bench.diagnosis.conventions.convention_comparison import ConventionComparison
    from bench.diagnosis.conventions.corrected_description import list_changed_tables

    context.search_control.begin_stage("comparing conventions of log and model")
    # The linear model is not valid at these contacts.
    if contacts.is_on_ground:
        return
    if contacts.has_contacts and needs_nonlinear_filter(runs):
        return
    subject = _make_subject(runs)
    differences = ConventionComparison(subject).differences()
    if not differences:
        return
    remedy = "correct these signals"
    # A recording with a description file: the message names the lines to change.
    if path.with_suffix(".toml").exists():
        _, meta = read_meta(path)
        lines = "; ".join(list_changed_tables(meta, runs.kind, differences))
        remedy = (
            f"set {lines} in {subject.file}, or write a corrected description: "
            f"simgap inspect {path.name} --fix NAME.toml"
        )
    description = "; ".join(difference.description for difference in differences)
    raise InputError(
        f"{path}: {description}; expected the conventions of the model file: {remedy} "
        "(--force explains the log as it is)"
    )


def _is_checked_late(runs: SimulatedRuns) -> bool:
    """Return whether units are checked only after no effect has explained the gap.

    This is the order for robots, except for a robot with free base parameters that a filter could
    not identify: a wrong unit may be the reason, so units are checked before the search, as for
    other systems.

    Args:
        runs: the runs, before or after the search.
    """
    if not runs.kind.has_model:
        return False
    has_base_parameters = bool(runs.fitting.base_indices.size)
    could_filter = runs.fitting.filtered_runs is not None
    failed_to_identify = could_filter and runs.context.identified is None
    return not (has_base_parameters and failed_to_identify)


def _make_subject(runs: SimulatedRuns) -> Subject:
    """Return the input of the unit check."""
    free = list_free(runs.kind, runs.context.options)
    return Subject(runs.kind, runs.recording, runs.engine, free)


def _find_wrong_units(base: BaseModel) -> tuple[RecordingFault, ...]:
    """Find a wrong unit or sign with which the base model explains the recording better."""
    runs = base.runs
    error = find_wrong_units(_make_subject(runs), runs.fitting, runs.noise, base.fit)
    return () if error is None else (error,)


def _find_imitated_units(result: SearchResult) -> tuple[RecordingFault, ...]:
    """Return wrong units and signs that the diagnosed causes imitate."""
    runs, search = result.runs, result.search
    errors = [
        find_imitated_unit(_make_subject(runs), runs.fitting, cause, search.base_model.fit)
        for cause in build_causes(result)
    ]
    return tuple(error for error in errors if error is not None)
