"""Study in a result folder: its creation, its resumption, and what all kinds of studies share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.problem.targets import Redraws
from bench.benchmark.runner.plugin_inspection import (
    check_classes_importable,
    load_plugins_for_experiment,
)
from bench.benchmark.runner.run_fingerprint import compute_fingerprint
from bench.benchmark.runner.tuner_process_start import list_active_isolation_layers
from bench.benchmark.storage.result_folder import (
    FolderConfiguration,
    choose_free_folder,
    create_folder,
    read_configuration,
)
from bench.benchmark.storage.run_status import (
    MISSING_STATUS,
    RunEnd,
    StudyOutcome,
    StudyProgress,
)
from bench.benchmark.storage.secret_salt import draw_salt_if_needed, read_salt, reveal_salt
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

    from bench.benchmark.runner.experiment_runner import ProgressFactory
    from bench.benchmark.runner.worker_pools import Pool


PrintLine = Callable[[str], None]


class Study(ABC):
    """A study in its result folder.

    ``Kind(folder)`` opens a study for status and report, without disturbing a process that runs it.
    `begin` and `resume` give a study that can be run.

    Attributes:
        folder: result folder.
        configuration: configuration of the study.
        plugins: plugin files that it needs.
    """

    counted: ClassVar[str] = "runs finished"
    """Words for the runs that its status counts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.configuration = read_configuration(folder)
        self.plugins = self.configuration.plugins

    @classmethod
    @abstractmethod
    def begin(cls, new: PreparedStudy) -> Study:
        """Check and plan a study in a new folder.

        Args:
            new: folder, experiment, plugins and salt, from `prepare_study`.

        Raises:
            InputError: the experiment has an error.
        """

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Self:
        """Open an interrupted study to complete it.

        Args:
            folder: result folder.
            plugins: additional plugin files; the study's own are loaded in any case.

        Raises:
            InputError: the folder is damaged, or something relevant has changed since.
        """
        study = cls(folder)
        study.plugins = check_resumable(folder, study.configuration, plugins)
        return study

    @abstractmethod
    def run(
        self, jobs: int = 2, progress: ProgressFactory | None = None, pool: Pool | None = None
    ) -> StudyOutcome:
        """Run the runs of the plan that are not yet stored in the folder.

        Args:
            jobs: number of worker processes; 0 to run everything in this process.
            progress: called for every step.
            pool: pool to use instead, for example of a cluster.

        Returns:
            How far the study came, also if it was interrupted.

        Raises:
            InputError: workers cannot be started; finished runs are stored.
        """

    @abstractmethod
    def list_run_ends(self) -> Sequence[RunEnd]:
        """Return how every planned run ended, in the order of the plan."""

    @property
    def is_unfinished(self) -> bool:
        """True if results remain to be written, although every run may have ended."""
        return False

    @abstractmethod
    def report(self, print_line: PrintLine) -> int:
        """Write tables and figures, print the results, and return the number of failures."""

    def close(self) -> None:
        """Release the folder without running what is missing."""

    def status(self) -> StudyProgress:
        """Return what the folder contains, and what is missing."""
        name, hashes = self.configuration.experiment.name, self.configuration.fingerprint
        ends = tuple(self.list_run_ends())
        return StudyProgress(name, self.counted, hashes, ends, self.is_unfinished)

    @property
    def salt(self) -> str:
        """Salt of the study, also while it is secret."""
        experiment = self.configuration.experiment
        return read_salt(self.folder, experiment) or experiment.salt

    def reveal_salt(self) -> None:
        """Write a secret salt to the configuration, since the study is complete."""
        reveal_salt(self.folder, read_salt(self.folder, self.configuration.experiment))
        self.configuration = read_configuration(self.folder)

    def finish(self, run_missing: Callable[[], None]) -> StudyOutcome:
        """Run what is missing, and return how far the study came, also if it was interrupted.

        It can end early by an interrupt of the user, or because the cluster is lost; the outcome
        says so. A complete study reveals its salt.

        Args:
            run_missing: runs and stores everything that is missing.
        """
        from bench.benchmark.runner.worker_pools import PoolLostError

        try:
            run_missing()
        except KeyboardInterrupt:
            return self.count_finished(interrupted=True)
        except PoolLostError as error:
            return self.count_finished(stopped=str(error))
        return self.count_finished()

    def count_finished(self, **why: Any) -> StudyOutcome:
        """Return how far the study came; reveal its salt if it is complete.

        Args:
            why: reason for which it ended early: `interrupted` or `stopped` of `StudyOutcome`.
        """
        ends = self.list_run_ends()
        missing = sum(end.status == MISSING_STATUS for end in ends)
        if not missing and not why:
            self.reveal_salt()
        return StudyOutcome(len(ends) - missing, len(ends), **why)


def check_resumable(
    folder: Path, configuration: FolderConfiguration, plugins: Sequence[str]
) -> list[str]:
    """Check that a study can be resumed, and load its plugins.

    Args:
        folder: folder of the study.
        configuration: configuration with which the study was started.
        plugins: additional plugin files.

    Returns:
        All plugin files that the study needs.

    Raises:
        InputError: something relevant has changed since the study was started.
    """
    # The study's own plugins come first and in their order, as when it was started.
    added_paths = {str(Path(p).resolve()) for p in plugins}
    all_plugins = configuration.plugins + sorted(added_paths - set(configuration.plugins))
    load_plugins_for_experiment(all_plugins, configuration.experiment)
    _check_unchanged(
        folder,
        configuration.fingerprint,
        compute_fingerprint(configuration.experiment, all_plugins),
    )
    return all_plugins


def _check_unchanged(folder: Path, initial: dict[str, str], present: dict[str, str]) -> None:
    """Raise an error if the configuration of a study has changed.

    Args:
        folder: folder of the study.
        initial: hashes by readable name when the study was started; empty if they are unknown.
        present: present hashes, from `compute_fingerprint`.

    Raises:
        InputError: something has changed since the study was started.
    """
    if not initial:
        raise InputError(
            f"{folder}: written by an older simgap, which cannot be resumed; start a new comparison"
        )
    # The first difference is reported: direct changes are listed before their consequences.
    for hash_name, hashed in present.items():
        if initial.get(hash_name) != hashed:
            raise InputError(
                f"{folder}: its {hash_name} changed since it was started ({initial.get(hash_name)} "
                f"then, {hashed} now); all runs need the same configuration: restore it, or start "
                "a new comparison"
            )


class PreparedStudy(NamedTuple):
    """Study whose folder is not yet written, so that a user error leaves no files behind.

    Attributes:
        folder: result folder to create.
        experiment: configuration that will be run.
        plugins: plugin files that the study needs; the caller has loaded them.
        secret: secret salt; None if the salt is public.
        jobs: number of worker processes; 0 for none, and tuners without isolation.
    """

    folder: Path
    experiment: Experiment
    plugins: Sequence[str]
    secret: str | None
    jobs: int

    def create_folder(self, redraws: Redraws | None = None) -> Path:
        """Create the result folder with hashes of what must not change, and return it.

        Args:
            redraws: number of targets that were drawn again, for environment.json.

        Raises:
            InputError: workers could not load a class that the study needs.
        """
        # This comes before the folder is created, so that a user error leaves no files behind.
        if self.jobs:
            check_classes_importable(self.experiment)
        hashes = compute_fingerprint(self.experiment, self.plugins)
        layers = () if self.experiment.trusted else list_active_isolation_layers()
        configuration = FolderConfiguration(self.experiment, list(self.plugins), hashes)
        create_folder(self.folder, configuration, self.jobs, self.secret, layers, redraws)
        return self.folder


def prepare_study(
    experiment: Experiment,
    plugins: Sequence[str] = (),
    folder: Path | None = None,
    jobs: int = 2,
    salt: str | None = None,
) -> PreparedStudy:
    """Choose a free folder and the salt of a study.

    Args:
        experiment: configuration of the study.
        plugins: plugin files that it needs; the caller has loaded them.
        folder: new or empty folder; None for one below results/ that is named after the time.
        jobs: number of worker processes; 0 for none, and tuners without isolation.
        salt: salt of the targets, secret until the study is complete; None for the experiment's or
            a new one.

    Raises:
        InputError: the folder is not free, or the salt does not fit the experiment.
    """
    free_folder = choose_free_folder(experiment, folder)
    experiment, secret = draw_salt_if_needed(experiment, salt)
    # Without worker processes tuners run in this process, without isolation.
    experiment = experiment.chosen(trusted=experiment.trusted or not jobs)
    return PreparedStudy(free_folder, experiment, plugins, secret, jobs)
