"""Create a study: its free result folder, its salt, and its isolation layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.targets import Redraws
from bench.benchmark.runner.sandboxed_tuner import list_active_isolation_layers
from bench.benchmark.storage.result_folder import (
    FolderConfiguration,
    choose_free_folder,
    create_folder,
)
from bench.benchmark.storage.salt_file import draw_salt_if_needed


class PreparedStudy(NamedTuple):
    """Study whose folder is not yet written, so that a user error leaves no files behind.

    Attributes:
        folder: result folder to create.
        experiment: configuration that will be run.
        secret: secret salt; None if the salt is public.
        jobs: number of worker processes.
    """

    folder: Path
    experiment: Experiment
    secret: str | None
    jobs: int

    def create_folder(
        self, plugins: Sequence[str], hashes: Mapping[str, str], redraws: Redraws | None = None
    ) -> Path:
        """Create the result folder and return it.

        Args:
            plugins: plugin files that the study needs.
            hashes: hashes of everything that must not change while the study runs.
            redraws: number of targets that were drawn again, for environment.json.
        """
        held = () if self.experiment.trusted else list_active_isolation_layers()
        configuration = FolderConfiguration(self.experiment, list(plugins), dict(hashes))
        create_folder(self.folder, configuration, self.jobs, self.secret, held, redraws)
        return self.folder


def prepare_study(
    experiment: Experiment, folder: Path | None, jobs: int, salt: str | None
) -> PreparedStudy:
    """Choose a free folder and the salt of a study; see `bench.studies.study.Study.begin`.

    Args:
        experiment: configuration of the study.
        folder: result folder; None for a default name.
        jobs: number of worker processes; 0 for this process.
        salt: given salt; None for the experiment's or a new one.
    """
    place = choose_free_folder(experiment, folder)
    experiment, secret = draw_salt_if_needed(experiment, salt)
    # Without worker processes tuners run in this process, without isolation.
    return PreparedStudy(
        place, experiment.chosen(trusted=experiment.trusted or not jobs), secret, jobs
    )
