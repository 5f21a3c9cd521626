"""Bounce-shot study in its result folder: record drops, plan with every method, store the shots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.benchmark.isolation.linux_syscalls import not_dumpable
from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.runner.experiment_runner import ProgressFactory, check_tuners, no_progress
from bench.benchmark.runner.plugin_inspection import check_classes_importable, describe_plugins
from bench.benchmark.runner.study_base import PreparedStudy, PrintLine, Study
from bench.benchmark.runner.trained_weights import TrainingResult, get_weights_folder
from bench.benchmark.runner.tuner_process_start import make_tuner_spec
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from bench.benchmark.runner.worker_pools import Call, Pool, make_pool
from bench.benchmark.storage.run_status import (
    MISSING_STATUS,
    RunEnd,
    StudyOutcome,
)
from bench.bounce_shot import drop_tuning, true_world
from bench.bounce_shot.drop_recording import RECORDINGS_FOLDER, record_drop
from bench.bounce_shot.shot_config import ShotConfig, read_shot_config
from bench.bounce_shot.shot_planner import TunedModel
from bench.bounce_shot.shot_sampling import ShotSetup, draw_shots
from bench.bounce_shot.shot_storage import SHOTS_FOLDER, check_shots, list_missing_shots, store_shot
from bench.core.plugin_registries import tuners
from sims.core.simulator import InputError
from sims.recording.recording import read_recording
from sims.systems.ball import Ball as BallSimulator
from sims.vision import video_files

if TYPE_CHECKING:
    from typing_extensions import Self


class BounceShotStudy(Study):
    """Study of shots by several methods, stored in a folder; implements `study.Study`.

    Args:
        folder: result folder of a bounce-shot study.

    Attributes:
        folder: result folder.
        configuration: stored configuration of the study.
        plugins: plugin files that its tuners need.

    Raises:
        InputError: the folder does not contain such a study, or it is damaged.
    """

    counted = "shots made"

    @classmethod
    def begin(cls, new: PreparedStudy) -> BounceShotStudy:
        """Create a study in a new folder, without running it; see `Study.begin`.

        Args:
            new: folder, experiment, plugins and salt, from `prepare_study`.

        Raises:
            InputError: the packages for films are missing, or the experiment is not one of a ball
                whose height is observed.
        """
        experiment = new.experiment
        if read_shot_config(experiment).filmed:
            video_files.check_installed("; or set shot.filmed = 0")
        # The drop of a ball is recorded by its height z alone.
        if experiment.simulator != "ball" or experiment.observe != ("z",):
            raise InputError(
                f'experiment {experiment.name}: a shot needs simulator = "ball" and observe = ["z"]'
            )
        # Validated before the folder is created: an error of the user leaves no files.
        check_tuners(experiment)
        return cls(new.create_folder())

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Self:
        """Open an interrupted study to run what is missing; see `Study.resume`.

        Args:
            folder: result folder.
            plugins: further plugin files.
        """
        study = super().resume(folder, plugins)
        check_shots(folder, study.shots)
        return study

    @cached_property
    def skipped_tuners(self) -> dict[str, str]:
        """Tuners that cannot be used here, by label, with the reason."""
        return check_tuners(self.configuration.experiment)

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment, with the tuners that can be used."""
        complete_experiment = self.configuration.experiment
        # Skipped tuners would have empty lines in the tables; `finish` reports why.
        labels = [
            entry.label
            for entry in complete_experiment.tuners
            if entry.label not in self.skipped_tuners
        ]
        return complete_experiment.with_tuners(labels)

    @cached_property
    def config(self) -> ShotConfig:
        """The [shot] table."""
        return read_shot_config(self.configuration.experiment)

    @cached_property
    def shots(self) -> list[ShotSetup]:
        """All shots of the study."""
        return draw_shots(self.configuration.experiment, self.config, self.salt)

    def run(
        self, jobs: int = 2, progress: ProgressFactory | None = None, pool: Pool | None = None
    ) -> StudyOutcome:
        """Execute the missing shots; see `Study.run`.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks; None for no progress output.
            pool: worker pool; None to create one.

        Returns:
            How many shots are stored and missing; the reason if the true world is not available.
        """
        if reason := true_world.find_missing_requirement():
            return self.count_finished(skipped=reason)
        # Worker processes import the classes of the tuners by their names.
        if pool is not None or jobs:
            check_classes_importable(self.experiment)

        def make_missing_shots() -> None:
            # The kinds of balls alternate, so a partial result covers all.
            missing_shots = list_missing_shots(self.folder, self.shots)
            if missing_shots:
                _ShotStages(self, missing_shots, progress or no_progress).run(jobs, pool)

        return self.finish(make_missing_shots)

    def list_run_ends(self) -> list[RunEnd]:
        """Return for each shot whether it is stored ("made") or missing.

        Raises:
            InputError: the file of a shot is damaged.
        """
        check_shots(self.folder, self.shots)
        missing = {setup.name for setup in list_missing_shots(self.folder, self.shots)}
        # Shots are counted by kind of ball.
        return [
            RunEnd(setup.name, setup.ball.name, MISSING_STATUS if setup.name in missing else "made")
            for setup in self.shots
        ]

    def report(self, print_line: PrintLine) -> int:
        """Write tables, figures and HTML report, and print a summary.

        Args:
            print_line: prints a line.

        Returns:
            Number of failures of methods.

        Raises:
            InputError: the file of a shot is damaged.
        """
        from bench.bounce_shot.shot_report import write_report

        return write_report(
            self.folder, self.experiment, self.config, self.shots, self.skipped_tuners, print_line
        )


class _ShotStages:
    """Execution of the missing shots in stages: record, train tuners, tune, plan and shoot."""

    def __init__(
        self, study: BounceShotStudy, missing_shots: list[ShotSetup], progress: ProgressFactory
    ) -> None:
        """Collect what the stages need.

        * `_tuned`: how to start the isolated process of each tuner, by label. Trusted tuners run in
          the worker processes and need no such specification.
        * `_hidden`: folders that isolated tuners must not read: the result folder, and the cache of
          trained weights.
        * `_paths`: paths of the recordings of the missing shots.

        Args:
            study: bounce-shot study in its result folder.
            missing_shots: the missing shots.
            progress: makes progress callbacks.
        """
        self._study, self._missing_shots, self._progress = study, missing_shots, progress
        self._experiment, self._settings = study.experiment, study.config
        self._tuned: dict[str, TunerSpec] = {}
        if not self._experiment.trusted:
            self._tuned = {entry.label: make_tuner_spec(entry) for entry in self._experiment.tuners}
        self._hidden = tuple(
            str(folder.resolve()) for folder in (study.folder, get_weights_folder())
        )
        self._paths = [
            study.folder / RECORDINGS_FOLDER / f"{shot.name}.csv" for shot in missing_shots
        ]

    def run(self, jobs: int, pool: Pool | None) -> None:
        """Run all stages: record the drops, train tuners, tune and plan, and execute the shots.

        Args:
            jobs: number of worker processes.
            pool: worker pool; None to create one.

        Raises:
            PoolLostError: the workers are no longer available.
            WeightsError: stored trained weights are damaged.
        """
        for name in (SHOTS_FOLDER, RECORDINGS_FOLDER):
            (self._study.folder / name).mkdir(exist_ok=True)
        # These workers know the true balls and run no tuner; other workers run the tuners.
        with make_pool(jobs) as workers:
            recording_errors = self._record_drops(workers)
        # The true balls are in the memory of this process. Isolated tuners may run as the same
        # user, so this process must not be readable for others.
        memory_protection = nullcontext() if self._experiment.trusted else not_dumpable()
        with memory_protection, pool or make_pool(jobs) as workers:
            workers.load_plugins(describe_plugins(self._study.plugins, self._experiment))
            weights = self._train_tuners(workers)
            self._run_shots(workers, recording_errors, weights)

    def _record_drops(self, workers: Pool) -> dict[int, BaseException]:
        """Record the drop of every missing shot.

        Args:
            workers: pool of worker processes.

        Returns:
            Errors of drops that could not be recorded, by index of the shot.
        """
        calls: list[Call] = [
            (record_drop, (self._experiment, setup, self._settings, path))
            for setup, path in zip(self._missing_shots, self._paths, strict=True)
        ]
        step = self._progress("dropping", len(calls))
        recording_errors: dict[int, BaseException] = {}
        for index, result in workers.iterate_results(calls, self._experiment.timeout):
            if isinstance(result, BaseException):
                recording_errors[index] = result
            step()
        return recording_errors

    def _train_tuners(self, workers: Pool) -> dict[str, Path]:
        """Train the tuners that need training, or load weights that were trained before.

        Args:
            workers: pool of worker processes.

        Returns:
            Files of the trained weights, by label of the tuner.

        Raises:
            Exception: a training failed; an untrained tuner must not be used as a trained one.
        """
        learned_entries = [e for e in self._experiment.tuners if tuners.get(e.tuner).learned]
        experiments = [
            drop_tuning.make_tuning_experiment(self._experiment, self._settings, entry)
            for entry in learned_entries
        ]
        calls: list[Call] = [
            (
                train_or_load,
                (
                    experiment,
                    TrainingRequest(
                        entry, seed=0, tuned=self._tuned.get(entry.label), hidden=self._hidden
                    ),
                ),
            )
            for experiment, entry in zip(experiments, learned_entries, strict=True)
        ]
        step = self._progress("training", len(calls))
        weights = {}
        for index, result in workers.iterate_results(calls, math.inf):
            if not isinstance(result, TrainingResult):
                raise result
            weights[learned_entries[index].label] = result.path
            step()
        return weights

    def _run_shots(
        self, workers: Pool, recording_errors: dict[int, BaseException], weights: dict[str, Path]
    ) -> None:
        """Tune and plan with every method, and execute and store the missing shots.

        A shot whose drop could not be recorded, or whose worker failed, is stored as a miss of
        every method.

        Args:
            workers: pool of worker processes.
            recording_errors: errors of drops that could not be recorded, by index of the shot.
            weights: files of trained weights, by label of the tuner.
        """
        # Indices of the missing shots whose drop was recorded.
        recorded = [
            index for index in range(len(self._missing_shots)) if index not in recording_errors
        ]
        calls: list[Call] = []
        for index in recorded:
            setup = self._missing_shots[index]
            inputs = drop_tuning.ShotInputs(
                setup.name, self._paths[index], setup.scene, weights, self._tuned, self._hidden
            )
            calls.append((drop_tuning.tune_and_plan, (self._experiment, self._settings, inputs)))
        step = self._progress("shooting", len(self._missing_shots))
        for index, error in recording_errors.items():
            status = "no recording" if isinstance(error, InputError) else "crashed"
            failed_models = drop_tuning.make_failed_models(self._experiment, error, status)
            self._store(index, failed_models, visible_share=0.0)
            step()
        for position, models in workers.iterate_results(calls, self._experiment.timeout):
            index = recorded[position]
            if isinstance(models, BaseException):
                models = drop_tuning.make_failed_models(self._experiment, models)
            run = read_recording(self._paths[index], BallSimulator, whole=True).runs[0]
            visible_samples = float(np.isfinite(run.channels["z"]).sum())
            self._store(index, models, visible_samples / self._experiment.sampling.samples)
            step()

    def _store(self, index: int, models: Sequence[TunedModel], visible_share: float) -> None:
        """Execute a shot in the true world with every model, and store the result.

        Args:
            index: index of the shot among the missing ones.
            models: tuned model of each method, with its plan.
            visible_share: share of the drop's sample times at which its recording has a height.
        """
        store_shot(
            self._study.folder, self._missing_shots[index], self._settings, models, visible_share
        )
