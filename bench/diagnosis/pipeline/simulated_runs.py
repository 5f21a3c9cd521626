"""Runs of a recording with the simulator that explains them, and what a diagnosis shares."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.noise_floor import NoiseFloor, compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import Bounds, use_bounds
from bench.diagnosis.evaluation.run_evaluator import IdentifiedParameters, RunEvaluator
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.fitting.base_fit import BaseFit
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.lack_of_fit import list_hat_effects
from bench.diagnosis.validation.cross_validation import CrossValidation
from bench.diagnosis.validation.held_out_runs import HeldOutRuns, Validation
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

if TYPE_CHECKING:
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns


class DiagnosisContext:
    """Options, time limit, workers and notes that all steps of a diagnosis share.

    Args:
        options: options of the explanation.
        worker_pool: worker pool for simulations and fits.

    Attributes:
        options: options of the explanation.
        say: function that informs the user.
        worker_pool: worker pool for simulations and fits.
        search_control: time limit and progress.
        started: start on the clock `time.perf_counter`.
        notes: notes for the report, in addition to those of the recording.
        wider: by name, the declared range of a base parameter and the wider one that replaced it.
        identified: parameters of a robot, identified by prediction errors; else None.
    """

    def __init__(self, options: ExplainOptions, worker_pool: ForkedWorkerPool) -> None:
        """Start the clock of the time limit, without notes and results.

        The docstring of the class describes the attributes.

        Args:
            options: options of the explanation.
            worker_pool: worker pool for simulations and fits.
        """
        self.started = time.perf_counter()
        self.options = options
        self.say = options.say
        self.worker_pool = worker_pool
        self.search_control = options.make_search_control()
        self.notes: list[str] = []
        self.wider: dict[str, tuple[Bounds, Bounds]] = {}
        self.identified: IdentifiedParameters | None = None
        self._simulators = ExitStack()

    def add_notes(self, notes: Iterable[str]) -> None:
        """Report notes to the user, and keep them for the report."""
        for note in notes:
            self.say(note)
            self.notes.append(note)

    def adopt(self, evaluator: RunEvaluator) -> None:
        """Give a new run evaluator what all steps of the diagnosis share.

        These are the time limit, the workers, the widened ranges of base parameters, and the
        parameters that were identified by prediction errors.

        Args:
            evaluator: run evaluator, which is changed.
        """
        evaluator.search_control = self.search_control
        evaluator.worker_pool = self.worker_pool
        self.worker_pool.register(evaluator)
        use_bounds(evaluator, {name: bounds for name, (_, bounds) in self.wider.items()})
        evaluator.identified = self.identified

    def close_at_end(self, simulated: RunEvaluator | Validation) -> None:
        """Close the simulators of a run evaluator or a validation when the context is closed."""
        self._simulators.callback(simulated.close)

    def close(self) -> None:
        """Close all simulators; proposals of experiments need them until then."""
        self._simulators.close()


@dataclass(frozen=True)
class ContactConditions:
    """Conditions that depend on whether a simulated robot touches something.

    A robot on the ground has a recorded pose and stands or drives. Other robots may touch something
    with a gripper or a foot.

    Attributes:
        kind: class of the simulator, which need not be a robot.
    """

    kind: type[Simulator]

    @property
    def is_on_ground(self) -> bool:
        """Return whether the recorded pose is that of a robot that stands or drives."""
        return self.kind.has_model and bool(self._robot.is_on_ground)

    @property
    def has_contacts(self) -> bool:
        """Return whether geoms of a robot touch in the recording."""
        return self.kind.has_model and bool(self._robot.contacts)

    @property
    def has_contacts_off_ground(self) -> bool:
        """Return whether a robot touches something but does not stand on the ground."""
        return self.has_contacts and not self.is_on_ground

    @property
    def _robot(self) -> Any:
        kind: Any = self.kind
        return kind.robot


@dataclass(frozen=True, eq=False)
class SimulatedRuns:
    """All runs of a recording, simulated by one class of simulator.

    Another time step, friction form or solver option is another instance, so that a step of the
    diagnosis that tries one leaves the present runs as they are.

    Attributes:
        context: what all steps of the diagnosis share.
        kind: class of the simulator.
        recording: the recording.
        fitting: run evaluator of the runs for fitting.
        floor: noise floor of each channel.
        noise: noise of each channel. It is white; each likelihood estimates its autocorrelation.
        validation: validation on held-out runs or by cross-validation; None without either.
        before: prediction of the held-out runs by the base model with the numerical settings of the
            model file, if `kind` has others; else None.
    """

    context: DiagnosisContext
    kind: type[SystemSimulator]
    recording: Recording
    fitting: RunEvaluator
    floor: NoiseFloor
    noise: NoiseModel
    validation: Validation | None
    before: Array | None = None

    @classmethod
    def build(
        cls, context: DiagnosisContext, kind: type[SystemSimulator], recording: Recording
    ) -> SimulatedRuns:
        """Build run evaluators, noise floor and validation.

        The validation predicts held-out runs; without held-out runs but with several folds, it is
        cross-validation.

        Args:
            context: what all steps of the diagnosis share.
            kind: class of the simulator.
            recording: the recording.
        """

        def build_evaluator(runs: Sequence[Run]) -> RunEvaluator:
            """Build the run evaluator of some runs, with the same effects at the same indices."""
            engine, free = choose_engine(kind, context.options), list_free(kind, context.options)
            # Hat effects are forces without a given form, by which unmodelled forces are detected.
            evaluator = RunEvaluator(kind, recording, runs, engine, list_hat_effects(kind), free)
            context.adopt(evaluator)
            return evaluator

        # Runs for fitting: those that the recording does not hold out.
        fitting = build_evaluator(recording.training())
        floor = compute_noise_floor(fitting, recording)
        noise = NoiseModel.make_white(floor.sigma)
        validation: Validation | None = None
        if held_out := recording.held_out():
            validation = HeldOutRuns(build_evaluator(held_out), noise)
        elif len(recording.folds()) > 1:
            validation = CrossValidation(fitting, noise)
        context.close_at_end(fitting)
        if validation is not None:
            context.close_at_end(validation)
        return cls(context, kind, recording, fitting, floor, noise, validation)

    def with_kind(self, kind: type[SystemSimulator]) -> SimulatedRuns:
        """Return the runs with another class of simulator of the same system.

        The filters of the runs, which estimate their states, are taken over.

        Args:
            kind: simulator class, for example with another time step.
        """
        runs = SimulatedRuns.build(self.context, kind, self.recording)
        for known, evaluator in zip(self.evaluators, runs.evaluators, strict=True):
            # The initial states of the runs depend little on the numerical settings.
            if known.filtered_runs is not None:
                evaluator.follow(known.filtered_runs)
        return runs

    def without(self, names: Collection[str]) -> SimulatedRuns:
        """Leave out runs with these names, and report it."""
        kept = tuple(run for run in self.recording.runs if run.name not in names)
        note = "contacts make the motion unpredictable in pieces that are left out"
        self.context.add_notes([f"{note}: {', '.join(names)}"])
        return SimulatedRuns.build(self.context, self.kind, replace(self.recording, runs=kept))

    @property
    def evaluators(self) -> list[RunEvaluator]:
        """Run evaluators of the runs for fitting and of the held-out runs."""
        if isinstance(self.validation, HeldOutRuns):
            return [self.fitting, self.validation.evaluator]
        return [self.fitting]

    @property
    def is_cross_validated(self) -> bool:
        """True if models are validated by cross-validation instead of on held-out runs."""
        return self.validation is not None and self.validation.is_cross_validation

    @property
    def engine(self) -> str | None:
        """Name of the engine; None for a simulator with its own integrator."""
        return self.fitting.engine

    @property
    def contacts(self) -> ContactConditions:
        """Contacts of a robot with the ground and with itself or other objects."""
        return ContactConditions(self.kind)

    @cached_property
    def nominal_filter(self) -> FollowedRuns:
        """Runs for fitting of a robot, filtered with the numbers of the model file."""
        # This import is needed for robots only.
        from bench.diagnosis.kalman.linearised_filter import FollowedRuns

        followed = FollowedRuns.follow(self.fitting, self.fitting.get_nominal_theta(), self.noise)
        return followed.recompute_jacobians()

    @property
    def predicted(self) -> RunEvaluator | None:
        """Run evaluator of the runs that the validation predicts; all runs if it is by folds."""
        return None if self.validation is None else self.validation.evaluator

    def make_rng(self) -> np.random.Generator:
        """Return the random numbers of a search, which depend on the seed alone."""
        return make_rng("explain", self.recording.system, self.context.options.seed)

    def create_search(
        self, base: BaseFit, rng: np.random.Generator | None = None, **attributes: Any
    ) -> EffectSearch:
        """Create a search that starts from a base fit.

        It is a prediction-error search if the runs of a robot could be filtered, because it needs
        fewer simulations; otherwise it is a beam search.

        Args:
            base: fitted base model.
            rng: random numbers of the search, such as those of surrogate data.
            attributes: further fields of the search.
        """
        search_class = EffectSearch
        if self.fitting.filtered_runs is not None:
            # This import is needed for robots only.
            from bench.diagnosis.prediction_error.prediction_error_search import (
                PredictionErrorSearch,
            )

            search_class = PredictionErrorSearch
        search = search_class(
            self.fitting,
            self.noise,
            base.fixed_parameters,
            rng or self.make_rng(),
            self.floor.is_stated,
            thorough=self.context.options.thorough,
            **attributes,
        )
        search.add_fit(base.fit)
        return search

    @contextmanager
    def record_widened_ranges(self) -> Iterator[None]:
        """Report the ranges of base parameters that the block widens, and use them for all runs.

        A fit inside the block may widen ranges of the evaluator for fitting. Held-out runs must
        accept the same values. The context keeps the first and the last range of each parameter for
        the report.
        """
        bounds_before = {p.name: p.bounds for p in self.fitting.parameters}
        yield
        widened = {
            p.name: p.bounds for p in self.fitting.parameters if p.bounds != bounds_before[p.name]
        }
        # The first run evaluator is that of the runs for fitting.
        for evaluator in self.evaluators[1:]:
            use_bounds(evaluator, widened)
        for name, (low, high) in widened.items():
            self.context.say(f"{name} ends at a bound of its range: widened to {low:g} to {high:g}")
            # The first declared range is kept if a range is widened again.
            declared, _ = self.context.wider.get(name, (bounds_before[name], None))
            self.context.wider[name] = declared, (low, high)


def choose_engine(kind: type[SystemSimulator], options: ExplainOptions) -> str | None:
    """Return the engine of a simulator; one with its own integrator has no choice."""
    usual = kind.default_engine if kind.has_model else None
    return usual if kind.own_engine else options.engine


def list_free(kind: type[SystemSimulator], options: ExplainOptions) -> tuple[str, ...]:
    """Return the constants to estimate.

    A free number of a robot is a number of its model file, and so a parameter of its simulator.
    """
    return () if kind.has_model else tuple(options.free)
