"""Run a diagnosis (`simgap explain`): from a recording to verdict, simulator and report."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from bench.benchmark.runner.worker_pools import limit_to_one_thread
from bench.core.random_streams import make_rng
from bench.diagnosis.conventions.unit_check import Subject, find_imitated_unit, find_wrong_units
from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.noise_floor import (
    INTEGRATION_ERROR_SHARE,
    NoiseFloor,
    add_minimal_noise,
    compute_noise_floor,
)
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import IdentifiedParameters, RunEvaluator
from bench.diagnosis.evaluation.search_control import STAGES, SearchStoppedError
from bench.diagnosis.experiment_design.next_run import NextRunDesign, design_next_run
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.explanation import Explanation
from bench.diagnosis.fitting.base_fit import (
    FINAL_ITERATIONS,
    BaseFit,
    Bounds,
    correct_discretisation,
    describe_unusual_values,
    fit_base_model,
    fit_wider,
    use_bounds,
)
from bench.diagnosis.fitting.fitted_models import MAX_ITERATIONS, FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.friction_form_verdict import has_dry_friction, is_likelier_soft, make_soft_kind
from bench.diagnosis.identifiability import freeze_unidentified_parameters
from bench.diagnosis.numerics_cause import (
    CoarseStepFinding,
    OptionFinding,
    RatedOptions,
    Reusable,
    RunEvaluators,
    add_numerics_causes,
    is_finer_model_better,
    is_finer_step_better,
    list_option_causes,
    list_step_causes,
)
from bench.diagnosis.report_data_builder import DiagnosisReportDataBuilder
from bench.diagnosis.search.diagnose import DiagnosisResult, answer, diagnose
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit, list_hat_effects
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from bench.diagnosis.validation.held_out_runs import CrossValidation, HeldOutRuns, Validation
from bench.diagnosis.verdict import RecordingFault
from bench.diagnosis.verdict_builder import VerdictBuilder
from bench.logs.importing.sample_selection import leave_out_settling, thin_recording
from bench.logs.quality.clock_checks import check_recording_plausible
from bench.logs.recording_loading import check_recording_size, load_joined
from bench.logs.segmentation import segment_recording
from bench.pages.text_format import joined
from sims import extended_simulator as extend
from sims.core.simulator import Array, InputError, Simulator
from sims.extended_simulator import ExtendedSimulator
from sims.recording.recorded_poses import ANGLES
from sims.recording.recording import Recording, Run
from sims.recording.recording_description import read_meta
from sims.system_simulator import SystemSimulator

SOFT_FRICTION = (
    "dry friction has MuJoCo's soft form (solreffriction and solimpfriction of the model file): "
    "it fits better than stiff friction"
)
"""Message to the user when dry friction changes to the soft form."""
STIFF_FRICTION = "soft dry friction does not close the gap either: stiff friction is used"
"""Message to the user when dry friction changes back to the stiff form."""
if TYPE_CHECKING:
    from bench.diagnosis.evaluation.solver_options import StepRefinement
    from bench.diagnosis.kalman.candidate_responses import FollowedRuns

MIN_SAMPLES_PER_UNKNOWN = 2.0
"""Minimum number of samples for fitting per unknown."""
MIN_EXTRA_SAMPLES = 4
"""Minimum number of samples for fitting in addition to `MIN_SAMPLES_PER_UNKNOWN` per unknown."""
MAX_CHANNEL_SIZE_FACTOR = 1e9
"""Recorded values of at least this multiple of a channel's typical size are refused."""
MAX_EXCESS_SHARE_WITH_RIGHT_UNITS = 0.1
"""Maximum excess over the noise, as a share of that of the base model, with right units."""
MAX_EXCESS_SHARE_OF_INCOMPLETE = 0.5
"""Maximum excess, likewise, of a model that stays incomplete with right units, too."""
MAX_FORCE_SHARE_AT_CONTACTS = 1.0
"""Maximum missing force of a filter, as a share of the typical force, if the robot has contacts."""
CONTACT_SEGMENT_SECONDS = 0.5
"""Duration in seconds of the segments of a robot on the ground."""
MAX_RESIDUAL_RATIO = 1.25
"""Maximum residual (RMS) of a segment without a jump, relative to the median of all segments."""
MAX_LEFT_OUT_SHARE = 0.25
"""Maximum share of the segments that are left out because of jumps."""
MAX_LINEAR_RESIDUAL = 3.0
"""Maximum residual of the base model, in units of the noise, at which effects act linearly."""
MAX_COMPETING_SQUARES_RATIO = 2.0
"""Maximum sum of squares of an effect that competes with other options, relative to theirs."""
MIN_COMPETING_GAIN_SHARE = 0.7
"""Minimum gain of an effect that competes with other options, relative to theirs, near the noise.

Gains are in twice the log-likelihood, and those of effects to first order.
"""
MAX_OPTION_ROUNDS = 3
"""Maximum number of options of the solver that are changed."""
MAX_FITTED_OPTIONS = 3
"""Maximum number of alternative options that are fitted in a round."""
RETRIED_SEGMENTS = (1.0, 0.5, 0.25)
"""Durations in seconds of the segments that are tried if no simulation of whole runs succeeds."""
MAX_SUBSET_EFFECTS = 3
"""Maximum number of effects of which all subsets are fitted with another time step."""
REFIT_ITERATIONS = 8
"""Maximum number of steps of the fit of more effects with another time step."""
MAX_ROTATION_ERROR = 0.5
"""Maximum error in rad of the simulated orientation of a floating body.

Beyond it, the effects of small changes are not linear.
"""
EXPLAINED_VERDICTS = ("adequate", "named", "ambiguous")
"""Verdicts for which the model explains the data down to the noise."""
RecordingSource: TypeAlias = str | Path | Recording
_Result = TypeVar("_Result")


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
    return _run_in_segments(
        recording, replace(options or ExplainOptions(), **changes), _ExplainRun.run
    )


def _is_on_ground(kind: type[SystemSimulator]) -> bool:
    """Return whether a simulator is a robot with a recorded pose that stands or drives."""
    robot: Any = kind
    return kind.has_model and bool(robot.robot.is_on_ground)


class DivergingSimulationError(InputError):
    """Error if no simulation follows the runs, at any starting point of the base fit."""


def _run_in_segments(
    recording: RecordingSource | Sequence[RecordingSource],
    options: ExplainOptions,
    action: Callable[[_ExplainRun], _Result],
) -> _Result:
    """Run a diagnosis, and again in ever shorter segments while the robot's simulation diverges.

    The motion of a robot that balances or flies is unstable without its controller. A simulation
    with the recorded commands and a wrong model leaves it within a second, but not within a short
    segment whose initial state is estimated.

    Args:
        recording: See `explain`.
        options: Options of the explanation.
        action: Runs the diagnosis.

    Raises:
        DivergingSimulationError: The simulation fails in the shortest segments, too.
    """
    started, attempt, retried = time.perf_counter(), options, list(RETRIED_SEGMENTS)
    while True:
        with _explain_run(recording, attempt) as run:
            run.may_divide = run.is_divisible and options.pieces is None and bool(retried)
            try:
                return action(run)
            except DivergingSimulationError:
                if not run.may_divide:
                    raise
                seconds, elapsed = retried.pop(0), time.perf_counter() - started
                budget = None if options.budget is None else max(options.budget - elapsed, 0.0)
                attempt = replace(options, pieces=seconds, budget=budget)
                options.say(
                    f"no simulation follows the runs: they are cut into pieces of {seconds:g} s, "
                    "each with its own initial state (--pieces)"
                )


@contextmanager
def _explain_run(
    recording: RecordingSource | Sequence[RecordingSource], options: ExplainOptions
) -> Iterator[_ExplainRun]:
    """Create a diagnosis and its worker pool for a `with` block, and close both at its end.

    Args:
        recording: source of the recording, or of several logs that are explained together.
        options: options of the diagnosis.
    """
    sources = [recording] if isinstance(recording, RecordingSource) else list(recording)
    with (
        closing(ForkedWorkerPool(options.jobs or 1)) as worker_pool,
        closing(_ExplainRun(sources, options, worker_pool)) as run,
    ):
        yield run


def _format_added_noise(channels: Sequence[str]) -> str:
    """Return the message about channels to which noise was added; empty if there are none."""
    if not channels:
        return ""
    return (
        f"no noise is found in {joined(channels)}: white noise of {INTEGRATION_ERROR_SHARE:g} of "
        "the range is added, the accuracy of a simulation; smaller differences are not explained"
    )


class ExplanationAndDesign(NamedTuple):
    """Explanation, and the recording to make next; None if no run would add information."""

    explanation: Explanation
    design: NextRunDesign | None


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
    """

    def run_and_design(run: _ExplainRun) -> ExplanationAndDesign:
        explanation = run.run()
        run.search_control.begin_stage("designing the next recording")
        return ExplanationAndDesign(explanation, run.design(seconds, longest))

    return _run_in_segments(recording, options, run_and_design)


def _without_inactive_drives(recording: Recording, kind: type[Simulator]) -> Recording:
    """Switch off or leave out the samples of a robot in which its drives have no effect.

    Args:
        recording: the recording.
        kind: class of the simulator.
    """
    if not kind.has_model:
        return recording
    # This import is needed for robots only.
    from bench.diagnosis.prediction_error.inactive_drives import remove_inactive_drives

    return remove_inactive_drives(recording, kind)


def _rate_model(search: EffectSearch, model: FittedModel) -> tuple[float, float]:
    """Return the penalised log-likelihood and the excess RMS residual of a fitted model.

    Args:
        search: search with the noise that defines the excess.
        model: the fitted model.
    """
    return model.penalised_log_likelihood, search.compute_excess_residual(model)


class _SearchResult(NamedTuple):
    """Search result: base model, search, finding and random generator."""

    base: BaseFit
    search: EffectSearch
    finding: DiagnosisResult
    rng: np.random.Generator


class _ExplainRun:
    """One diagnosis: its recording and options, and the state that its steps share."""

    def __init__(
        self,
        sources: Sequence[RecordingSource],
        options: ExplainOptions,
        worker_pool: ForkedWorkerPool,
    ) -> None:
        """Load and check the recording, and build the run evaluators, before any fit.

        The steps are: read the logs, check the plausibility, thin the samples, leave out the first
        samples while actuator filters settle, split the runs into segments, and give channels
        without noise a small one. Every change is reported to the user with `say` and kept in
        `notes`.

        Raises:
            InputError: The recording or the simulator cannot be used for a diagnosis.
        """
        self.started = time.perf_counter()
        self.seed = options.seed
        self.tuner = options.tuner
        self.say = say = options.say
        self.notes: tuple[str, ...] = ()
        self.force = force = options.force
        self.thorough = options.thorough
        self.search_control = options.make_search_control()
        self.worker_pool = worker_pool
        self.recording, kind = load_joined(
            sources,
            options.system,
            options.model,
            options.free,
            _without_inactive_drives,
            options.fix_base,
        )
        self.path = self.recording.path
        if not issubclass(kind, SystemSimulator):
            raise self._make_no_effects_error()
        # Effects that are part of the simulator already could not be chosen again.
        extend.check_not_extended(kind)
        # A simulator with its own integrator has no choice of engine.
        usual = kind.default_engine if kind.has_model else None
        self.engine = usual if kind.own_engine else options.engine
        # A free number of a robot is a number of its model file, and so a parameter of its
        # simulator.
        self.free = () if kind.has_model else tuple(options.free)
        kind = self._add_contact_effects(kind)
        # This check precedes the run evaluators, which plan every step of every run.
        for anomaly in check_recording_plausible(self.recording, kind, force):
            say(f"{self.path}: {anomaly}")
        self._prepare_recording(kind, options)
        check_recording_size(self.recording, kind(engine=self.engine), force)
        # By name, the declared range of a base parameter and the wider range that replaced it.
        self.wider: dict[str, tuple[Bounds, Bounds]] = {}
        # Base parameters of a robot, identified by prediction errors; starting values of the fit.
        self.identified: IdentifiedParameters | None = None
        self._filtered: FollowedRuns | None = None
        self._set_up(kind)
        if self.is_on_ground and self._leave_out_unpredictable_runs():
            self._set_up(kind)
        self._add_notes(
            f"{effect} is not tested: {reason}" for effect, reason in kind.system.left_out.items()
        )
        self.coarse: CoarseStepFinding | None = None
        # Options of the solver that replace those of the file, and those that may replace them.
        self.changed_options: OptionFinding | None = None
        self.possible_options: RatedOptions | None = None
        # Finer steps than the file's, and the run evaluators with the file's step if one is used.
        self.finer: Reusable[StepRefinement] | None = None
        self.file = RunEvaluators(self.kind, self.fitting, self.validation)
        self.found: tuple[EffectSearch, DiagnosisResult] | None = None
        # Whether the runs are cut into shorter pieces if no simulation follows them.
        self.may_divide = False
        self.unit_errors: tuple[RecordingFault, ...] = ()
        self._check_recording()

    def _prepare_recording(self, kind: type[SystemSimulator], options: ExplainOptions) -> None:
        """Thin and split the runs, leave out their settling, and add noise where there is none.

        The recording is replaced, and each change is noted.

        Args:
            kind: class of the simulator.
            options: options of the diagnosis: duration of segments, and whether runs stay whole.
        """
        self.recording, thinning_note = thin_recording(self.recording, kind)
        self.recording, settling_note = leave_out_settling(self.recording, kind)
        self.recording, segment_note = segment_recording(
            self.recording, kind, self._get_segment_duration(kind, options), options.whole
        )
        recorded = self.recording.runs[0].channels
        names = [channel.name for channel in kind.channels if channel.name in recorded]
        self.recording, noise_free_channels = add_minimal_noise(self.recording, names)
        noise_note = _format_added_noise(noise_free_channels)
        notes = thinning_note, settling_note, segment_note, noise_note
        self._add_notes(note for note in notes if note)

    def _get_segment_duration(
        self, kind: type[SystemSimulator], options: ExplainOptions
    ) -> float | None:
        """Return the duration in seconds of the segments of each run; None for the usual ones.

        Runs of a robot on the ground are cut unless the user requests otherwise: a linear model
        about a simulated motion is not valid for long where contacts begin and end.
        """
        if options.pieces is not None or options.whole or not _is_on_ground(kind):
            return options.pieces
        return CONTACT_SEGMENT_SECONDS

    def _leave_out_unpredictable_runs(self) -> bool:
        """Leave out segments that no simulation predicts; return whether there are any.

        At least half of the segments for fitting and of those for measuring are kept.
        """
        # This import is needed for robots only.
        from bench.diagnosis.kalman.candidate_responses import FollowedRuns

        left_out: list[str] = []
        for evaluator in self._list_run_evaluators():
            theta = evaluator.get_nominal_theta()
            followed = (
                self._get_filter()
                if evaluator is self.fitting
                else FollowedRuns.follow(evaluator, theta, self.noise, max_linearisations=1)
            )
            is_followed = followed.are_runs_followed
            if 2 * is_followed.sum() >= is_followed.size:
                left_out += [evaluator.runs[i].name for i in np.flatnonzero(~is_followed)]
        self._leave_out(left_out)
        return bool(left_out)

    def _leave_out(self, names: Collection[str]) -> None:
        """Leave out runs with these names, and report it."""
        if names:
            runs = tuple(run for run in self.recording.runs if run.name not in names)
            self.recording = replace(self.recording, runs=runs)
            note = "contacts make the motion unpredictable in pieces that are left out"
            self._add_notes([f"{note}: {', '.join(names)}"])

    def _leave_out_jumps(self, simulated: Array) -> bool:
        """Leave out the few segments that a model alone does not explain; return whether any.

        Where a wheel lifts off or a foot slips, the motion may depend on its initial state by a
        jump, which neither a fit nor a linear model follows. Few segments with a larger residual
        than the others show it.

        Args:
            simulated: (R, T, C) simulation of a model that explains most segments.
        """
        residual = (simulated - self.fitting.observed) / self.noise.sigma
        sizes = np.sqrt(np.nanmean(np.square(residual), axis=(1, 2)))
        median = float(np.median(sizes))
        has_jump = sizes > MAX_RESIDUAL_RATIO * median
        is_rare = 0 < has_jump.sum() <= MAX_LEFT_OUT_SHARE * has_jump.size
        if not median < MAX_RESIDUAL_RATIO or not is_rare:
            return False
        self._leave_out([self.fitting.runs[i].name for i in np.flatnonzero(has_jump)])
        for evaluator in self._list_run_evaluators():
            evaluator.filtered_runs = None
        self._set_up(self.kind)
        return True

    @property
    def is_on_ground(self) -> bool:
        """Return whether the recorded pose is that of a robot that stands or drives."""
        return _is_on_ground(self.kind)

    def _add_notes(self, notes: Iterable[str]) -> None:
        """Report notes to the user, and keep them for the report."""
        added_notes = tuple(notes)
        for note in added_notes:
            self.say(note)
        self.notes = (*self.notes, *added_notes)

    def _add_contact_effects(self, kind: type[SystemSimulator]) -> type[SystemSimulator]:
        """Return the simulator of a robot with effects at the contacts of the recording."""
        if not kind.has_model:
            return kind
        # These imports are needed for robots only.
        from bench.logs.quality.pose_check import find_recorded_contacts
        from sims.robot.robot_simulator import RobotSimulator

        assert issubclass(kind, RobotSimulator)
        contacts = find_recorded_contacts(self.recording, kind)
        return kind.with_contacts(contacts) if contacts else kind

    def _set_up(self, kind: type[SystemSimulator]) -> None:
        """Set up run evaluators, noise floor and validation for a simulator class.

        It is called again if a finer time step or another friction model replaces the simulator.
        """
        before = self._list_filtered_runs()
        self.fitting = self._build_run_evaluator(kind, self.recording.training())
        self.floor: NoiseFloor = compute_noise_floor(self.fitting, self.recording)
        # The noise is white at first: each likelihood estimates its autocorrelation.
        self.noise = NoiseModel(self.floor.sigma, np.zeros(len(self.floor.sigma)))
        self.kind = kind
        self.validation = self._prepare_validation(kind)
        self.assessor = self._create_verdict_builder()
        for known, evaluator in zip(before, self._list_run_evaluators(), strict=False):
            # The initial states of the runs depend little on the time step.
            evaluator.follow(known)

    def _list_run_evaluators(self) -> list[RunEvaluator]:
        """Return the run evaluators of the runs for fitting and of the held-out runs."""
        validation = self.validation
        held_out = validation.evaluator if isinstance(validation, HeldOutRuns) else None
        return [self.fitting] if held_out is None else [self.fitting, held_out]

    def _list_filtered_runs(self) -> list[FollowedRuns]:
        """Return the filtered runs of a robot, if there are any."""
        if not hasattr(self, "fitting"):
            return []
        return [w.filtered_runs for w in self._list_run_evaluators() if w.filtered_runs is not None]

    def _prepare_validation(self, kind: type[SystemSimulator]) -> Validation | None:
        """Prepare the validation: on held-out runs, or by cross-validation of few runs."""
        if held_out := self.recording.held_out():
            # The same effects at the same indices give a parameter vector the same meaning here.
            return HeldOutRuns(self._build_run_evaluator(kind, held_out), self.noise)
        if len(self.recording.folds()) > 1:
            return CrossValidation(self.fitting, self.noise)
        return None

    def _create_verdict_builder(self) -> VerdictBuilder:
        """Create the builder of the verdict from the present run evaluators."""
        given = self.recording, self.fitting, self.validation, self.floor, self.engine
        return VerdictBuilder(*given)

    def _build_run_evaluator(
        self, kind: type[SystemSimulator], runs: Sequence[Run]
    ) -> RunEvaluator:
        """Build a run evaluator of some runs that shares the search control and the worker pool.

        It also has the widened bounds and the identified parameters of the base model found so far.

        Args:
            kind: class of the simulator.
            runs: the runs.
        """
        evaluator = RunEvaluator(
            kind, self.recording, runs, self.engine, list_hat_effects(kind), self.free
        )
        evaluator.search_control = self.search_control
        evaluator.worker_pool = self.worker_pool
        self.worker_pool.register(evaluator)
        use_bounds(evaluator, {name: bounds for name, (_, bounds) in self.wider.items()})
        evaluator.identified = self.identified
        return evaluator

    def _make_no_effects_error(self) -> InputError:
        """Return the error for a simulator to which no effects can be added."""
        return InputError(
            f"{self.path}: simulator {self.recording.system} takes no effects, "
            "so nothing can be missing from it"
        )

    def _check_recording(self) -> None:
        """Refuse a recording that is too short, or whose values are far too large.

        Raises:
            InputError: It has too few samples for its parameters and initial states, or the values
                of a channel are so large that its unit must be wrong.
        """
        evaluator = self.fitting
        # With fewer samples than unknowns every model fits exactly, and no gap would be visible.
        samples = int(np.isfinite(evaluator.observed).sum())
        unknowns = evaluator.base_indices.size + int((~evaluator.known_state_mask).sum())
        if samples < MIN_SAMPLES_PER_UNKNOWN * unknowns + MIN_EXTRA_SAMPLES:
            least = int(MIN_SAMPLES_PER_UNKNOWN * unknowns) + MIN_EXTRA_SAMPLES
            raise InputError(
                f"{self.path}: too short: {samples} samples for fitting, "
                f"expected at least {least} for {unknowns} parameters and initial states"
            )
        # Values that are too large by orders of magnitude have a wrong unit; no fit could follow
        # them.
        measuring = self.assessor.held_out_evaluator
        parts = [part.observed for part in (evaluator, measuring) if part is not None]
        for c, channel in enumerate(evaluator.simulator.channels):
            largest = max(float(np.nanmax(np.abs(part[..., c]), initial=0.0)) for part in parts)
            if largest >= MAX_CHANNEL_SIZE_FACTOR * channel.scale:
                raise InputError(
                    f"{self.path}: column {channel.name}: expected values of about "
                    f"{channel.scale:g} {channel.unit}, found {largest:.3g}; is the unit right?"
                )

    # With a thread per core, small matrix products take five times as long on a busy machine.
    @limit_to_one_thread()
    def run(self) -> Explanation:
        """Fit the base model, search for causes, and build the verdict and the report data.

        Raises:
            InputError: The conventions of the recording contradict the model file, or no fit of the
                base model can simulate the recording.
        """
        self._refuse_broken_conventions()
        self.search_control.begin_stage(STAGES["base_fit"])
        base = self._fit_base()
        if not np.isfinite(base.fit.simulated[np.isfinite(self.fitting.observed)]).all():
            raise self._make_simulation_error()
        if self.is_on_ground and self._leave_out_jumps(base.fit.simulated):
            base = self._fit_base()
        if self.may_divide and self._loses_orientation(base):
            raise DivergingSimulationError(f"{self.path}: the simulation loses the orientation")
        result = self._search_with_friction_forms(base)
        result = self._search_with_better_step(result.search, result.finding) or result
        result = self._search_with_possible_options(result) or result
        base, search, finding, rng = result
        self.search_control.begin_stage("measuring the gain")
        verdict = self.assessor.build_verdict(search, finding, rng, self.started)
        verdict = replace(
            verdict, recording_faults=self.unit_errors, recording_notes=self.recording.notes
        )
        numerics_causes = [] if self.coarse is None else list_step_causes(self.coarse)
        if self.changed_options is not None:
            numerics_causes += list_option_causes(self.changed_options)
        verdict = add_numerics_causes(verdict, numerics_causes)
        self.found = search, finding
        notes = (
            *describe_unusual_values(self.fitting, finding.model.fit.theta, self.wider),
            *self.notes,
        )
        report_data = DiagnosisReportDataBuilder(
            self.assessor, search, base, finding, notes
        ).build_report_data(verdict)
        return Explanation(verdict, report_data, self._build_extended_simulator(search, finding))

    def _search_with_friction_forms(self, base: BaseFit) -> _SearchResult:
        """Search for causes; repeat with MuJoCo's soft dry friction if the data support that form.

        Dry friction of a robot is either a stiff limit (the search's own effects) or MuJoCo's soft
        constraint. A search ends with `SoftFrictionError` if it finds the soft form likelier.
        """
        # Surrogates and bootstrap share one random stream, so that a seed gives the same result.
        rng = self._make_rng()
        search = self._create_search(base, rng)
        if not self.kind.has_model:
            return _SearchResult(base, search, self._find_causes(search), rng)
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.dry_friction_fits import SoftFrictionError
        from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch

        stiff_evaluators = RunEvaluators(self.kind, self.fitting, self.validation)
        try:
            result = _SearchResult(base, search, self._find_causes(search), rng)
            # The search itself compares the forms of friction that it selects, but not of friction
            # that is a free number.
            is_comparison_needed = (
                has_dry_friction(self.fitting, ())
                and not self.unit_errors
                and not self.search_control.is_over()
            )
            if not is_comparison_needed or not is_likelier_soft(
                search, result.finding.model, INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
            ):
                return result
            return self._search_with_soft_friction(base, search)
        except SoftFrictionError as error:
            soft_result = self._search_with_soft_friction(base, search, error.start)
            if (
                not error.is_preliminary
                or self._is_explained(soft_result)
                or self.search_control.is_over()
            ):
                return soft_result
        self.say(STIFF_FRICTION)
        self._restore_evaluators(stiff_evaluators, self.assessor.before)
        stiff_search = self._create_search(base, rng, is_form_given=True)
        if isinstance(search, PredictionErrorSearch) and isinstance(
            stiff_search, PredictionErrorSearch
        ):
            stiff_search.take_over(search)
        try:
            return _SearchResult(base, stiff_search, self._find_causes(stiff_search), rng)
        except SoftFrictionError as error:
            return self._search_with_soft_friction(base, search, error.start)

    def _refuse_broken_conventions(self) -> None:
        """Refuse a robot's recording whose conventions differ from those of its model file.

        Raises:
            InputError: The conventions differ; the message names the change to make.
        """
        if not self.kind.has_model or self.force:
            return
        # These imports are needed for robots only.
        from bench.diagnosis.conventions.convention_comparison import ConventionComparison
        from bench.diagnosis.conventions.corrected_description import list_changed_tables

        self.search_control.begin_stage("comparing conventions of log and model")
        if self.is_on_ground:
            return
        if self._has_contacts and self._is_linear_model_wrong_at_contacts(self._get_filter()):
            return
        differences = ConventionComparison(self._unit_check_subject).differences()
        if not differences:
            return
        remedy = "correct these signals"
        if self.recording.path.with_suffix(".toml").exists():
            _, meta = read_meta(self.recording.path)
            lines = "; ".join(list_changed_tables(meta, self.kind, differences))
            remedy = (
                f"set {lines} in {self._unit_check_subject.file}, "
                "or write a corrected description: "
                f"simgap inspect {self.path.name} --fix NAME.toml"
            )
        description = "; ".join(difference.description for difference in differences)
        raise InputError(
            f"{self.path}: {description}; expected the conventions of the model file: {remedy} "
            "(--force explains the log as it is)"
        )

    @staticmethod
    def _is_explained(found: _SearchResult) -> bool:
        """Return whether a result explains the data down to the noise."""
        return found.finding.verdict in EXPLAINED_VERDICTS

    def _search_with_soft_friction(
        self, base: BaseFit, stiff_search: EffectSearch, likely: FitStart | None = None
    ) -> _SearchResult:
        """Refit the base model with MuJoCo's soft dry friction, and search for causes again.

        Args:
            base: Base model, fitted with stiff friction.
            stiff_search: Search with stiff friction; its results are reused where they are valid.
            likely: Model that may explain the runs.
        """
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch

        self.say(SOFT_FRICTION)
        base_prediction = self.assessor.before
        self._set_up(make_soft_kind(self.kind))
        self.assessor = replace(self.assessor, before=base_prediction)
        fitter = TrajectoryFitter(self.fitting, self.noise, base.fixed_parameters)
        start = replace(base.fit.make_start(), initial_states=self.fitting.initial_state_guesses)
        (fit,) = fitter.fit_models([start], FINAL_ITERATIONS)
        base = self._correct_step_errors(replace(base, fit=fit))
        rng = self._make_rng()
        search = self._create_search(base, rng)
        if isinstance(search, PredictionErrorSearch) and isinstance(
            stiff_search, PredictionErrorSearch
        ):
            search.likely = likely
            # Friction of the file keeps its form unless it is a free number.
            if not has_dry_friction(self.fitting, ()):
                search.take_over(stiff_search)
        return _SearchResult(base, search, self._find_causes(search), rng)

    def _finish_base_and_search(self, base: BaseFit) -> _SearchResult:
        """Freeze and correct a base model that was fitted with another step, and search again."""
        return self._search_with_friction_forms(self._finish_robot_base(base))

    def _find_causes(self, search: EffectSearch) -> DiagnosisResult:
        """Return the finding; without causes if the recording has a wrong unit or sign.

        Every cause would only imitate the wrong unit or sign.
        """
        base = search.base_model
        if not self.unit_errors:
            finding = self.assessor.restrict_verdict(search, self._search_and_decide(search))
            self.unit_errors = self._check_units_imitated_by_causes(
                search, finding
            ) or self._check_units_of_unexplained(search, finding)
            if not self.unit_errors:
                return finding
        return DiagnosisResult("unknown", base, base, (), assess_lack_of_fit(search, base))

    def _search_and_decide(self, search: EffectSearch) -> DiagnosisResult:
        """Run the search and select a verdict.

        For a robot whose runs could be filtered, the search uses prediction errors.
        """
        if self.fitting.filtered_runs is None:
            if self.fitting.is_in_contact:
                # This import is needed for robots only.
                from bench.diagnosis.search.contact_search import propose_contact_effects

                # A search that has to end early still gives its best model.
                with suppress(SearchStoppedError):
                    propose_contact_effects(search, self._list_run_evaluators())
            return diagnose(search, self.validation)
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.simulation_confirmation import Confirmation

        previous_bounds = {p.name: p.bounds for p in self.fitting.parameters}
        result = answer(Confirmation(search, self.validation))
        wider_bounds = {
            parameter.name: parameter.bounds
            for parameter in self.fitting.parameters
            if parameter.bounds != previous_bounds[parameter.name]
        }
        self._widen_ranges(wider_bounds, previous_bounds)
        return result

    def _check_units_of_unexplained(
        self, search: EffectSearch, finding: DiagnosisResult
    ) -> tuple[RecordingFault, ...]:
        """Test for a wrong unit or sign of a robot's recording, if no effect explains the residual.

        For a robot, units are usually tested only if no effect has explained the gap before.

        Args:
            search: the search, with the fitted base model.
            finding: result of the diagnosis.
        """
        is_explained = finding.verdict in EXPLAINED_VERDICTS
        if not self._checks_units_late or is_explained or self.search_control.is_over():
            return ()
        remaining_excess = search.compute_excess_residual(finding.model)
        base_excess = search.compute_excess_residual(search.base_model)
        # With a wrong unit or sign, effects would leave more of the discrepancy.
        max_share = (
            MAX_EXCESS_SHARE_OF_INCOMPLETE
            if finding.is_incomplete
            else MAX_EXCESS_SHARE_WITH_RIGHT_UNITS
        )
        if remaining_excess < max_share * base_excess:
            return ()
        base = BaseFit(search.base_model.fit, frozenset(search.fixed_parameters))
        fault = find_wrong_units(self._unit_check_subject, self.fitting, self.noise, base)
        return () if fault is None else (fault,)

    def _check_units_imitated_by_causes(
        self, search: EffectSearch, finding: DiagnosisResult
    ) -> tuple[RecordingFault, ...]:
        """Return wrong units and signs that the diagnosed causes imitate.

        Args:
            search: the search, with the fitted base model.
            finding: result of the diagnosis.
        """
        faults = [
            find_imitated_unit(self._unit_check_subject, self.fitting, cause, search.base_model.fit)
            for cause in self.assessor.build_causes(search, finding)
        ]
        return tuple(fault for fault in faults if fault is not None)

    @property
    def _unit_check_subject(self) -> Subject:
        """Input of the unit check."""
        return Subject(self.kind, self.recording, self.engine, self.free)

    def close(self) -> None:
        """Close the simulators; proposals of experiments need them until then."""
        self.fitting.close()
        if self.validation is not None:
            self.validation.close()

    def design(self, seconds: float, longest: float) -> NextRunDesign | None:
        """Design the next recording; call it after `run`.

        The run distinguishes the first cause that has alternatives. If there is none, it narrows
        the parameters of the present model.

        Args:
            seconds: Duration of the run in seconds.
            longest: Maximum duration in seconds, if `seconds` do not suffice.
        """
        if self.found is None:
            return None
        search, finding = self.found
        for cause in finding.causes:
            other_causes = {name for name in finding.model.effects if name != cause.effect}
            keys = [frozenset({*other_causes, effect}) for effect in cause.alternatives]
            competing_models = [search.models[key] for key in keys if key in search.models]
            if competing_models:
                return design_next_run(search, finding.model, competing_models, seconds, longest)
        return design_next_run(search, finding.model, (), seconds, longest)

    def _create_search(
        self, base: BaseFit, rng: np.random.Generator, **attributes: Any
    ) -> EffectSearch:
        """Create a search that starts from the base fit.

        It is a prediction-error search if the runs of a robot could be filtered, because it needs
        fewer simulations; otherwise it is a beam search.

        Args:
            base: fitted base model.
            rng: random numbers of the search, such as those of surrogate data.
            attributes: further fields of the search.
        """
        kind = EffectSearch
        if self.fitting.filtered_runs is not None:
            # This import is needed for robots only.
            from bench.diagnosis.prediction_error.prediction_error_search import (
                PredictionErrorSearch,
            )

            kind = PredictionErrorSearch
        given = self.fitting, self.noise, base.fixed_parameters, rng, self.floor.is_stated
        search = kind(*given, thorough=self.thorough, **attributes)
        search.add_fit(base.fit)
        return search

    def _fit_base(self) -> BaseFit:
        """Fit the base model; for a robot with the time step that the data support.

        This is the step of the model file or a finer one.
        """
        if self.kind.has_model:
            self._filter_runs()
        base = fit_base_model(self.fitting, self.noise, self._get_given_starts())
        if self._checks_units_late:
            return self._prepare_robot_base(base)
        if not self.search_control.is_over():
            fault = find_wrong_units(self._unit_check_subject, self.fitting, self.noise, base)
            self.unit_errors = (fault,) if fault is not None else ()
        if self.unit_errors:
            return base
        return (
            self._prepare_robot_base(base)
            if self.kind.has_model
            else self._widen_bounds_at_fit(base)
        )

    @property
    def _checks_units_late(self) -> bool:
        """Return whether units are checked only after no effect has explained the gap.

        This is so for a robot's recording, unless its free numbers could not be identified.
        """
        has_unidentified_base = (
            self.has_base_parameters
            and self.identified is None
            and self.fitting.filtered_runs is not None
        )
        return self.kind.has_model and not has_unidentified_base

    @property
    def has_base_parameters(self) -> bool:
        """Return whether the base model has parameters."""
        return bool(self.fitting.base_indices.size)

    def _filter_runs(self) -> None:
        """Filter the runs of a robot with the present model (Kalman filter and smoother).

        The filter provides initial states and starting values of free parameters. If the linearised
        model diverges, nothing is stored, and causes are searched by simulation.
        """
        # This import is needed for robots only.
        from bench.diagnosis.kalman.candidate_responses import FollowedRuns

        self.search_control.begin_stage("computing prediction errors")
        evaluator, *held_out = self._list_run_evaluators()
        filtered_runs = self._get_filter()
        # Where the linear model diverges, causes are searched by simulation.
        if not filtered_runs.has_expected_innovations or self._is_linear_model_wrong_at_contacts(
            filtered_runs
        ):
            if self._has_contacts:
                # This import is needed for robots only.
                from bench.diagnosis.kalman.cubature_filter import set_first_states_in_contact

                theta = evaluator.get_nominal_theta()
                set_first_states_in_contact(self._list_run_evaluators(), theta, self.noise.sigma)
            return
        if self.has_base_parameters and self.tuner is None:
            filtered_runs = self._filter_with_fitted_parameters(filtered_runs)
        evaluator.follow(filtered_runs)
        if self.search_control.is_over():
            return
        for evaluator in held_out:
            # Held-out runs are only simulated; without a filter they begin at their measured
            # values.
            theta = evaluator.get_nominal_theta()
            filtered_held_out = FollowedRuns.follow(
                evaluator, theta, self.noise, max_linearisations=1
            )
            if filtered_held_out.has_expected_innovations:
                evaluator.follow(filtered_held_out)

    def _is_linear_model_wrong_at_contacts(self, filtered_runs: FollowedRuns) -> bool:
        """Return whether the linear model of a robot fails at the contacts of the recording.

        The depth of a contact is smaller than the noise of most encoders, so that a model that is
        linearised about the readings has wrong contact forces. The filter then needs a missing
        force that is larger than all typical forces.
        """
        force_share = float((filtered_runs.force / filtered_runs.typical).max())
        is_linear_about_readings = self._has_contacts and not self.is_on_ground
        return is_linear_about_readings and not force_share <= MAX_FORCE_SHARE_AT_CONTACTS

    @property
    def _has_contacts(self) -> bool:
        """Return whether geoms of a robot touch in the recording."""
        robot: Any = self.kind
        return bool(robot.robot.contacts)

    def _get_filter(self) -> FollowedRuns:
        """Return the runs for fitting of a robot, filtered with the numbers of the model file."""
        # This import is needed for robots only.
        from bench.diagnosis.kalman.candidate_responses import FollowedRuns

        evaluator = self.fitting
        if self._filtered is None or self._filtered.evaluator is not evaluator:
            self._filtered = FollowedRuns.follow(
                evaluator, evaluator.get_nominal_theta(), self.noise
            )
        return self._filtered

    def _filter_with_fitted_parameters(self, filtered_runs: FollowedRuns) -> FollowedRuns:
        """Return the runs, filtered with base parameters from a prediction-error fit."""
        # These imports are needed for robots only.
        from bench.diagnosis.prediction_error.base_identification import identify_base
        from bench.diagnosis.prediction_error.identification_without_simulation import is_long

        evaluator = self.fitting
        declared_bounds = {p.name: p.bounds for p in evaluator.parameters}
        # The joints of a real robot have friction, and long recordings are those of real robots.
        refiltered_runs, identified, wider_bounds = identify_base(
            evaluator, self.noise, filtered_runs, is_long(evaluator)
        )
        if identified is not None:
            self.identified = evaluator.identified = identified
        self._widen_ranges(wider_bounds, declared_bounds)
        return refiltered_runs

    def _widen_ranges(
        self, wider_bounds: Mapping[str, Bounds], previous_bounds: Mapping[str, Bounds]
    ) -> None:
        """Report the wider ranges of base parameters, and use them for all runs.

        Args:
            wider_bounds: new lower and upper bound of each widened parameter, by name.
            previous_bounds: its previous bounds; the first ones are those that the system or the
                model file declares.
        """
        for evaluator in self._list_run_evaluators()[1:]:
            use_bounds(evaluator, wider_bounds)
        for name, (low, high) in wider_bounds.items():
            self.say(f"{name} ends at a bound of its range: widened to {low:g} to {high:g}")
        for name, bounds in wider_bounds.items():
            declared_bounds, _ = self.wider.get(name, (previous_bounds[name], bounds))
            self.wider[name] = declared_bounds, bounds

    def _prepare_robot_base(self, base: BaseFit) -> BaseFit:
        """Return the base model of a robot with the step that the data support.

        Free numbers that the data cannot identify are frozen.
        """
        base = self._choose_options(base)
        if self.changed_options is None and self._shows_step_errors(base):
            base = self._choose_base_step(base)
        return self._finish_robot_base(base)

    def _choose_options(self, base: BaseFit) -> BaseFit:
        """Choose the options of MuJoCo's solver of a robot with contacts: the file's, or others.

        Other options are used before the search if they alone close the gap down to the noise, and
        if no effect comes near with the file's options. Other options that are better than the
        file's are compared with the result of the search.
        """
        if (
            not self._has_contacts
            or self.is_on_ground
            or self.tuner is not None
            or self.search_control.is_over()
            or not np.isfinite(base.fit.cost)
        ):
            return base
        file_options = self._rate_options(base)
        if file_options.is_noise_like:
            return base
        options = self._improve_options(file_options)
        self._restore_evaluators(file_options.evaluators)
        if options is file_options:
            return base
        if options.is_noise_like and not self._has_competing_effect(options, file_options):
            self._use_options(options, file_options)
            return options.base
        self.possible_options = options
        return base

    def _has_competing_effect(self, options: RatedOptions, file_options: RatedOptions) -> bool:
        """Return whether an effect may explain the recording as other options of the solver do.

        Far from the noise, only effects at contacts are tried: others would not imitate an option.
        Laws with many shapes are not tried, because an option is the simpler explanation.

        Args:
            options: the other solver options, with the base model fitted to them.
            file_options: options of the model file, with the base model fitted to them.
        """
        # This import is needed for robots only.
        from bench.diagnosis.search.contact_search import (
            exclude_laws_with_many_shapes,
            find_lowest_scan,
        )

        search = self._create_search(file_options.base, self._make_rng())
        lowest_squares = find_lowest_scan(search)
        if file_options.residual > MAX_LINEAR_RESIDUAL:
            return lowest_squares < MAX_COMPETING_SQUARES_RATIO * options.base.fit.cost
        exclude_laws_with_many_shapes(search)
        model = search.base_model
        squares = np.square(search.compute_residual(model.fit) / self.noise.sigma).sum()
        gains = (
            float(search.observed_mask.sum()) * float(np.log(squares / lowest_squares)),
            float(search.score_missing_effects(model).score.max(initial=0.0)),
        )
        option_gain = options.log_likelihood - file_options.log_likelihood
        return max(gains) > MIN_COMPETING_GAIN_SHARE * option_gain

    def _rate_options(self, base: BaseFit) -> RatedOptions:
        """Rate a base model that was fitted with the present options."""
        search = self._create_search(base, self._make_rng())
        model = search.base_model
        held_out = 0.0
        if self.validation is not None:
            held_out = self.validation.validate([base.fit])[0].penalised_log_likelihood
        return RatedOptions(
            RunEvaluators(self.kind, self.fitting, self.validation),
            base,
            float(model.likelihood.value),
            model.penalised_log_likelihood,
            1.0 + search.compute_excess_residual(model),
            held_out,
            search.is_noise_like(model),
        )

    def _improve_options(self, rated: RatedOptions) -> RatedOptions:
        """Return the best options, changed one after the other while the base model improves.

        The run evaluators of any options may be in use afterwards.

        Args:
            rated: The options in use.
        """
        # This import is needed for robots only.
        from bench.diagnosis.evaluation.solver_options import rank_option_alternatives

        for _ in range(MAX_OPTION_ROUNDS):
            evaluator = rated.evaluators.fitting
            tried = []
            for alternative in rank_option_alternatives(
                evaluator, self.noise, rated.base.fit.theta, evaluator.initial_state_guesses
            )[:MAX_FITTED_OPTIONS]:
                if self.search_control.is_over():
                    break
                robot: Any = self.kind
                self._set_up(robot.with_integrator_settings(alternative.numerics))
                if self.fitting.filtered_runs is None:
                    self._filter_runs()
                starts = self._get_nearby_starts(rated.base)
                tried.append(self._rate_options(fit_base_model(self.fitting, self.noise, starts)))
            best = max(tried, key=lambda one: one.log_likelihood, default=rated)
            if best is rated or not best.is_better_than(rated):
                break
            rated = best
        return rated

    def _use_options(self, options: RatedOptions, file_options: RatedOptions) -> None:
        """Use other options of the solver than the model file's.

        Args:
            options: The other options.
            file_options: The options of the model file, with the base model fitted with them.
        """
        self._restore_evaluators(options.evaluators)
        gain = options.log_likelihood - file_options.log_likelihood
        robot: Any = self.kind
        self.changed_options, self.possible_options = OptionFinding(robot, gain), None
        self.say("simulated with other options of the solver than the model file's")
        self.assessor = replace(
            self.assessor,
            before=self._predict_with_file_step(
                file_options.base, file_options.evaluators.validation
            ),
        )

    def _search_with_possible_options(self, result: _SearchResult) -> _SearchResult | None:
        """Return the result with other options, if they explain the data better; otherwise None.

        Args:
            result: Result with the options of the model file.
        """
        options, finding = self.possible_options, result.finding
        if options is None or self.coarse is not None or self.unit_errors:
            return None
        if finding.early_stop is not None or self.search_control.is_over():
            return None
        merits = _rate_model(result.search, finding.model)
        is_better = is_finer_model_better(
            merits, (options.penalised_log_likelihood, options.residual - 1.0)
        )
        if not is_better and self._is_explained(result):
            return None
        evaluators, before = (
            RunEvaluators(self.kind, self.fitting, self.validation),
            self.assessor.before,
        )
        file_options = self._rate_options(result.base)
        self._use_options(options, file_options)
        other = self._finish_base_and_search(options.base)
        if is_finer_model_better(merits, _rate_model(other.search, other.finding.model)):
            return other
        self._restore_evaluators(evaluators, before)
        self.changed_options = None
        return None

    def _shows_step_errors(self, base: BaseFit) -> bool:
        """Return whether the recording shows the discretisation error of the engine's steps."""
        has_no_filter = self.fitting.filtered_runs is None or not np.isfinite(base.fit.cost)
        if self.search_control.is_over() or has_no_filter:
            return True
        # These imports are needed for robots only.
        from bench.diagnosis.kalman.candidate_responses import FollowedRuns
        from bench.diagnosis.prediction_error.regression_selection import shows_step_errors

        return shows_step_errors(
            FollowedRuns.get_or_follow(self.fitting, base.fit.theta, self.noise)
        )

    def _correct_step_errors(self, base: BaseFit) -> BaseFit:
        """Return the base model without the discretisation error of the engine's steps.

        The error is corrected if the recording shows it, or if no filter could decide.
        """
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.regression_selection import shows_step_errors

        filtered_runs = self.fitting.filtered_runs
        if filtered_runs is not None and not shows_step_errors(filtered_runs):
            return base
        return correct_discretisation(self.fitting, self.noise, base)

    def _finish_robot_base(self, base: BaseFit) -> BaseFit:
        """Widen ranges, freeze unidentified numbers and correct the step error of a base model."""
        base = self._freeze_unidentified(self._widen_bounds_at_fit(base))
        # The choice of the step precedes this correction, which hides the discretisation error.
        return self._correct_step_errors(base)

    def _widen_bounds_at_fit(self, base: BaseFit) -> BaseFit:
        """Widen the ranges of base parameters that the fit leaves at a bound."""
        previous_bounds = {p.name: p.bounds for p in self.fitting.parameters}
        base, wider_bounds = fit_wider(self.fitting, self.noise, base)
        self._widen_ranges(wider_bounds, previous_bounds)
        return base

    def _freeze_unidentified(self, base: BaseFit) -> BaseFit:
        """Freeze free numbers of a robot that the data cannot identify.

        A system has few parameters, and would have no result without them; there the verdict
        reports it.
        """
        if self.search_control.is_over() or not np.isfinite(base.fit.cost):
            return base
        reduced_base = freeze_unidentified_parameters(
            self.fitting, self.noise, base, lambda base: self._create_search(base, self._make_rng())
        )
        if reduced_base.unidentified_parameters:
            names = ", ".join(
                self.fitting.parameters[i].name
                for i in sorted(reduced_base.unidentified_parameters)
            )
            self.say(
                "kept at the nominal value, because the recording does not identify it "
                f"together with the others: {names}"
            )
        return reduced_base

    def _choose_base_step(self, base: BaseFit) -> BaseFit:
        """Choose the step of the base model: the file's own, or a finer one.

        A finer step is used if it alone closes a large part of the gap. The run evaluators of the
        chosen step are then those of the explainer.
        """
        # This import is needed for robots only.
        from bench.diagnosis.evaluation.solver_options import find_step_refinements

        self.finer = Reusable(find_step_refinements(self.fitting, self.noise))
        file_evaluators = RunEvaluators(self.kind, self.fitting, self.validation)
        file_log_likelihood, residual = self._rate_base(base)
        gap = residual - 1.0
        for refinement in self.finer:
            # A finer step leaves a smaller residual; a step that is too coarse for it is not tried.
            if not refinement.is_accurate_enough(residual):
                continue
            self._set_up(refinement.kind)
            if self.fitting.filtered_runs is None:
                # A model that diverges with the file's step may be filtered with a finer one.
                self._filter_runs()
            finer_base = fit_base_model(self.fitting, self.noise, self._get_nearby_starts(base))
            finer_log_likelihood, residual = self._rate_base(finer_base)
            if not is_finer_step_better(
                finer_log_likelihood - file_log_likelihood, gap, residual - 1.0
            ):
                # Another missing effect may affect both models: they are compared again with it.
                if refinement.is_accurate_enough(0.0):
                    break
                residual = 0.0
            elif refinement.is_accurate_enough(residual):
                self._use_finer(
                    refinement, finer_log_likelihood - file_log_likelihood, base, file_evaluators
                )
                return finer_base
        self._restore_evaluators(file_evaluators)
        return base

    def _use_finer(
        self,
        refinement: StepRefinement,
        gain: float,
        base: BaseFit,
        file_evaluators: RunEvaluators,
    ) -> None:
        """Record that the file's own step is too coarse; the finer step is in use already.

        A URDF specifies no step, so that a finer one corrects nothing in it.

        Args:
            refinement: the finer step and integrator.
            gain: gain in penalised log-likelihood over the file's own step.
            base: fit of the base model with the file's own step.
            file_evaluators: run evaluators with the file's own step.
        """
        # This import is needed for robots only.
        from sims.robot.integrator_settings import specifies_integrator

        numerics = refinement.numerics
        self.say(
            f"simulated with a smaller time step: {numerics.integrator}, {numerics.timestep:g} s"
        )
        robot: Any = self.kind
        if not specifies_integrator(robot.robot):
            self.finer = None
            return
        self.coarse, self.file = CoarseStepFinding(refinement, gain), file_evaluators
        self.assessor = replace(
            self.assessor, before=self._predict_with_file_step(base, file_evaluators.validation)
        )

    def _search_with_better_step(
        self, search: EffectSearch, finding: DiagnosisResult
    ) -> _SearchResult | None:
        """Return the result with another step, if that explains the data better; otherwise None.

        The other step is compared with the effects of this result or some of them.

        A missing effect can make either step look better, and effects can imitate a step, so the
        first choice is preliminary. Models are compared by penalised log-likelihood and residual,
        and a finer step must be clearly better: data that MuJoCo made with the file's own step must
        not be explained by another.

        Args:
            search: the search with the present step.
            finding: its result.
        """
        if (
            self.finer is None
            or self.unit_errors
            or finding.early_stop is not None
            or self.search_control.is_over()
        ):
            return None
        if not finding.causes and (self.coarse is not None or finding.verdict == "adequate"):
            return None
        present_merit = _rate_model(search, finding.model)
        present_evaluators = RunEvaluators(self.kind, self.fitting, self.validation)
        if self.coarse is not None:
            before = self.assessor.before
            self._restore_evaluators(self.file)
            if not is_finer_model_better(self._rate_best_subset(search, finding), present_merit):
                self.say(
                    "the time step of the model file explains the data equally well: it is used"
                )
                self.coarse = None
                base = BaseFit(search.base_model.fit, search.fixed_parameters)
                return self._finish_base_and_search(
                    fit_base_model(self.fitting, self.noise, self._get_nearby_starts(base))
                )
            self._restore_evaluators(present_evaluators, before)
            return None
        refinement = next((one for one in self.finer or () if one.is_accurate_enough(0.0)), None)
        # The residual of a model that stays incomplete is far larger than an error of the step.
        if refinement is None or finding.is_incomplete:
            return None
        self._set_up(refinement.kind)
        finer_merit = self._rate_best_subset(search, finding)
        if not is_finer_model_better(present_merit, finer_merit):
            self._restore_evaluators(present_evaluators)
            return None
        base = BaseFit(search.base_model.fit, search.fixed_parameters)
        finer_base = fit_base_model(self.fitting, self.noise, self._get_nearby_starts(base))
        self._use_finer(refinement, finer_merit[0] - present_merit[0], base, present_evaluators)
        return self._finish_base_and_search(finer_base)

    def _rate_best_subset(
        self, search: EffectSearch, finding: DiagnosisResult
    ) -> tuple[float, float]:
        """Fit subsets of a finding's effects with the present step, and rate the best model.

        All subsets are fitted if there are only few effects; otherwise only all together.

        Args:
            search: search with another step, whose fixed parameters stay fixed.
            finding: its result.

        Returns:
            Penalised log-likelihood and excess RMS residual of the best model.
        """
        names, fit = finding.model.effects, finding.model.fit
        coefficient_slices = self.fitting.coefficient_slices
        starts, has_few_effects = [], len(names) <= MAX_SUBSET_EFFECTS
        for count in range(0 if has_few_effects else len(names), len(names) + 1):
            for subset in combinations(names, count):
                theta = fit.theta.copy()
                for omitted in set(names) - set(subset):
                    theta[coefficient_slices[omitted]] = self.fitting.get_nominal_theta()[
                        coefficient_slices[omitted]
                    ]
                starts.append(FitStart(subset, theta, fit.initial_states))
        fits = TrajectoryFitter(self.fitting, self.noise, search.fixed_parameters).fit_models(
            starts, MAX_ITERATIONS if has_few_effects else REFIT_ITERATIONS
        )
        models = self._create_search(
            BaseFit(search.base_model.fit, search.fixed_parameters), self._make_rng()
        )
        best = max(
            (models.add_fit(subset_fit) for subset_fit in fits),
            key=lambda model: model.penalised_log_likelihood,
        )
        return _rate_model(models, best)

    def _get_nearby_starts(self, base: BaseFit) -> Array | None:
        """Return starting values for a fit with another step; None for the default starts.

        A different step changes the best parameters only a little, so the fit needs no other
        starts, unless the fit with the previous step failed.
        """
        if not np.isfinite(base.fit.cost) or self.identified is not None:
            return self._get_given_starts()
        nearby: Array = base.fit.theta[self.fitting.base_indices]
        return nearby

    def _predict_with_file_step(self, base: BaseFit, validation: Validation | None) -> Array | None:
        """Predict the held-out runs with the file's own step; None without validation.

        Args:
            base: fit of the base model with the file's own step.
            validation: validation with this step; None without held-out runs.
        """
        if validation is None:
            return None
        return validation.validate([base.fit])[0].simulated

    def _restore_evaluators(self, evaluators: RunEvaluators, before: Array | None = None) -> None:
        """Return to run evaluators that were in use before."""
        self.kind, self.fitting, self.validation = evaluators
        self.assessor = replace(self._create_verdict_builder(), before=before)

    def _rate_base(self, base: BaseFit) -> tuple[float, float]:
        """Return twice the log-likelihood and the RMS residual, in noise units, of a base model."""
        search = self._create_search(base, self._make_rng())
        return float(search.base_model.likelihood.value), 1.0 + search.compute_excess_residual(
            search.base_model
        )

    def _make_rng(self) -> np.random.Generator:
        return make_rng("explain", self.recording.system, self.seed)

    @property
    def is_divisible(self) -> bool:
        """True if runs may be cut into segments: those of a robot without unrecorded poses.

        Those of a robot on the ground are short already.
        """
        has_unknown_states = bool(self.kind.system.floating_state_units)
        return self.kind.has_model and not has_unknown_states and not self.is_on_ground

    def _loses_orientation(self, base: BaseFit) -> bool:
        """Return whether the simulated orientation of a recorded floating body is far from it."""
        names = [
            f"q.{base_name}.{angle}"
            for base_name in self.kind.system.base_orientations
            for angle in ANGLES
        ]
        channels = self.fitting.simulator.channels
        rows = [c for c, channel in enumerate(channels) if channel.name in names]
        errors = (base.fit.simulated - self.fitting.observed)[..., rows]
        return bool(np.nanmax(np.abs(errors), initial=0.0) > MAX_ROTATION_ERROR)

    def _make_simulation_error(self) -> InputError:
        """Return the error that explains why nothing could be simulated."""
        if self.unit_errors:
            return InputError(f"{self.path}: {self.unit_errors[0].says}")
        if self.search_control.is_over():
            return InputError(
                f"{self.path}: the search was stopped before the first fit of the recording was "
                "finished"
            )
        return DivergingSimulationError(
            f"{self.path}: the simulation fails at every starting point of the fit; "
            "check constants, units, inputs and initial states"
        )

    def _get_given_starts(self) -> Array | None:
        """Return starting values of the base parameters; None for the default starts.

        They come from a registered tuner, or are those identified by prediction errors.
        """
        if self.tuner is None:
            return None if self.identified is None else self.identified.base
        # Few users request a tuner, and the code that drives one is slow to import.
        from bench.diagnosis.fitting.base_fit import find_start_with_tuner

        return find_start_with_tuner(self.tuner, self.fitting, self.noise, self.seed)

    def _build_extended_simulator(
        self, search: EffectSearch, finding: DiagnosisResult
    ) -> ExtendedSimulator:
        """Build the extended simulator: the base simulator with fitted values and found effects.

        Args:
            search: the search, with the fitted models.
            finding: result of the diagnosis, with the model of the found effects.
        """
        evaluator, estimates = (
            self.fitting,
            self.assessor.collect_parameter_estimates(search, finding.model),
        )
        base_values = {
            p.name: estimates[i]
            for i, p in enumerate(evaluator.parameters[: evaluator.system_parameter_count])
        }
        # A freed constant becomes a constant of the extended simulator, with its fitted value.
        freed_constants = {
            p.name: estimates[evaluator.system_parameter_count + i].value
            for i, p in enumerate(evaluator.freed_constants)
        }
        added_effects = {}
        # The simulator's order keeps the file independent of the order of the search.
        for effect, coefficient_slice in evaluator.coefficient_slices.items():
            if effect not in finding.model.effects:
                continue
            coefficients = evaluator.available_effects[effect].on(evaluator.simulator.system)
            indices = range(*coefficient_slice.indices(len(evaluator.parameters)))
            added_effects[effect] = {
                coefficient.name: estimates[index]
                for coefficient, index in zip(coefficients, indices, strict=True)
            }
        return ExtendedSimulator(
            extend.make_extended_name(self.recording.system),
            self.recording.system,
            self.engine,
            self.recording.title,
            base_values,
            added_effects,
            {**self.recording.constants, **freed_constants},
            evaluator.channels,
            self.kind,
            extend.get_robot_reference(self.kind),
        )
