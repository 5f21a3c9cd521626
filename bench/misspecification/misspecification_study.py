"""Misspecification study in its result folder.

A recording of the true system is made, explain extends the simulator from it, and every tuner is
compared in both simulators on the same targets. The folder contains `calibration.csv`, the result
of explain in `explain/`, and two comparisons, `plain/` and `extended/`, each in the common format
of comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from bench.benchmark.comparison_study import Comparison
from bench.benchmark.runner.study_base import PrintLine, Study
from bench.benchmark.storage.result_folder import CONFIGURATION_FILE
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.benchmark.storage.run_status import (
    MISSING_STATUS,
    RunEnd,
    StudyOutcome,
)
from bench.benchmark.storage.secret_salt import read_salt
from bench.core.plugin_registries import simulators
from bench.misspecification.calibration_recording import (
    EXTENDED,
    MODEL_LABELS,
    PLAIN,
    write_calibration_recording,
)
from sims.extended_simulator import list_effect_coefficients, open_extended

if TYPE_CHECKING:
    from bench.benchmark.problem.experiment_config import Experiment
    from bench.benchmark.runner.experiment_runner import ProgressFactory
    from bench.benchmark.runner.study_base import PreparedStudy
    from bench.benchmark.runner.worker_pools import Pool

CALIBRATION_FILE = "calibration.csv"
"""Calibration recording from which explain extends the simulator."""
EXTENDED_MODEL_FILE = "explain/extended.toml"
"""Extended simulator that explain writes."""


class MisspecificationStudy(Study):
    """Study of tuners in a simulator with a missing effect and in the extended one.

    Args:
        folder: result folder of such a study.

    Attributes:
        folder: result folder.
        configuration: stored configuration of the study.
        plugins: plugin files that it needs.

    Raises:
        InputError: the folder does not contain such a study, or it is damaged.
    """

    @classmethod
    def begin(cls, new: PreparedStudy) -> MisspecificationStudy:
        """Create a study in a new folder, without running it; see `Study.begin`.

        Args:
            new: folder, experiment, plugins and salt, from `prepare_study`.
        """
        from bench.benchmark.runner.experiment_runner import prepare_experiment

        # Validated before the folder is created: an error of the user leaves no files.
        prepare_experiment(make_base_experiment(new.experiment), new.secret)
        return cls(new.create_folder())

    def run(
        self, jobs: int = 2, progress: ProgressFactory | None = None, pool: Pool | None = None
    ) -> StudyOutcome:
        """Run what is missing; see `Study.run`.

        The extension of the simulator is diagnosed first, then the comparisons in the plain and in
        the extended simulator are run.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks; None for no progress output.
            pool: worker pool; None to create one.

        Returns:
            How many runs of both comparisons are finished and planned, and why it ended early.
        """
        from bench.benchmark.runner.experiment_runner import no_progress

        try:
            self._extend(jobs, progress or no_progress)
        except KeyboardInterrupt:
            count_per_model = self._count_planned_runs()
            # Neither of the two comparisons has begun.
            return StudyOutcome(0, 2 * count_per_model, interrupted=True)
        finished_count = planned_count = 0
        for model in MODEL_LABELS:
            comparison = self._open_comparison(model, jobs)
            outcome = comparison.run(jobs, progress, pool)
            finished_count += outcome.finished
            planned_count += outcome.planned
            if not outcome.is_complete:
                # The second comparison, which has not started, has the same number of runs.
                not_started = outcome.planned if model == PLAIN else 0
                return StudyOutcome(
                    finished_count,
                    planned_count + not_started,
                    outcome.interrupted,
                    outcome.stopped,
                    outcome.skipped,
                )
        self.reveal_salt()
        # The folder of segments contained only the salt, which is public now.
        segments = self.folder / SEGMENTS_FOLDER
        if segments.is_dir() and not any(segments.iterdir()):
            segments.rmdir()
        return StudyOutcome(finished_count, planned_count)

    def _count_planned_runs(self) -> int:
        """Return the number of runs in each simulator: all seeds, times targets and ranges."""
        from bench.benchmark.runner.experiment_runner import count_seeds

        experiment = self.configuration.experiment
        runs = sum(count_seeds(experiment, entry) for entry in experiment.tuners)
        return runs * experiment.targets * len(experiment.ranges)

    def _extend(self, jobs: int, progress: ProgressFactory) -> None:
        """Record the true system and extend the simulator by explain, unless done already.

        If `EXTENDED_MODEL_FILE` exists, this step was completed before an interruption.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks.
        """
        if (self.folder / EXTENDED_MODEL_FILE).is_file():
            return
        experiment = self.configuration.experiment
        step = progress("explaining", 1)
        table = self.folder / CALIBRATION_FILE
        # If only one of the two files exists, the process was killed while writing.
        for file in (table, table.with_suffix(".toml")):
            file.unlink(missing_ok=True)
        write_calibration_recording(experiment, self.salt, table)
        # A local import, because it imports all of explain.
        from bench.diagnosis.explain import explain

        explanation = explain([table], free=experiment.free, jobs=max(jobs, 1))
        explanation.write((self.folder / EXTENDED_MODEL_FILE).parent)
        step()

    def _open_comparison(self, model: str, jobs: int) -> Comparison:
        """Create or resume the comparison in one of the simulators.

        Its tuners must read neither its own folder nor the rest of the study.

        Args:
            model: `PLAIN` or `EXTENDED`.
            jobs: number of worker processes.
        """
        folder, experiment = self.folder / model, self.configuration.experiment
        if (folder / CONFIGURATION_FILE).is_file():
            comparison = Comparison.resume(folder, self.plugins)
        else:
            # A public salt is already part of the experiment. The hash of a secret salt is removed
            # from the plan, because `prepare_study` enters it again.
            secret = read_salt(self.folder, experiment)
            plan = replace(self.get_experiment(model), salt_sha256="")
            from bench.benchmark.runner.study_base import prepare_study

            comparison = Comparison.begin(prepare_study(plan, self.plugins, folder, jobs, secret))
        if comparison.results is not None:
            # The folder of the other simulator contains the same true parameters, so it must be
            # inaccessible too.
            hidden_paths = (str(self.folder.resolve()), *comparison.results.hidden_paths)
            comparison.results.hidden_paths = hidden_paths
        return comparison

    def get_experiment(self, model: str) -> Experiment:
        """Return the experiment of the comparison in one of the simulators.

        That of the extended simulator contains the coefficients that explain fitted, so
        `EXTENDED_MODEL_FILE` must exist.

        Args:
            model: `PLAIN` or `EXTENDED`.
        """
        from bench.benchmark.problem.robot_experiment import get_simulator_class

        experiment = self.configuration.experiment
        if model == PLAIN:
            return make_base_experiment(experiment)
        kind = get_simulator_class(experiment)
        extended, *_ = open_extended(self.folder / EXTENDED_MODEL_FILE, simulators.get)
        return make_extended_experiment(experiment, list_effect_coefficients(extended, kind))

    @property
    def is_unfinished(self) -> bool:
        """True if results remain to be written, here or in one of the comparisons."""
        comparisons = [Comparison(self.folder / m) for m in MODEL_LABELS if self._is_prepared(m)]
        return (self.folder / SEGMENTS_FOLDER).exists() or any(
            comparison.is_unfinished for comparison in comparisons
        )

    def _is_prepared(self, model: str) -> bool:
        """Return whether the comparison in one of the two simulators has a folder."""
        return (self.folder / model / CONFIGURATION_FILE).is_file()

    def list_run_ends(self) -> list[RunEnd]:
        """Return which runs are stored and which are missing, in both simulators.

        Raises:
            InputError: the study is damaged.
        """
        run_ends: list[RunEnd] = []
        for model in MODEL_LABELS:
            if self._is_prepared(model):
                run_ends += [
                    RunEnd(f"{model} {e.name}", f"{model} {e.group}", e.status, e.reason)
                    for e in Comparison(self.folder / model).list_run_ends()
                ]
            else:
                run_ends += [
                    RunEnd(f"{model} {i}", model, MISSING_STATUS)
                    for i in range(self._count_planned_runs())
                ]
        return run_ends

    def report(self, print_line: PrintLine) -> int:
        """Write tables and figures, and print a summary.

        Args:
            print_line: prints a line.

        Returns:
            Number of failed runs.

        Raises:
            InputError: a comparison of the study is damaged.
        """
        from bench.misspecification.misspecification_report import write_report

        return write_report(self, print_line)


def make_base_experiment(experiment: Experiment) -> Experiment:
    """Make the experiment in the original simulator, which lacks the hidden effects."""
    return _make_comparison_experiment(experiment, PLAIN, experiment.settings)


def make_extended_experiment(experiment: Experiment, effects: dict[str, list[float]]) -> Experiment:
    """Make the experiment in the extended simulator, which has the hidden effects.

    The tuned parameters remain the same. The hidden effects act with the coefficients that explain
    fitted.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        effects: fitted coefficients by name of the effect.
    """
    settings = dict(experiment.settings)
    # An effect that is tuned stays tuned, although explain fitted its coefficients too.
    tuned = {*settings.get("effects", ()), *experiment.parameters}
    fixed_effects = {name: values for name, values in effects.items() if name not in tuned}
    settings["fixed"] = {**settings.get("fixed", {}), **fixed_effects}
    return _make_comparison_experiment(experiment, EXTENDED, settings)


def _make_comparison_experiment(
    experiment: Experiment, model: str, settings: Mapping[str, Any]
) -> Experiment:
    """Make the experiment of one of the two comparisons: the same targets in another simulator.

    Targets are drawn from the name of an experiment, so `same_targets_as` states that of the study.
    The calibration recording belongs to the study, not to its comparisons.

    Args:
        experiment: the experiment of the study.
        model: `PLAIN` or `EXTENDED`, which is added to name and title.
        settings: settings of the simulator, such as its fixed effects.
    """
    return replace(
        experiment,
        name=f"{experiment.name}-{model}",
        title=f"{experiment.title or experiment.name} ({model})",
        same_targets_as=experiment.name,
        settings=settings,
        calibration=None,
    )
