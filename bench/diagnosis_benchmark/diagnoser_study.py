"""Comparison of diagnosers in its result folder: draw cases, run diagnosers, store answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bench.benchmark.isolation.linux_syscalls import not_dumpable
from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.runner.experiment_runner import ProgressFactory, no_progress
from bench.benchmark.runner.plugin_inspection import announce_installed, check_classes_importable
from bench.benchmark.runner.run_fingerprint import hash_class_source, list_compared_parts
from bench.benchmark.runner.study_base import PreparedStudy, PrintLine, Study
from bench.benchmark.runner.trained_weights import TrainingResult, get_weights_folder
from bench.benchmark.runner.tuner_process_start import make_part_spec
from bench.benchmark.runner.worker_pools import Call, Pool, make_pool
from bench.benchmark.storage.run_status import (
    MISSING_STATUS,
    RunEnd,
    StudyOutcome,
)
from bench.core.plugin_registries import PartUnavailableError, diagnosers, simulators
from bench.core.random_streams import PUBLIC_SALT, make_rng
from bench.diagnosis_benchmark.answer_store import AnswersByCase, AnswerStore, read_answers
from bench.diagnosis_benchmark.case_evaluation import (
    EvaluatedDiagnoser,
    evaluate_case,
    make_failed_answers,
)
from bench.diagnosis_benchmark.case_set import (
    BenchmarkConfig,
    CaseSpec,
    build_case_set,
    read_config,
)
from bench.diagnosis_benchmark.diagnoser_process import AnswerLimits
from bench.diagnosis_benchmark.diagnoser_training import (
    TrainingCost,
    train_or_load,
    write_training_costs,
)
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

MAX_TRAINING_SECONDS = 3600.0
"""Maximum training time of a diagnoser for one system, seconds."""
_CASE_DRAW_SECONDS = 300.0
"""Maximum time to draw one case, seconds."""


class DiagnosisStudy(Study):
    """Comparison of diagnosers on cases, stored in a folder; implements `study.Study`.

    A diagnoser finds the hidden cause (an effect that a simulator lacks) of a recording. A case, or
    question, is a simulated recording with known hidden causes.

    Args:
        folder: result folder of a comparison of diagnosers.

    Attributes:
        folder: result folder.
        configuration: stored configuration of the study.
        plugins: plugin files that the diagnosers need.

    Raises:
        InputError: the folder does not contain such a comparison, or it is damaged.
    """

    counted = "answers given"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        # The file of the answers is opened only by `run`.
        self._answer_store: AnswerStore | None = None

    @classmethod
    def begin(cls, new: PreparedStudy) -> DiagnosisStudy:
        """Create a comparison in a new folder, without running it.

        Args:
            new: folder, experiment, plugins and salt, from `prepare_study`.

        Raises:
            InputError: the cases or diagnosers cannot be used; no folder is made then.
        """
        # Errors in the specification of cases are reported before the folder exists.
        build_case_set(read_config(new.experiment))
        _check_code_isolated(new.experiment)
        return cls(new.create_folder())

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Self:
        """Open an interrupted comparison in order to run what is missing.

        Args:
            folder: result folder.
            plugins: further plugin files.
        """
        study = super().resume(folder, plugins)
        _check_code_isolated(study.configuration.experiment)
        return study

    @cached_property
    def config(self) -> BenchmarkConfig:
        """The validated ``[diagnosis]`` table."""
        return read_config(self.configuration.experiment)

    @cached_property
    def cases(self) -> list[CaseSpec]:
        """All cases of the experiment."""
        return build_case_set(self.config)

    @cached_property
    def skipped_diagnosers(self) -> dict[str, str]:
        """Diagnosers that cannot be used here, by name, with the reason.

        A reason is, for example, a package that is not installed.
        """
        reasons = {}
        # A diagnoser of a plugin is registered only where the plugin was loaded. Reading the folder
        # does not require the plugin, so an unregistered name is no reason to skip.
        known_names = set(diagnosers.names())
        for name in self.config.diagnosers:
            if name not in known_names:
                continue
            try:
                diagnosers.get(name)
            except PartUnavailableError as error:
                reasons[name] = error.reason
        return reasons

    @property
    def usable_diagnosers(self) -> list[str]:
        """Names of the diagnosers that can be used here."""
        return [name for name in self.config.diagnosers if name not in self.skipped_diagnosers]

    def run(
        self, jobs: int = 2, progress: ProgressFactory | None = None, pool: Pool | None = None
    ) -> StudyOutcome:
        """Collect the missing answers, each of which is stored at once.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks; None for no progress output.
            pool: worker pool; None to create one.

        Returns:
            How many answers exist, are missing or failed, also if the run was interrupted.
        """

        def run_missing() -> None:
            self._answer_store = AnswerStore(self.folder)
            try:
                _EvaluationRun(self, self._answer_store, progress or no_progress).run(jobs, pool)
            finally:
                self.close()

        return self.finish(run_missing)

    def close(self) -> None:
        """Close the answer file and release its lock."""
        if self._answer_store is not None:
            self._answer_store.close()
            self._answer_store = None

    @property
    def answers(self) -> AnswersByCase:
        """All stored answers, by case."""
        return read_answers(self.folder)

    def list_run_ends(self) -> list[RunEnd]:
        """Return which answers are stored and which are missing, one entry per case and diagnoser.

        An entry has a label, the name of the diagnoser, a status and its reason. Cases whose hidden
        cause the sensors cannot show count as done, because no diagnoser is run then.
        """
        answers = self.answers
        run_ends = []
        for question in self.cases:
            answer = answers.get(question.name)
            for name in self.config.diagnosers:
                label = f"{question.name} {name}"
                if name in self.skipped_diagnosers:
                    run_ends.append(RunEnd(label, name, "skipped", self.skipped_diagnosers[name]))
                # ``item`` is the document of the case, empty if the case could not be drawn.
                elif answer is not None and not answer["item"]:
                    run_ends.append(RunEnd(label, name, "done", "the sensors cannot show it"))
                elif answer is None or name not in answer["rows"]:
                    run_ends.append(RunEnd(label, name, MISSING_STATUS))
                else:
                    row = answer["rows"][name]
                    run_ends.append(RunEnd(label, name, row["status"], row["reason"]))
        return run_ends

    def report(self, print_line: PrintLine) -> int:
        """Write tables, figures and HTML report, and print a summary.

        Returns:
            Number of failed answers.
        """
        from bench.diagnosis_benchmark.diagnoser_report import write_report

        experiment = self.configuration.experiment
        return write_report(self.folder, experiment, self.skipped_diagnosers, print_line)


class _EvaluationRun:
    """Execution of the cases that have missing answers."""

    def __init__(
        self, study: DiagnosisStudy, answer_store: AnswerStore, progress: ProgressFactory
    ) -> None:
        """Collect what the run needs: salt, limits of an answer, and hidden folders.

        Diagnosers must not read the hidden folders: the result folder, which contains the true
        causes, and the cache of trained weights.

        Args:
            study: the study.
            answer_store: store of the answers, opened for appending.
            progress: makes progress callbacks.
        """
        self._study, self._answer_store, self._progress = study, answer_store, progress
        self._experiment = study.configuration.experiment
        self._hidden = tuple(str(place.resolve()) for place in (study.folder, get_weights_folder()))
        self._salt = study.salt or PUBLIC_SALT
        self._limits = AnswerLimits(
            self._experiment.budget, self._experiment.timeout, self._experiment.memory
        )

    def run(self, jobs: int, pool: Pool | None) -> None:
        """Train the diagnosers and collect the missing answers.

        Args:
            jobs: number of worker processes.
            pool: worker pool; None to create one.

        Raises:
            PoolLostError: the workers are no longer available.
        """
        open_questions = [
            question for question in self._shuffle_cases() if self._list_unanswered(question)
        ]
        if not open_questions:
            return
        # The true causes are in the memory of this process, and a diagnoser's process may run as
        # the same user: `not_dumpable` forbids other processes to read this memory.
        trusted = self._experiment.trusted
        with nullcontext() if trusted else not_dumpable(), pool or make_pool(jobs) as workers:
            evaluated, training_costs = self._train_diagnosers(workers)
            write_training_costs(self._study.folder, training_costs)
            self._evaluate_open_cases(workers, open_questions, evaluated)

    def _shuffle_cases(self) -> list[CaseSpec]:
        """Return the cases in a fixed random order, so that a partial result is a fair sample."""
        questions = self._study.cases
        order = make_rng("diagnosis", "order", len(questions)).permutation(len(questions))
        return [questions[index] for index in order.tolist()]

    def _list_unanswered(self, question: CaseSpec) -> list[str]:
        """Return the names of the usable diagnosers that have not answered a case.

        The list is empty if the sensors cannot show the hidden cause: such a case has an empty
        document.

        Args:
            question: specification of the case.
        """
        answer = self._answer_store.answered.get(question.name)
        if answer is not None and not answer["item"]:
            return []
        rows = answer["rows"] if answer else {}
        return [name for name in self._study.usable_diagnosers if name not in rows]

    def _train_diagnosers(
        self, workers: Pool
    ) -> tuple[dict[str, EvaluatedDiagnoser], list[TrainingCost]]:
        """Train the diagnosers that learn, once for each system, or load them from the cache.

        A training that fails does not stop the study: its error is stored with the costs, and the
        diagnoser is asked without trained arrays.

        Args:
            workers: pool of worker processes.

        Returns:
            The diagnosers to evaluate, by name, and the costs of their training.

        Raises:
            BaseException: a worker failed otherwise than by the diagnoser or the time limit.
        """
        # The model file of a robot is not known before its case, so no diagnoser can train for it.
        required_systems = {question.system for question in self._study.cases}
        systems = sorted(required_systems & set(simulators.names()))
        codes = {name: make_part_spec(diagnosers, name) for name in self._study.usable_diagnosers}
        learning_diagnosers = [name for name in codes if diagnosers.get(name).learned]
        # calls[i] is the training of trainings[i].
        trainings = [(name, system) for name in learning_diagnosers for system in systems]
        calls = [self._make_training_call(name, codes[name], system) for name, system in trainings]
        # Files of trained arrays by diagnoser and system.
        files: dict[str, dict[str, Path]] = {name: {} for name in codes}
        training_costs = []
        step = self._progress("training", len(calls)) if calls else None
        # Results arrive in the order in which the calls end; an exception is a result, too.
        for index, result in workers.iterate_results(calls, math.inf) if calls else ():
            name, system = trainings[index]
            if isinstance(result, TrainingResult):
                files[name][system] = result.path
                training_costs.append(
                    TrainingCost(name, system, result.simulations, result.seconds)
                )
            elif isinstance(result, RunEndedError | TimeoutError):
                # An untrained diagnoser is evaluated all the same; its answer states what it lacks.
                training_costs.append(TrainingCost(name, system, 0, 0.0, str(result)))
            else:  # an error of this program, not of the diagnoser
                raise result
            if step:
                step()
        evaluated = {
            name: EvaluatedDiagnoser(name, code, files[name], self._experiment.trusted)
            for name, code in codes.items()
        }
        return evaluated, training_costs

    def _make_training_call(self, name: str, code: TunerSpec, system: str) -> Call:
        """Make the call by which a worker trains a diagnoser for a system, or loads the result.

        Args:
            name: registered name of the diagnoser.
            code: module or plugin file of its code.
            system: name of the system, such as ``pendulum``.

        Returns:
            Function and arguments.
        """
        arguments = (
            code,
            hash_class_source(diagnosers.get(name)),
            system,
            self._experiment.training_budget,
            MAX_TRAINING_SECONDS,
            self._hidden,
            self._experiment.trusted,
        )
        return train_or_load, arguments

    def _evaluate_open_cases(
        self, workers: Pool, questions: Sequence[CaseSpec], evaluated: dict[str, EvaluatedDiagnoser]
    ) -> None:
        """Let the workers evaluate the open cases, and store the answers of each finished case.

        A case whose worker died or exceeded its time gets failed answers. The time limit of a case
        is the time to draw it plus, for each diagnoser, the time of an answer and a reserve, for
        which the time to draw a case is used again.

        Args:
            workers: pool of worker processes.
            questions: cases with missing answers.
            evaluated: diagnosers by name; each case is put only to those that have not answered it.
        """
        calls: list[Call] = []
        names_by_call = [self._list_unanswered(question) for question in questions]
        for question, names in zip(questions, names_by_call, strict=True):
            answer = self._answer_store.answered.get(question.name)
            case_args = (
                question.to_document(),
                self._study.config.seed,
                self._salt,
                answer["item"] if answer else None,  # the case if it was already drawn
                [evaluated[name] for name in names],
            )
            calls.append((evaluate_case, (*case_args, self._limits, self._hidden)))
        step = self._progress("asking", len(calls))
        max_seconds = _CASE_DRAW_SECONDS + len(evaluated) * (
            self._limits.seconds + _CASE_DRAW_SECONDS
        )
        for index, result in workers.iterate_results(calls, max_seconds):
            if isinstance(result, BaseException):
                result = make_failed_answers(questions[index], names_by_call[index], result)
            self._answer_store.append(result)
            step()


def _check_code_isolated(experiment: Experiment) -> None:
    """Raise an error for diagnosers whose code is in this process, unless they are trusted.

    The true causes of the cases are in the memory of this process, so no foreign code may run in
    it. Diagnosers of other packages are inspected in an isolated process, and represented by stubs
    here.

    Args:
        experiment: configuration of the comparison.

    Raises:
        InputError: a diagnoser does not exist, or its code is already in this process.
    """
    if not experiment.trusted:
        # An isolated process imports a class by its module, which a class of a script lacks.
        check_classes_importable(experiment)
        announce_installed(list_compared_parts(experiment))
    for registry, name in list_compared_parts(experiment):
        with suppress(PartUnavailableError):
            kind = registry.get(name)
            # A snapshot has the classes that code of this process added; stubs are not in it.
            if not experiment.trusted and name in registry.snapshot():
                raise InputError(
                    f"diagnoser {name}: class {kind.__qualname__} is in this process, which has "
                    "the true causes: put it into a plugin file, or use --trust"
                )
