"""Create the study of an experiment: its free result folder, salt and isolation layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.targets import Redraws
from bench.benchmark.runner.tuner_process_reuse import list_active_isolation_layers
from bench.benchmark.storage.result_folder import (
    FolderConfiguration,
    choose_free_folder,
    create_folder,
    draw_salt_if_needed,
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

    def create_folder(self, hashes: Mapping[str, str], redraws: Redraws | None = None) -> Path:
        """Create the result folder and return it.

        Args:
            hashes: hashes of everything that must not change while the study runs.
            redraws: number of targets that were drawn again, for environment.json.
        """
        layers = () if self.experiment.trusted else list_active_isolation_layers()
        configuration = FolderConfiguration(self.experiment, list(self.plugins), dict(hashes))
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
