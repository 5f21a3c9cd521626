"""Run a diagnosis (`simgap explain`): from a recording to verdict, simulator and report."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

from bench.benchmark.isolation.resource_limits import limit_to_one_thread
from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.parameter_bounds import describe_unusual_values
from bench.diagnosis.evaluation.search_control import STAGES
from bench.diagnosis.experiment_design.next_run import NextRunDesign, design_next_run
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.explanation import Explanation
from bench.diagnosis.numerics_cause import (
    add_numerics_causes,
    list_option_causes,
    list_step_causes,
)
from bench.diagnosis.pipeline.base_model import (
    BaseModel,
    DivergingSimulationError,
    filter_and_fit,
    make_simulation_error,
)
from bench.diagnosis.pipeline.cause_search import CauseSearch
from bench.diagnosis.pipeline.convention_and_unit_checks import (
    RecordingErrorCheck,
    refuse_broken_conventions,
)
from bench.diagnosis.pipeline.extended_simulator_builder import build_extended_simulator
from bench.diagnosis.pipeline.recording_preparation import RecordingSource, prepare_runs
from bench.diagnosis.pipeline.report_data_builder import build_report_data
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.pipeline.segment_choice import (
    SEGMENT_DURATIONS,
    find_segment_duration,
    is_divisible,
    leave_out_jumps,
    loses_orientation,
)
from bench.diagnosis.pipeline.simulated_runs import DiagnosisContext, SimulatedRuns
from bench.diagnosis.pipeline.solver_option_choice import SolverOptionChoice
from bench.diagnosis.pipeline.time_step_choice import TimeStepChoice
from bench.diagnosis.pipeline.verdict_builder import build_verdict
from bench.diagnosis.verdict import Cause


class ExplanationAndDesign(NamedTuple):
    """Explanation, and the recording to make next; None if no run would add information."""

    explanation: Explanation
    design: NextRunDesign | None


def explain(
    recording: RecordingSource | Sequence[RecordingSource],
    options: ExplainOptions | None = None,
    **changes: Any,
) -> Explanation:
    """Explain a recording.

    Args:
        recording: Path of the table, or a recording in memory; the runs of several recordings are
            explained together.
        options: Options; None for the defaults in this process alone.
        changes: Single options that differ from `options`.

    Returns:
        Verdict, report data and extended simulator.

    Raises:
        InputError: The recording cannot be read or is too short, its simulator takes no effects, or
            the search was stopped before anything could be simulated.
    """
    with _diagnose(recording, replace(options or ExplainOptions(), **changes)) as diagnosis:
        return diagnosis.explanation


def explain_and_design(
    recording: RecordingSource | Sequence[RecordingSource],
    seconds: float,
    longest: float,
    options: ExplainOptions,
) -> ExplanationAndDesign:
    """Explain recordings, and design the next recording.

    Args:
        recording: See `explain`.
        seconds: Duration in seconds of the next recording.
        longest: Maximum duration in seconds, if `seconds` do not suffice.
        options: Options of the explanation.

    Returns:
        The explanation, and the design; None if no run would add information.
    """
    # The simulators stay open within the block.
    with _diagnose(recording, options) as diagnosis:
        diagnosis.result.runs.context.search_control.begin_stage("designing the next recording")
        # The run distinguishes the first cause that has alternatives. If there is none, it narrows
        # the parameters of the present model.
        result = diagnosis.result
        competing_models = result.list_models_with_alternatives()
        design = design_next_run(
            result.search, result.finding.model, competing_models, seconds, longest
        )
        return ExplanationAndDesign(diagnosis.explanation, design)


class _Diagnosis(NamedTuple):
    """Explanation of a recording, and the search that led to it."""

    explanation: Explanation
    result: SearchResult


@contextmanager
def _diagnose(
    recording: RecordingSource | Sequence[RecordingSource], options: ExplainOptions
) -> Iterator[_Diagnosis]:
    """Run a diagnosis, and again in ever shorter segments while the robot's simulation diverges.

    The motion of a robot that balances or flies is unstable without its controller. A simulation
    with the recorded commands and a wrong model leaves it within a second, but not within a short
    segment whose initial state is estimated. The same holds for a chaotic motion. The simulators
    are open within the `with` block.

    Args:
        recording: See `explain`.
        options: Options of the explanation.

    Raises:
        DivergingSimulationError: The simulation fails in the shortest segments, too.
    """
    sources = [recording] if isinstance(recording, RecordingSource) else list(recording)
    started = time.perf_counter()
    attempt = options
    # Durations of segments in s, the longest first.
    remaining_durations = list(SEGMENT_DURATIONS)
    while True:
        with (
            closing(ForkedWorkerPool(options.jobs or 1)) as worker_pool,
            closing(DiagnosisContext(attempt, worker_pool)) as context,
        ):
            runs = prepare_runs(sources, context)
            # Whether a further attempt is possible: shorter segments that the user did not set.
            may_divide = is_divisible(runs) and options.pieces is None and bool(remaining_durations)
            try:
                diagnosis = _diagnose_runs(runs, may_divide)
            except DivergingSimulationError as error:
                if not may_divide:
                    raise
                # Durations that the error says to be too long are not tried.
                remaining_durations = [
                    duration
                    for duration in remaining_durations
                    if duration <= error.longest_segment
                ]
            else:
                yield diagnosis
                return
        seconds = remaining_durations.pop(0)
        attempt = replace(options, pieces=seconds)
        # The time limit is that of all attempts together.
        if options.budget is not None:
            elapsed = time.perf_counter() - started
            attempt = replace(attempt, budget=max(options.budget - elapsed, 0.0))
        options.say(
            f"no simulation follows the runs: they are cut into pieces of {seconds:g} s, "
            "each with its own initial state (--pieces)"
        )


# With a thread per core, small matrix products take five times as long on a busy machine.
@limit_to_one_thread()
def _diagnose_runs(runs: SimulatedRuns, may_divide: bool) -> _Diagnosis:
    """Fit the base model, search for causes, and build the verdict and the report data.

    1. Refuse a recording whose conventions contradict the model file.
    2. Fit the base model, for a robot with the time step and solver options that the data support.
    3. Search for causes, and reconsider the step and the options with them.
    4. Build the explanation.

    Args:
        runs: the prepared runs.
        may_divide: whether the runs are cut into shorter segments if no simulation follows them.

    Raises:
        DivergingSimulationError: The runs have to be cut into shorter segments.
        InputError: The conventions of the recording contradict the model file, or no fit of the
            base model can simulate the recording.
    """
    # These objects keep what they find: wrong units, and numerical settings that differ from the
    # file.
    error_check = RecordingErrorCheck()
    step_choice, option_choice = TimeStepChoice(), SolverOptionChoice()
    # 1. Conventions.
    refuse_broken_conventions(runs)

    def fit_base(runs: SimulatedRuns) -> BaseModel:
        """Fit the base model; for a robot with the numerical settings that the data support.

        The fit ends early if the recording has wrong units, which are stored in `error_check`.

        Args:
            runs: the prepared runs.

        Raises:
            DivergingSimulationError: The runs amplify errors of the first state too much, and may
                be cut into shorter segments.
        """
        model = filter_and_fit(runs)
        error_check.check_base(model)
        if error_check.errors:
            return model
        if not runs.kind.has_model:
            return model.widen_ranges()
        # None if whole runs can be used.
        segment_duration = find_segment_duration(model) if may_divide else None
        if segment_duration is not None:
            raise DivergingSimulationError(
                f"{runs.recording.path}: the simulation amplifies errors of the first state",
                segment_duration,
            )
        # Another time step is only tried with the solver options of the model file.
        model = option_choice.choose(model)
        if option_choice.finding is None:
            model = step_choice.choose(model)
        return model.finish()

    # 2. Base model. Segments that it cannot follow, such as jumps on the ground, are left out.
    runs.context.search_control.begin_stage(STAGES["base_fit"])
    base = fit_base(runs)
    if not base.is_simulated:
        raise make_simulation_error(base, error_check.errors)
    if runs.contacts.is_on_ground:
        predictable_runs = leave_out_jumps(base.runs, base.fit.fit.simulated)
        if predictable_runs is not base.runs:
            base = fit_base(predictable_runs)
    if may_divide and loses_orientation(base):
        raise DivergingSimulationError(
            f"{runs.recording.path}: the simulation loses the orientation"
        )
    # 3. Causes.
    cause_search = CauseSearch(error_check)
    result = step_choice.reconsider(cause_search.search(base), cause_search)
    # Other solver options are only tried with the time step of the model file.
    if step_choice.finding is None:
        result = option_choice.reconsider(result, cause_search)
    # 4. Explanation.
    runs.context.search_control.begin_stage("measuring the gain")
    numerics_causes = [] if step_choice.finding is None else list_step_causes(step_choice.finding)
    if option_choice.finding is not None:
        numerics_causes += list_option_causes(option_choice.finding)
    return _Diagnosis(_build_explanation(result, numerics_causes), result)


def _build_explanation(result: SearchResult, numerics_causes: Sequence[Cause]) -> Explanation:
    """Build the verdict, the report data and the extended simulator.

    Args:
        result: result of the search.
        numerics_causes: wrong numerical settings of the model file.
    """
    verdict = add_numerics_causes(build_verdict(result), numerics_causes)
    runs, theta = result.runs, result.finding.model.fit.theta
    unusual_values = describe_unusual_values(runs.fitting, theta, runs.context.wider)
    notes = *unusual_values, *runs.context.notes
    report_data = build_report_data(result, verdict, notes)
    return Explanation(verdict, report_data, build_extended_simulator(result))
