"""Create a study: its free result folder, its salt, and its isolation layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bench.problem.experiment import Experiment
from bench.problem.targets import Redraws
from bench.runs.housing import seals
from bench.store.folder import Configuration, create, free_folder
from bench.store.secret import salted


class Begun(NamedTuple):
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

    def write(
        self, plugins: Sequence[str], hashes: Mapping[str, str], redraws: Redraws | None = None
    ) -> Path:
        """Create the result folder and return it.

        Args:
            plugins: plugin files that the study needs.
            hashes: hashes of everything that must not change while the study runs.
            redraws: number of targets that were drawn again, for environment.json.
        """
        held = () if self.experiment.trusted else seals()
        configuration = Configuration(self.experiment, list(plugins), dict(hashes))
        create(self.folder, configuration, self.jobs, self.secret, held, redraws)
        return self.folder


def begun(experiment: Experiment, folder: Path | None, jobs: int, salt: str | None) -> Begun:
    """Choose a free folder and the salt of a study; see `bench.study.Study.begin`.

    Args:
        experiment: configuration of the study.
        folder: result folder; None for a default name.
        jobs: number of worker processes; 0 for this process.
        salt: given salt; None for the experiment's or a new one.
    """
    place = free_folder(experiment, folder)
    experiment, secret = salted(experiment, salt)
    # Without worker processes tuners run in this process, without isolation.
    return Begun(place, experiment.chosen(trusted=experiment.trusted or not jobs), secret, jobs)
